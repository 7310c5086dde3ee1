// SPDX-License-Identifier: Apache-2.0
#include "device/camera/aravis/aravis_camera.h"

#include <gmock/gmock.h>

#include <algorithm>
#include <cstdlib>
#include <functional>
#include <mutex>
#include <opencv2/imgproc.hpp>
#include <set>
#include <thread>

#include "child_process.h"
#include "device/own_network.h"
#include "full_tests.h"
#include "omnister/sim/gige_server.h"

namespace omnister::device {
namespace {

using sim::GigeServer;
using sim::GigeServerOptions;
using std::chrono::milliseconds;
using std::chrono::nanoseconds;
using std::chrono::seconds;
using Steady = std::chrono::steady_clock;
using testing::HasSubstr;

constexpr seconds kLong(60);

/// Blue says which frame it is, green and red which pixel; remembers when each was exposed.
class Scene {
 public:
  explicit Scene(cv::Size size) : size_(size) {}
  sim::DrawFrame draw(milliseconds duration = milliseconds(0)) {
    return [this, duration](Stamp stamp) {
      std::this_thread::sleep_for(duration);
      const std::lock_guard<std::mutex> lock(mutex_);
      stamps_.push_back(stamp);
      return image(stamps_.size() - 1);
    };
  }
  cv::Mat image(std::size_t index) const {
    cv::Mat image(size_, CV_8UC3);
    for (int y = 0; y < size_.height; ++y) {
      for (int x = 0; x < size_.width; ++x) {
        image.at<cv::Vec3b>(y, x) =
            cv::Vec3b(static_cast<std::uint8_t>(index), static_cast<std::uint8_t>(x),
                      static_cast<std::uint8_t>(y));
      }
    }
    return image;
  }
  std::vector<Stamp> stamps() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return stamps_;
  }

 private:
  const cv::Size size_;
  mutable std::mutex mutex_;
  std::vector<Stamp> stamps_;
};

bool equal(const cv::Mat& a, const cv::Mat& b) {
  return a.size() == b.size() && a.type() == b.type() && cv::norm(a, b, cv::NORM_INF) == 0.0;
}

std::optional<Frame> next(Camera* camera, nanoseconds patience = kLong) {
  const Steady::time_point end = Steady::now() + patience;
  while (Steady::now() < end) {
    if (std::optional<Frame> frame = camera->grab(milliseconds(200))) return frame;
  }
  return std::nullopt;
}

class AravisCamera : public testing::Test {
 protected:
  AravisCamera() {
    options_.size = {64, 48};
    options_.frame_rate_hz = 50.0;
    options_.exposure_us = 2000.0;
    options_.serial = "T-1";
  }
  void serve(milliseconds duration = milliseconds(0)) {
    server_ = std::make_unique<GigeServer>(options_, scene_.draw(duration));
  }
  std::unique_ptr<Camera> open(const std::string& device = "aravis:127.0.0.1") const {
    return openCamera(device, settings_);
  }
  std::string refusal(const std::string& device = "aravis:127.0.0.1") const {
    try {
      open(device);
    } catch (const CameraError& e) {
      return e.what();
    }
    return "";
  }

