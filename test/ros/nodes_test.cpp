// SPDX-License-Identifier: Apache-2.0
// Node and nodelet as they are started by launch files.
#include <nodelet/loader.h>
#include <sensor_msgs/CameraInfo.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/PointCloud2.h>
#include <tf2_ros/buffer.h>
#include <tf2_ros/transform_listener.h>

#include <atomic>

#include "omnister/ros/callback_threads.h"
#include "omnister/ros/conversions.h"
#include "ros/ros_test.h"

namespace omnister {
namespace {

using test::Collector;
using test::eventually;

class RunningCamera : public testing::TestWithParam<const char*> {};

TEST_P(RunningCamera, ReplaysImagesLensAndStage) {
  const ros::NodeHandle node(GetParam());
  const std::string optical = std::string(GetParam()) + "_optical";
  const std::string base = std::string(GetParam()) + "_base";
  tf2_ros::Buffer buffer;
  const tf2_ros::TransformListener listener(buffer);
  Collector<LensModelMessage> lenses(node, "lens_model");
  Collector<sensor_msgs::CameraInfo> infos(node, "camera_info");
  Collector<StageState> states(node, "stage_state");
  Collector<sensor_msgs::Image> images(node, "image_raw");
  ASSERT_TRUE(eventually([&] {
    return images.size() >= 9 && infos.size() >= 9 && states.size() >= 9 && lenses.size() >= 1;
  }));
  const LensFile lens = fromLensModelMessage(*lenses.last(), "lens_model");
  EXPECT_EQ(lens.image_size, cv::Size(32, 24));
  EXPECT_EQ(lenses.last()->header.frame_id, optical);
  EXPECT_NEAR(infos.last()->K[0], 10.0, 1e-6);
  EXPECT_EQ(infos.last()->distortion_model, "equidistant");
  const auto got = images.messages();
  for (std::size_t i = 1; i < got.size(); ++i) {
    EXPECT_EQ(got[i]->header.frame_id, optical);
    // The recording begins again after its last frame, one interval later.
    EXPECT_EQ(got[i]->data[0], (got[i - 1]->data[0] + 1) % 4);
    EXPECT_NEAR((got[i]->header.stamp - got[i - 1]->header.stamp).toSec(), 0.05, 1e-6);
  }
  int settled = 0;
  for (const auto& state : states.messages()) {
    EXPECT_EQ(state->moving, state->position == 0.03);
    settled += state->moving ? 0 : 1;
  }
  EXPECT_GE(settled, 3);
  EXPECT_TRUE(
      eventually([&] { return buffer.canTransform(base, optical, images.last()->header.stamp); }));
}

INSTANTIATE_TEST_SUITE_P(NodeAndNodelet, RunningCamera, testing::Values("alone", "loaded"),
                         [](const auto& info) { return std::string(info.param); });

TEST(CallbackThreads, NoCallbackRunsOnceTheyAreStopped) {
  for (int round = 0; round < 20; ++round) {
    std::atomic<bool> runs{false};
    CallbackThreads callbacks(2);
    const ros::WallTimer timer =
        callbacks.on(ros::NodeHandle())
            .createWallTimer(ros::WallDuration(0.001), [&](const ros::WallTimerEvent&) {
              runs = true;
              ros::WallDuration(0.02).sleep();
              runs = false;
            });
    callbacks.start();
    ASSERT_TRUE(eventually([&] { return runs.load(); }));
    callbacks.stop();
    EXPECT_FALSE(runs);
  }
}

TEST(CameraNodelet, IsLoadedAndUnloadedWhileItStreams) {
  const std::string name = "/come_and_go/camera";
  ros::NodeHandle parameters(name);
  parameters.setParam("device", "replay:" OMNISTER_SOURCE_DIR "/test/data/replay");
  parameters.setParam("loop", true);
  nodelet::Loader loader(false);
  Collector<sensor_msgs::Image> images(ros::NodeHandle("/come_and_go"), "image_raw");
  for (int round = 0; round < 8; ++round) {
    const std::size_t before = images.size();
    ASSERT_TRUE(loader.load(name, "omnister/CameraNodelet", {}, {}));
    // Every other time it goes before its first frame.
    if (round % 2 == 0) {
      ASSERT_TRUE(eventually([&] { return images.size() > before; })) << round;
    }
    ASSERT_TRUE(loader.unload(name));
    ASSERT_TRUE(eventually([&] { return !images.connected(); })) << round;
  }
  EXPECT_TRUE(loader.listLoadedNodelets().empty());
}

TEST(StereoNodelet, IsLoadedAndUnloadedWhileSomebodyListens) {
  const std::string name = "/come_and_go/stereo";
  nodelet::Loader loader(false);
  Collector<sensor_msgs::PointCloud2> clouds(ros::NodeHandle("/come_and_go"), "points2");
  for (int round = 0; round < 8; ++round) {
    ASSERT_TRUE(loader.load(name, "omnister/StereoNodelet", {}, {}));
    if (round % 2 == 0) {
      ASSERT_TRUE(eventually([&] { return clouds.connected(); })) << round;
    }
    ASSERT_TRUE(loader.unload(name));
    ASSERT_TRUE(eventually([&] { return !clouds.connected(); })) << round;
  }
  ros::NodeHandle(name).setParam("matcher", "magic");
  EXPECT_FALSE(loader.load(name, "omnister/StereoNodelet", {}, {}));
}

TEST(CalibrationNodelet, IsLoadedAndUnloaded) {
  const std::string name = "/come_and_go/calibration";
  ros::NodeHandle parameters(name);
  nodelet::Loader loader(false);
  // The target is required.
  EXPECT_FALSE(loader.load(name, "omnister/CalibrationNodelet", {}, {}));
  parameters.setParam("target", OMNISTER_SOURCE_DIR "/config/demo/target.yaml");
  parameters.setParam("store", ::testing::TempDir());
  for (int round = 0; round < 8; ++round) {
    ASSERT_TRUE(loader.load(name, "omnister/CalibrationNodelet", {}, {})) << round;
    ASSERT_TRUE(loader.unload(name));
  }
}

TEST(ViewNodelet, IsLoadedAndUnloadedWhileSomebodyListens) {
  const std::string name = "/come_and_go/view_node";
  nodelet::Loader loader(false);
  Collector<sensor_msgs::Image> views(ros::NodeHandle("/come_and_go"), "view/image_raw");
  for (int round = 0; round < 8; ++round) {
    ASSERT_TRUE(loader.load(name, "omnister/ViewNodelet", {}, {}));
    if (round % 2 == 0) {
      ASSERT_TRUE(eventually([&] { return views.connected(); })) << round;
    }
    ASSERT_TRUE(loader.unload(name));
    ASSERT_TRUE(eventually([&] { return !views.connected(); })) << round;
  }
  ros::NodeHandle(name).setParam("hfov", -1.0);
  EXPECT_FALSE(loader.load(name, "omnister/ViewNodelet", {}, {}));
}

TEST(CameraNodelet, DoesNotStartWithBadParameters) {
  const std::string name = "/bad/camera";
  ros::NodeHandle(name).setParam("frame_rate", -5.0);
  nodelet::Loader loader(false);
  EXPECT_FALSE(loader.load(name, "omnister/CameraNodelet", {}, {}));
  // And the manager goes on.
  ros::NodeHandle(name).deleteParam("frame_rate");
  EXPECT_TRUE(loader.load(name, "omnister/CameraNodelet", {}, {}));
  EXPECT_TRUE(loader.unload(name));
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "nodes_test"); }
