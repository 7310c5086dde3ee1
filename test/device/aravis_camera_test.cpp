// SPDX-License-Identifier: Apache-2.0
#include "omnister/device/aravis_camera.h"

#include <gmock/gmock.h>

#include <atomic>
#include <map>
#include <mutex>
#include <thread>

#include "device/own_network.h"
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

/// Every frame is of one colour, which says which it was; remembers when each was exposed.
class Scene {
 public:
  explicit Scene(cv::Size size) : size_(size) {}
  sim::DrawFrame draw() {
    return [this](Stamp stamp) {
      const std::lock_guard<std::mutex> lock(mutex_);
      const auto index = static_cast<int>(stamps_.size());
      stamps_.push_back(stamp);
      cv::Mat image(size_, CV_8UC3);
      for (int y = 0; y < size_.height; ++y) {
        for (int x = 0; x < size_.width; ++x) {
          image.at<cv::Vec3b>(y, x) =
              cv::Vec3b(static_cast<std::uint8_t>(index), static_cast<std::uint8_t>(x),
                        static_cast<std::uint8_t>(y));
        }
      }
      return image;
    };
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

std::optional<Frame> next(Camera* camera) {
  const Steady::time_point end = Steady::now() + kLong;
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
  void serve() { server_ = std::make_unique<GigeServer>(options_, scene_.draw()); }

  GigeServerOptions options_;
  Scene scene_{{64, 48}};
  CameraSettings settings_;
  std::unique_ptr<GigeServer> server_;
};

TEST_F(AravisCamera, FramesTravelOverTheWireAsTheyWereDrawn) {
  serve();
  settings_.ptp = true;
  const std::unique_ptr<Camera> camera = openCamera("aravis:127.0.0.1", settings_);
  EXPECT_EQ(camera->identity().serial, "T-1");
  EXPECT_EQ(camera->identity().vendor, "OMNister");
  camera->start();
  std::optional<std::uint64_t> last;
  for (int i = 0; i < 20; ++i) {
    const std::optional<Frame> frame = next(camera.get());
    ASSERT_TRUE(frame);
    ASSERT_EQ(frame->image.size(), options_.size);
    ASSERT_EQ(frame->image.type(), CV_8UC3);
    EXPECT_EQ(frame->encoding, "bgr8");
    const std::vector<Stamp> stamps = scene_.stamps();
    const cv::Vec3b pixel = frame->image.at<cv::Vec3b>(31, 17);
    ASSERT_LT(pixel[0], stamps.size());
    EXPECT_EQ(pixel[1], 17);
    EXPECT_EQ(pixel[2], 31);
    // Both clocks are the host's.
    EXPECT_EQ(frame->stamp, stamps[pixel[0]]);
    if (last) {
      EXPECT_GT(frame->sequence, *last);
    }
    last = frame->sequence;
  }
  const CameraStatistics statistics = camera->statistics();
  EXPECT_GE(statistics.complete, 20u);
  EXPECT_EQ(statistics.incomplete, 0u);
  EXPECT_EQ(statistics.temperature_c, 41.0);
  EXPECT_THAT(statistics.link, HasSubstr("127.0.0.1"));
  EXPECT_THAT(camera->takeRemarks(), testing::IsEmpty());
}

}  // namespace
}  // namespace omnister::device