  GigeServerOptions options_;
  Scene scene_{{64, 48}};
  CameraSettings settings_;
  std::unique_ptr<GigeServer> server_;
};

TEST_F(AravisCamera, FramesTravelOverTheWireAsTheyWereDrawn) {
  serve();
  settings_.ptp = true;
  const std::unique_ptr<Camera> camera = open();
  EXPECT_EQ(camera->identity().serial, "T-1");
  EXPECT_EQ(camera->identity().vendor, "OMNister");
  camera->start();
  std::optional<std::uint64_t> last;
  std::set<const void*> places;
  for (int i = 0; i < 40; ++i) {
    const std::optional<Frame> frame = next(camera.get());
    ASSERT_TRUE(frame);
    EXPECT_EQ(frame->encoding, "bgr8");
    // Both clocks are the host's.
    const std::vector<Stamp> stamps = scene_.stamps();
    const auto exposed = std::find(stamps.begin(), stamps.end(), frame->stamp);
    ASSERT_NE(exposed, stamps.end());
    EXPECT_TRUE(
        equal(frame->image, scene_.image(static_cast<std::size_t>(exposed - stamps.begin()))));
    if (last) {
      EXPECT_GT(frame->sequence, *last);
    }
    last = frame->sequence;
    // Nothing was copied on the way from the socket, and memory goes round.
    ASSERT_TRUE(frame->memory);
    EXPECT_EQ(frame->memory->bytes.data(), frame->image.data);
    places.insert(frame->image.data);
  }
  EXPECT_LE(places.size(), static_cast<std::size_t>(settings_.buffers) + 2);
  const CameraStatistics statistics = camera->statistics();
  EXPECT_GE(statistics.complete, 40u);
  EXPECT_EQ(statistics.incomplete, 0u);
  EXPECT_EQ(statistics.temperature_c, 41.0);
  EXPECT_THAT(statistics.link, HasSubstr("127.0.0.1"));
  EXPECT_THAT(camera->takeRemarks(), testing::IsEmpty());
}

TEST_F(AravisCamera, StampsDoNotDependOnHowLongAFrameTakesToArrive) {
  // By arrival alone they would be late by the drawing; the clock's latch tells better.
  serve(milliseconds(800));
  const std::unique_ptr<Camera> camera = open();
  camera->start();
  for (int i = 0; i < 3; ++i) {
    const std::optional<Frame> frame = next(camera.get());
    ASSERT_TRUE(frame);
    const Stamp truth = scene_.stamps().at(frame->image.at<cv::Vec3b>(0, 0)[0]);
    EXPECT_LT(std::abs((frame->stamp - truth).count()), 400000000);
  }
}

TEST_F(AravisCamera, EveryPixelFormatHasItsEncoding) {
  serve();
  const struct {
    const char* format;
    const char* encoding;
    std::function<cv::Mat(const cv::Mat&)> expected;
  } cases[] = {
      {"BGR8", "bgr8", [](const cv::Mat& bgr) { return bgr; }},
      {"RGB8", "rgb8",
       [](const cv::Mat& bgr) {
         cv::Mat out;
         cv::cvtColor(bgr, out, cv::COLOR_BGR2RGB);
         return out;
       }},
      {"Mono8", "mono8",
       [](const cv::Mat& bgr) {
         cv::Mat out;
         cv::cvtColor(bgr, out, cv::COLOR_BGR2GRAY);
         return out;
       }},
      {"Mono16", "mono16",
       [](const cv::Mat& bgr) {
         cv::Mat out;
         cv::cvtColor(bgr, out, cv::COLOR_BGR2GRAY);
         out.convertTo(out, CV_16U, 256.0);
         return out;
       }},
      {"BayerRG8", "bayer_rggb8",
       [](const cv::Mat& bgr) {
         cv::Mat out(bgr.size(), CV_8UC1);
         for (int y = 0; y < bgr.rows; ++y) {
           for (int x = 0; x < bgr.cols; ++x) {
             const int channel = y % 2 == 0 ? (x % 2 == 0 ? 2 : 1) : (x % 2 == 0 ? 1 : 0);
             out.at<std::uint8_t>(y, x) = bgr.at<cv::Vec3b>(y, x)[channel];
           }
         }
         return out;
       }},
  };
  for (const auto& test : cases) {
    SCOPED_TRACE(test.format);
    settings_.pixel_format = test.format;
    const std::unique_ptr<Camera> camera = open();
    const std::size_t before = scene_.stamps().size();
    camera->start();
    const std::optional<Frame> frame = next(camera.get());
    ASSERT_TRUE(frame);
    EXPECT_EQ(frame->encoding, test.encoding);
    camera->stop();
    bool found = false;
    for (std::size_t i = before; i < scene_.stamps().size() && !found; ++i) {
      found = equal(frame->image, test.expected(scene_.image(i)));
    }
    EXPECT_TRUE(found);
  }
  settings_.pixel_format = "Mono7";
  EXPECT_THAT(refusal(), testing::AllOf(HasSubstr("Mono7"), HasSubstr("Mono16, BayerRG8")));
}

TEST_F(AravisCamera, ARegionAndBinningAreToldInPixelsOfTheSensor) {
  serve();
  settings_.binning = {2, 2};
  settings_.size = {20, 10};
  settings_.offset = {4, 6};
  std::unique_ptr<Camera> camera = open();
  camera->start();
  std::optional<Frame> frame = next(camera.get());
  ASSERT_TRUE(frame);
  EXPECT_EQ(frame->image.size(), cv::Size(20, 10));
  ASSERT_TRUE(frame->region);
  EXPECT_EQ(frame->region->sensor, cv::Size(64, 48));
  EXPECT_EQ(frame->region->region, cv::Rect(8, 12, 40, 20));
  EXPECT_EQ(frame->region->binning, cv::Size(2, 2));
  EXPECT_FALSE(frame->region->whole());
  // The mean of four pixels, whose columns are 8 and 9, rows 12 and 13.
  EXPECT_NEAR(frame->image.at<cv::Vec3b>(0, 0)[1], 8.5, 0.5);
  EXPECT_NEAR(frame->image.at<cv::Vec3b>(0, 0)[2], 12.5, 0.5);
  camera.reset();

  settings_.binning = {1, 1};
  settings_.size = {64, 48};
  settings_.offset = {0, 0};
  camera = open();
  camera->start();
  frame = next(camera.get());
  ASSERT_TRUE(frame && frame->region);
  EXPECT_TRUE(frame->region->whole());
}

TEST_F(AravisCamera, ControlsAreToldAsTheCameraTookThem) {
  serve();
  settings_.exposure_us = 1500.0;
  settings_.gain = 6.0;
  settings_.black_level = 2.0;
  settings_.frame_rate_hz = 40.0;
  settings_.gain_auto = "continuous";
  const std::unique_ptr<Camera> camera = open();
  EXPECT_THAT(camera->takeRemarks(), testing::ElementsAre(HasSubstr("no automatic gain")));
  CameraControls controls = camera->controls();
  EXPECT_EQ(controls.exposure_us, 1500.0);
  EXPECT_EQ(controls.gain, 6.0);
  EXPECT_EQ(controls.black_level, 2.0);
  EXPECT_NEAR(controls.frame_rate_hz.value_or(0.0), 40.0, 1e-6);
  EXPECT_EQ(controls.gain_auto, "");
  camera->start();
  CameraControls wanted;
  wanted.gain = 500.0;
  wanted.exposure_us = 3000.0;
  controls = camera->setControls(wanted);
  EXPECT_EQ(controls.gain, 24.0);
  EXPECT_EQ(controls.exposure_us, 3000.0);
  EXPECT_THAT(camera->takeRemarks(),
              testing::ElementsAre(testing::AllOf(HasSubstr("500"), HasSubstr("24"))));
  EXPECT_TRUE(next(camera.get()));
}

TEST_F(AravisCamera, FeaturesAreSetByName) {
  serve();
  settings_.features = {"BlackLevel=7", "NoSuchThing=1"};
  const std::unique_ptr<Camera> camera = open();
  EXPECT_EQ(camera->controls().black_level, 7.0);
  EXPECT_THAT(camera->takeRemarks(), testing::ElementsAre(HasSubstr("NoSuchThing")));
}

TEST_F(AravisCamera, EachTriggerIsOneFrame) {
  serve();
  settings_.trigger = "software";
  std::unique_ptr<Camera> camera = open();
  camera->start();
  EXPECT_EQ(camera->grab(milliseconds(300)), std::nullopt);
  for (int i = 0; i < 3; ++i) {
    camera->trigger();
    ASSERT_TRUE(next(camera.get())) << i;
    EXPECT_EQ(camera->grab(milliseconds(100)), std::nullopt);
  }
  EXPECT_EQ(scene_.stamps().size(), 3u);
  camera.reset();
  settings_.trigger = "line0";
  camera = open();
  camera->start();
  EXPECT_EQ(camera->grab(milliseconds(200)), std::nullopt);
  server_->pulseLine0();
  ASSERT_TRUE(next(camera.get()));
  EXPECT_EQ(scene_.stamps().size(), 4u);
  camera.reset();
  settings_.trigger = "line5";
  EXPECT_THAT(refusal(), testing::AllOf(HasSubstr("line5"), HasSubstr("Line0, Software")));
}

TEST_F(AravisCamera, LostPacketsNeverMakeAPartialImageAndCountersAddUp) {
  options_.frame_rate_hz = 200.0;
  options_.exposure_us = 100.0;
  options_.packet_resend = false;
  serve();
  settings_.packet_size = 576;  // some twenty packets a frame
  // Frames wait for the missing packets of those before them.
  settings_.buffers = 64;
  settings_.exposure_us = 100.0;
  const std::unique_ptr<Camera> camera = open();
  camera->start();
  ASSERT_TRUE(next(camera.get()));
  server_->setPacketLoss(0.01);
  std::uint64_t first = 0, last = 0, count = 0;
  // Frame numbers pass 65535 on the way.
  while (count < 250) {
    const std::optional<Frame> frame = next(camera.get());
    ASSERT_TRUE(frame);
    ASSERT_TRUE(equal(frame->image, scene_.image(frame->image.at<cv::Vec3b>(0, 0)[0])));
    if (count == 0) first = frame->sequence;
    EXPECT_GT(frame->sequence, last);
    last = frame->sequence;
    ++count;
  }
  server_->setPacketLoss(0.0);
  const CameraStatistics statistics = camera->statistics();
  const std::uint64_t gaps = last - first + 1 - count;
  EXPECT_GT(gaps, 0u);
  EXPECT_GT(statistics.incomplete, 0u);
  EXPECT_GT(statistics.missing_packets, 0u);
  // What did not arrive whole was noticed, but for frames of which no packet came at all.
  EXPECT_LE(statistics.incomplete, gaps + 2);
  EXPECT_GE(statistics.incomplete + statistics.underruns + 2, gaps)
      << statistics.incomplete << " " << statistics.underruns;
  // All is well again.
  const Steady::time_point end = Steady::now() + kLong;
  for (int row = 0; row < 30;) {
    ASSERT_LT(Steady::now(), end) << "frames still get lost";
    const std::optional<Frame> frame = next(camera.get());
    ASSERT_TRUE(frame);
    row = frame->sequence == last + 1 ? row + 1 : 0;
    last = frame->sequence;
  }
}

TEST_F(AravisCamera, LostPacketsAreAskedForAgain) {
  serve();
  settings_.packet_size = 576;
  settings_.buffers = 32;
  const std::unique_ptr<Camera> camera = open();
  camera->start();
  ASSERT_TRUE(next(camera.get()));
  server_->setPacketLoss(0.02);
  // Some twenty packets a frame: a third of the frames would come torn.
  constexpr int kFrames = 60;
  std::uint64_t first = 0, last = 0;
  for (int i = 0; i < kFrames; ++i) {
    const std::optional<Frame> frame = next(camera.get());
    ASSERT_TRUE(frame);
    ASSERT_TRUE(equal(frame->image, scene_.image(frame->image.at<cv::Vec3b>(0, 0)[0])));
    if (i == 0) first = frame->sequence;
    last = frame->sequence;
  }
  const CameraStatistics statistics = camera->statistics();
  EXPECT_GT(server_->packetsSentAgain(), 5u);
  EXPECT_GT(statistics.resent_packets, 5u);
  // Without asking again a frame in three would be missing; now only those whose packets were lost
  // several times over, or whose every packet was.
  EXPECT_LE(last - first, kFrames + 5u) << statistics.incomplete;
}

TEST_F(AravisCamera, ChunksTellTheExposureOfEveryFrame) {
  serve();
  settings_.ptp = true;
  settings_.chunks = true;
  const std::unique_ptr<Camera> camera = open();
  EXPECT_THAT(camera->takeRemarks(), testing::IsEmpty());
  EXPECT_THAT(camera->takeDetails(), testing::Not(testing::Contains(HasSubstr("chunk"))));
  camera->start();
  int changes = 0;
  for (int i = 0; i < 30; ++i) {
    const std::optional<Frame> frame = next(camera.get());
    ASSERT_TRUE(frame);
    const std::size_t index = frame->image.at<cv::Vec3b>(0, 0)[0];
    ASSERT_TRUE(equal(frame->image, scene_.image(index)));
    // The middle of an exposure whose length only the frame itself tells.
    EXPECT_EQ(frame->stamp, scene_.stamps().at(index));
    if (i % 5 == 4) server_->setExposure(2000.0 + 1000.0 * ++changes);
  }
  EXPECT_EQ(changes, 6);
}

TEST_F(AravisCamera, ACameraInOtherHandsIsBusy) {
  serve();
  const std::unique_ptr<Camera> camera = open();
  EXPECT_THAT(refusal(), HasSubstr("another program controls it"));
}

TEST_F(AravisCamera, ACameraThatIsNotThereIsToldWithThoseThatAre) {
  serve();
  EXPECT_THAT(refusal("aravis:nobody"), testing::AllOf(HasSubstr("nobody"), HasSubstr("T-1")));
  EXPECT_THAT(refusal("aravis:127.0.0.7"), HasSubstr("127.0.0.7"));
}

TEST_F(AravisCamera, AnyAddressOfTheLoopbackWillDo) {
  options_.interface = "127.0.0.9";
  options_.serial = "T-9";
  serve();
  for (const char* device : {"aravis:127.0.0.9", "aravis:T-9"}) {
    SCOPED_TRACE(device);
    const std::unique_ptr<Camera> camera = open(device);
    EXPECT_THAT(camera->statistics().link, HasSubstr("127.0.0.9"));
    camera->start();
    EXPECT_TRUE(next(camera.get()));
  }
}

TEST_F(AravisCamera, AnUnnamedCameraIsTakenWithAWarning) {
  serve();
  const std::unique_ptr<Camera> camera = open("aravis:");
  EXPECT_EQ(camera->identity().serial, "T-1");
  EXPECT_THAT(camera->takeRemarks(), testing::ElementsAre(HasSubstr("aravis:T-1")));
}

TEST(AravisSelection, ASerialNumberGoesBeforeAnAddressBeforeAModel) {
  const auto device = [](const char* vendor, const char* model, const char* serial,
                         const char* address) {
    AravisDevice d;
    d.id = std::string(vendor) + "-" + serial;
    d.physical = std::string("00:") + serial;
    d.address = address;
    d.protocol = "GigEVision";
    d.identity = {vendor, model, serial};
    return d;
  };
  const std::vector<AravisDevice> devices = {device("Acme", "Wide", "22", "10.0.0.3"),
                                             device("Acme", "Wide", "11", "10.0.0.2"),
                                             device("Beta", "Tele", "Wide", "10.0.0.4")};
  const auto serials = [&](const std::string& which) {
    std::string text;
    for (const AravisDevice& d : matchAravisDevices(devices, which))
      text += d.identity.serial + " ";
    return text;
  };
  EXPECT_EQ(serials("22"), "22 ");
  EXPECT_EQ(serials("10.0.0.2"), "11 ");
  EXPECT_EQ(serials("00:11"), "11 ");
  EXPECT_EQ(serials("acme-wide"), "11 22 ");
  EXPECT_EQ(serials("Acme-Wide-22"), "22 ");
  EXPECT_EQ(serials("WIDE"), "Wide ");
  EXPECT_EQ(serials("Tele"), "Wide ");
  EXPECT_EQ(serials("nobody"), "");
  EXPECT_EQ(serials(""), "11 22 Wide ");
}

TEST_F(AravisCamera, TwoCamerasStreamBesideEachOther) {
  if (!test::kOwnNetwork) GTEST_SKIP() << "no network of its own for a second address";
  serve();
  Scene other_scene({32, 24});
  GigeServerOptions other = options_;
  other.interface = "127.0.0.2";
  other.serial = "T-2";
  other.size = {32, 24};
  const GigeServer second(other, other_scene.draw());
  settings_.ptp = true;
  const std::unique_ptr<Camera> left = open("aravis:T-1");
  const std::unique_ptr<Camera> right = open("aravis:T-2");
  left->start();
  right->start();
  for (int i = 0; i < 10; ++i) {
    const std::optional<Frame> a = next(left.get()), b = next(right.get());
    ASSERT_TRUE(a && b);
    EXPECT_EQ(a->image.size(), cv::Size(64, 48));
    EXPECT_EQ(b->image.size(), cv::Size(32, 24));
  }
}

TEST_F(AravisCamera, TheSameCameraIsFoundAtAnotherAddress) {
  if (!test::kOwnNetwork) GTEST_SKIP() << "no network of its own for a second address";
  serve();
  // Aravis has seen it here, and remembers.
  std::unique_ptr<Camera> camera = open("aravis:T-1");
  settings_.identity = camera->identity();
  camera->abandon();
  camera.reset();
  // Another stands where it was, and it stands elsewhere.
  server_.reset();
  GigeServerOptions other = options_;
  other.serial = "T-9";
  Scene other_scene({64, 48});
  const GigeServer stranger(other, other_scene.draw());
  EXPECT_THAT(refusal(), testing::AllOf(HasSubstr("T-1"), HasSubstr("T-9")));
  EXPECT_THAT(refusal("aravis:T-1"), testing::AllOf(HasSubstr("T-1"), HasSubstr("T-9")));
  options_.interface = "127.0.0.2";
  serve();
  camera = open("aravis:127.0.0.1");
  EXPECT_EQ(camera->identity().serial, "T-1");
  EXPECT_THAT(camera->statistics().link, HasSubstr("127.0.0.2"));
  camera->start();
  EXPECT_TRUE(next(camera.get()));
}

/// Debian's own camera, which knows nothing of us.
class ForeignCamera : public AravisCamera {
 protected:
  static constexpr const char* kProgram = "arv-fake-gv-camera-0.8";
  void SetUp() override {
    if (!test::ChildProcess::installed(kProgram)) {
      GTEST_SKIP() << kProgram << " is not installed (aravis-tools)";
    }
    startForeign();
  }
  void startForeign() {
    foreign_ = std::make_unique<test::ChildProcess>(
        std::vector<std::string>{kProgram, "-i", "127.0.0.1", "-s", "F-1"});
  }
  std::unique_ptr<Camera> openPatiently() const {
    const Steady::time_point end = Steady::now() + kLong;
    while (true) {
      try {
        return open();
      } catch (const CameraError&) {
        if (Steady::now() > end) throw;
      }
    }
  }
  std::unique_ptr<test::ChildProcess> foreign_;
};

TEST_F(ForeignCamera, StreamsEveryFormat) {
  const struct {
    const char* format;
    const char* encoding;
  } cases[] = {
      {"Mono8", "mono8"},          {"Mono16", "mono16"},        {"RGB8", "rgb8"},
      {"BayerRG8", "bayer_rggb8"}, {"BayerGR8", "bayer_grbg8"}, {"BayerGB8", "bayer_gbrg8"},
      {"BayerBG8", "bayer_bggr8"}};
  settings_.size = {320, 240};
  settings_.frame_rate_hz = 50.0;
  for (const auto& test : cases) {
    SCOPED_TRACE(test.format);
    settings_.pixel_format = test.format;
    const std::unique_ptr<Camera> camera = openPatiently();
    EXPECT_EQ(camera->identity().vendor, "Aravis");
    camera->start();
    const std::optional<Frame> frame = next(camera.get());
    ASSERT_TRUE(frame);
    EXPECT_EQ(frame->encoding, test.encoding);
    EXPECT_EQ(frame->image.size(), settings_.size);
    // The clock of a camera without a latch is mapped by arrival.
    EXPECT_LT(std::abs((now() - frame->stamp).count()), 10000000000);
  }
}

TEST_F(ForeignCamera, AKilledCameraIsLostAndComesBack) {
  if (!test::fullTests()) GTEST_SKIP() << "runs with ./run test --full";
  std::unique_ptr<Camera> camera = openPatiently();
  settings_.identity = camera->identity();
  camera->start();
  ASSERT_TRUE(next(camera.get()));
  foreign_->end();
  const auto lost = [&] {
    const Steady::time_point end = Steady::now() + kLong;
    while (Steady::now() < end) {
      try {
        camera->grab(milliseconds(200));
      } catch (const CameraError& e) {
        return std::string(e.what());
      }
    }
    return std::string();
  };
  EXPECT_THAT(lost(), HasSubstr("no longer answers"));
  camera->abandon();
  // Closing a dead camera takes seconds, but not ours.
  camera.reset();
  startForeign();
  camera = openPatiently();
  camera->start();
  EXPECT_TRUE(next(camera.get()));
}

}  // namespace
}  // namespace omnister::device
