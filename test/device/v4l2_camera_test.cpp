// SPDX-License-Identifier: Apache-2.0
// Two cameras of the kernel's own test driver, vivid. v4l2_in_qemu.sh beside this file boots a
// machine that has them, and runs this test there.
#include "device/camera/v4l2/v4l2_camera.h"

#include <gmock/gmock.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cstdlib>
#include <fstream>
#include <opencv2/imgproc.hpp>
#include <thread>

#include "temporary_folder.h"

namespace omnister::device {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using Steady = std::chrono::steady_clock;
using testing::HasSubstr;

constexpr seconds kLong(60);

std::optional<Frame> next(Camera* camera) {
  const Steady::time_point end = Steady::now() + kLong;
  while (Steady::now() < end) {
    if (std::optional<Frame> frame = camera->grab(milliseconds(200))) return frame;
  }
  return std::nullopt;
}

bool write(const std::string& path, const std::string& text) {
  std::ofstream file(path);
  return static_cast<bool>(file << text << std::flush);
}

std::string refusal(const std::string& device, const CameraSettings& settings = {}) {
  try {
    openCamera(device, settings);
  } catch (const CameraError& e) {
    return e.what();
  }
  return "";
}

TEST(V4l2Errors, SaysWhatIsWrongWithAPath) {
  EXPECT_THAT(refusal("v4l2:/dev/video77"), HasSubstr("/dev/video77 cannot be opened: No such"));
  EXPECT_THAT(refusal("v4l2:/dev/null"), HasSubstr("/dev/null is no camera"));
  EXPECT_THAT(refusal("v4l2:nothing"), HasSubstr("no camera \"nothing\" is there"));
}

TEST(V4l2Errors, NamesTheGroupThatMayUseACamera) {
  if (geteuid() != 0) GTEST_SKIP() << "needs to be another user";
  const test::TemporaryFolder folder;
  const std::string path = (folder.path() / "video0").string();
  ASSERT_TRUE(write(path, ""));
  chmod(path.c_str(), 0600);
  chmod(folder.path().c_str(), 0755);
  ASSERT_EQ(seteuid(65534), 0);
  const std::string message = refusal("v4l2:" + path);
  ASSERT_EQ(seteuid(0), 0);
  EXPECT_THAT(message,
              testing::AllOf(HasSubstr("no permission to open " + path), HasSubstr("group video")));
}

class Vivid : public testing::Test {
 protected:
  void SetUp() override {
    if (!std::getenv("OMNISTER_VIVID")) {
      GTEST_SKIP() << "needs the cameras of the driver vivid: test/device/v4l2_in_qemu.sh";
    }
    settings_.size = {320, 180};
    // A pattern that stands still, without the writing over it.
    settings_.features = {"osd_text_mode=none", "horizontal_movement=no movement"};
  }
  std::unique_ptr<Camera> open(int number = 0) const {
    return openCamera("v4l2:platform:vivid-00" + std::to_string(number), settings_);
  }
  std::string refusal(const std::string& device) const {
    return device::refusal(device, settings_);
  }
  CameraSettings settings_;
};

TEST_F(Vivid, AllAreListedAndChosenByName) {
  const std::vector<V4l2Device> devices = listV4l2Devices();
  ASSERT_EQ(devices.size(), 2u);
  EXPECT_EQ(devices[0].identity.vendor, "vivid");
  EXPECT_EQ(devices[1].bus, "platform:vivid-001");
  EXPECT_EQ(open(1)->identity().serial, "platform:vivid-001");
  EXPECT_EQ(openCamera("v4l2:" + devices[0].path, settings_)->identity().serial,
            "platform:vivid-000");
  EXPECT_THAT(openCamera("v4l2:", settings_)->takeRemarks(),
              testing::Contains(HasSubstr("names no camera")));
  EXPECT_THAT(refusal("v4l2:nothing"),
              testing::AllOf(HasSubstr("nothing"), HasSubstr("vivid-001")));
  EXPECT_THAT(refusal("v4l2:/dev/video77"), HasSubstr("/dev/video77"));
  EXPECT_THAT(refusal("v4l2:/dev/null"), HasSubstr("no camera"));
}

TEST_F(Vivid, EveryFormatShowsTheSamePicture) {
  const struct {
    const char* fourcc;
    const char* encoding;
    int to_bgr;
  } cases[] = {{"BGR3", "bgr8", -1},
               {"RGB3", "rgb8", cv::COLOR_RGB2BGR},
               {"YUYV", "bgr8", -1},
               {"UYVY", "bgr8", -1},
               {"NV12", "bgr8", -1},
               {"GREY", "mono8", cv::COLOR_GRAY2BGR},
               {"Y16", "mono16", cv::COLOR_GRAY2BGR},
               {"RGGB", "bayer_rggb8", cv::COLOR_BayerBG2BGR},
               {"GRBG", "bayer_grbg8", cv::COLOR_BayerGB2BGR},
               {"GBRG", "bayer_gbrg8", cv::COLOR_BayerGR2BGR},
               {"BA81", "bayer_bggr8", cv::COLOR_BayerRG2BGR}};
  cv::Mat reference;
  for (const auto& test : cases) {
    SCOPED_TRACE(test.fourcc);
    settings_.pixel_format = test.fourcc;
    const std::unique_ptr<Camera> camera = open();
    camera->start();
    const std::optional<Frame> frame = next(camera.get());
    ASSERT_TRUE(frame);
    EXPECT_EQ(frame->encoding, test.encoding);
    EXPECT_EQ(frame->image.size(), settings_.size);
    cv::Mat bgr = frame->image.clone();
    if (bgr.depth() == CV_16U) bgr.convertTo(bgr, CV_8U, 1.0 / 256.0);
    if (test.to_bgr >= 0) cv::cvtColor(bgr, bgr, test.to_bgr);
    if (reference.empty()) {
      reference = bgr;
      cv::Scalar mean, deviation;
      cv::meanStdDev(bgr, mean, deviation);
      EXPECT_GT(deviation[0], 30.0);  // bars of many colours
      continue;
    }
    // Edges between the bars blur; grey has no colour, and another range than RGB.
    cv::Mat expected = reference, difference;
    if (std::string(test.encoding).rfind("mono", 0) == 0) {
      cv::cvtColor(reference, expected, cv::COLOR_BGR2GRAY);
      cv::cvtColor(bgr, bgr, cv::COLOR_BGR2GRAY);
    }
    cv::absdiff(bgr, expected, difference);
    EXPECT_LT(cv::mean(difference.reshape(1))[0], 20.0);
  }
  settings_.pixel_format = "XXXX";
  EXPECT_THAT(refusal("v4l2:platform:vivid-000"),
              testing::AllOf(HasSubstr("XXXX"), HasSubstr("YUYV")));
}

TEST_F(Vivid, WhatTheDriverGaveIsTold) {
  settings_.size = {1234, 777};
  const std::unique_ptr<Camera> camera = open();
  EXPECT_THAT(camera->takeRemarks(), testing::Contains(testing::AllOf(
                                         HasSubstr("1234x777"), HasSubstr("the driver gave"))));
  camera->start();
  const std::optional<Frame> frame = next(camera.get());
  ASSERT_TRUE(frame);
  EXPECT_NE(frame->image.size(), settings_.size);
  EXPECT_THAT(camera->statistics().link, HasSubstr(std::to_string(frame->image.cols) + "x" +
                                                   std::to_string(frame->image.rows)));
}

TEST_F(Vivid, BothStreamWithStampsOfTheirDriver) {
  const std::unique_ptr<Camera> a = open(0), b = open(1);
  a->start();
  b->start();
  for (Camera* camera : {a.get(), b.get()}) {
    std::optional<Frame> last;
    for (int i = 0; i < 20; ++i) {
      const std::optional<Frame> frame = next(camera);
      ASSERT_TRUE(frame);
      // This driver stamps the end that a frame of its rate would have had, and is ahead of it.
      EXPECT_LT(frame->stamp - now(), seconds(1));
      EXPECT_LT(now() - frame->stamp, seconds(5));
      if (last) {
        EXPECT_GT(frame->sequence, last->sequence);
        EXPECT_GT(frame->stamp, last->stamp);
      }
      last = frame;
    }
  }
}

TEST_F(Vivid, DroppedBuffersAreGapsAndNoPartialFrames) {
  settings_.features.push_back("percentage_of_dropped_buffers=20");
  std::unique_ptr<Camera> camera = open();
  EXPECT_THAT(camera->takeRemarks(), testing::IsEmpty());
  camera->start();
  std::uint64_t first = 0, last = 0;
  constexpr int kFrames = 60;
  for (int i = 0; i < kFrames; ++i) {
    const std::optional<Frame> frame = next(camera.get());
    ASSERT_TRUE(frame);
    EXPECT_EQ(frame->image.size(), settings_.size);
    if (i == 0) first = frame->sequence;
    last = frame->sequence;
  }
  EXPECT_GT(last - first + 1, static_cast<std::uint64_t>(kFrames) + 3);
  camera.reset();
  settings_.features = {"percentage_of_dropped_buffers=0"};
  open();
}

TEST_F(Vivid, ControlsAreSetWithinTheirLimits) {
  settings_.gain_auto = "off";
  settings_.gain = 1e6;
  settings_.features.push_back("no_such_thing=1");
  const std::unique_ptr<Camera> camera = open();
  EXPECT_THAT(camera->takeRemarks(),
              testing::UnorderedElementsAre(
                  testing::AllOf(HasSubstr("no_such_thing"), HasSubstr("brightness")),
                  testing::AllOf(HasSubstr("gain: asked for"), HasSubstr("255"))));
  const CameraControls controls = camera->controls();
  EXPECT_EQ(controls.gain, 255.0);
  EXPECT_EQ(controls.gain_auto, "off");
  CameraControls wanted;
  wanted.gain = 100.0;
  camera->start();
  EXPECT_EQ(camera->setControls(wanted).gain, 100.0);
  EXPECT_TRUE(next(camera.get()));
}

TEST_F(Vivid, ACameraInOtherHandsIsBusy) {
  const std::unique_ptr<Camera> camera = open();
  camera->start();
  EXPECT_THAT(refusal("v4l2:platform:vivid-000"), HasSubstr("another program controls it"));
}

TEST_F(Vivid, AnUnpluggedCameraIsLostAndTheSameOneComesBack) {
  std::unique_ptr<Camera> camera = open(1);
  settings_.identity = camera->identity();
  camera->start();
  ASSERT_TRUE(next(camera.get()));
  ASSERT_TRUE(write("/sys/bus/platform/drivers/vivid/unbind", "vivid.0"));
  std::string reason;
  const Steady::time_point end = Steady::now() + kLong;
  while (reason.empty() && Steady::now() < end) {
    try {
      camera->grab(milliseconds(200));
    } catch (const CameraError& e) {
      reason = e.what();
    }
  }
  EXPECT_THAT(reason, HasSubstr("unplugged"));
  camera->abandon();
  camera.reset();
  EXPECT_THAT(refusal("v4l2:platform:vivid-001"), HasSubstr("gone"));
  ASSERT_TRUE(write("/sys/bus/platform/drivers/vivid/bind", "vivid.0"));
  while (!camera && Steady::now() < end) {
    try {
      camera = open(1);
    } catch (const CameraError&) {
      std::this_thread::sleep_for(milliseconds(100));
    }
  }
  ASSERT_TRUE(camera);
  EXPECT_EQ(camera->identity().serial, "platform:vivid-001");
  camera->start();
  EXPECT_TRUE(next(camera.get()));
}

}  // namespace
}  // namespace omnister::device
