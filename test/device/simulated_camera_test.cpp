// SPDX-License-Identifier: Apache-2.0
#include "omnister/sim/simulated_camera.h"

#include <gtest/gtest.h>

#include <opencv2/core.hpp>

#include "omnister/lens/lens_models.h"

namespace omnister::sim {
namespace {

using std::chrono::milliseconds;

class SimulatedCameraTest : public testing::Test {
 protected:
  SimulatedCameraTest() : scene_(readScene(OMNISTER_SOURCE_DIR "/config/scenes/room.yaml")) {
    LensStructure structure;
    structure.model = "conic";
    options_.lens = makeLens(structure, Eigen::Vector2d(15.5, 11.5), 10.0, 1.5);
    options_.size = {32, 24};
    options_.frame_rate_hz = 100.0;
    options_.render.supersampling = 1;
  }

  std::unique_ptr<device::Camera> open() {
    return makeSimulatedCamera(
        options_, [this](Stamp) { return scene_; },
        [this](Stamp time) {
          asked_.push_back(time);
          return Pose(Eigen::Translation3d(0.01 * static_cast<double>(asked_.size()), 0.0, 0.0));
        });
  }

  ScenePtr scene_;
  SimulatedCameraOptions options_;
  std::vector<Stamp> asked_;
};

TEST_F(SimulatedCameraTest, EveryFrameIsRenderedFromWhereTheCameraWasAtItsStamp) {
  const auto camera = open();
  EXPECT_FALSE(camera->grab(milliseconds(1))) << "not started";
  camera->start();
  for (int i = 1; i <= 5; ++i) {
    std::optional<device::Frame> frame;
    while (!frame) frame = camera->grab(milliseconds(100));
    ASSERT_EQ(asked_.size(), static_cast<std::size_t>(i));
    EXPECT_EQ(frame->stamp, asked_.back());
    EXPECT_EQ(frame->sequence, static_cast<std::uint64_t>(i));
    EXPECT_EQ(frame->encoding, "bgr8");
    RenderOptions render = options_.render;
    render.seed += frame->sequence;
    const cv::Mat expected = sim::render(*scene_, *options_.lens, options_.size,
                                         Pose(Eigen::Translation3d(0.01 * i, 0.0, 0.0)), render)
                                 .image;
    EXPECT_EQ(cv::norm(frame->image, expected, cv::NORM_INF), 0.0);
  }
  camera->stop();
  EXPECT_FALSE(camera->grab(milliseconds(1)));
}

TEST_F(SimulatedCameraTest, NoiseDiffersFromFrameToFrame) {
  options_.render.noise_sigma = 5.0;
  const auto camera = makeSimulatedCamera(
      options_, [this](Stamp) { return scene_; }, [](Stamp) { return Pose::Identity(); });
  camera->start();
  std::vector<cv::Mat> images;
  while (images.size() < 2) {
    if (auto frame = camera->grab(milliseconds(100))) images.push_back(frame->image);
  }
  EXPECT_GT(cv::norm(images[0], images[1], cv::NORM_L1), 0.0);
}

TEST_F(SimulatedCameraTest, RefusesNonsenseOptions) {
  options_.frame_rate_hz = 0.0;
  EXPECT_THROW(open(), InputError);
  options_.frame_rate_hz = 10.0;
  options_.exposure_s = -1.0;
  EXPECT_THROW(open(), InputError);
  options_.exposure_s = 0.01;
  options_.lens = nullptr;
  EXPECT_THROW(open(), InputError);
}

}  // namespace
}  // namespace omnister::sim
