// SPDX-License-Identifier: Apache-2.0
// Node and nodelet as they are started by launch files.
#include <XmlRpcClient.h>
#include <nodelet/loader.h>
#include <omnister/CalibrateAction.h>
#include <ros/network.h>
#include <sensor_msgs/CameraInfo.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/PointCloud2.h>
#include <signal.h>
#include <tf2_ros/buffer.h>
#include <tf2_ros/transform_broadcaster.h>
#include <tf2_ros/transform_listener.h>

#include <atomic>
#include <thread>

#include "omnister/lens/lens_file.h"
#include "ros/message/conversions.h"
#include "ros/node/callback_threads.h"
#include "ros/ros_test.h"

namespace omnister {
namespace {

using test::Collector;
using test::eventually;

/// Of a node, asked of itself; 0 when it does not answer.
pid_t processOf(const std::string& name) {
  XmlRpc::XmlRpcValue arguments, result, payload;
  arguments[0] = ros::this_node::getName();
  arguments[1] = name;
  std::string host;
  std::uint32_t port = 0;
  if (!ros::master::execute("lookupNode", arguments, result, payload, false) ||
      !ros::network::splitURI(payload, host, port))
    return 0;
  XmlRpc::XmlRpcValue caller;
  caller[0] = ros::this_node::getName();
  XmlRpc::XmlRpcClient client(host.c_str(), static_cast<int>(port), "/");
  if (!client.execute("getPid", caller, result) || client.isFault()) return 0;
  return static_cast<int>(result[2]);
}

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

/// All that a nodelet in the namespace /busy can hear, far faster than any rig says it.
class Flood {
 public:
  Flood() : node_("/busy") {
    images_ = node_.advertise<sensor_msgs::Image>("image_raw", 10);
    ranges_ = node_.advertise<sensor_msgs::Image>("range", 10);
    lenses_ = node_.advertise<LensModelMessage>("lens_model", 10);
    goals_ = node_.advertise<CalibrateActionGoal>("calibrate/goal", 10);
    thread_ = std::thread([this] { run(); });
  }
  ~Flood() {
    stop_ = true;
    thread_.join();
  }

 private:
  void run() {
    std_msgs::Header header;
    header.frame_id = "busy_optical";
    LensFile lens = readLensFile(OMNISTER_SOURCE_DIR "/test/data/replay/lens.yaml");
    for (int i = 0; !stop_; ++i) {
      header.stamp = ros::Time::now();
      const Pose place(Eigen::Translation3d(0.02 * (i / 8 % 2), 0.0, 0.0));
      transforms_.sendTransform(
          toTransformStamped(place, header.stamp, "busy_base", header.frame_id));
      sensor_msgs::ImagePtr image =
          toImage(cv::Mat(lens.image_size, CV_8UC1, cv::Scalar(i % 256)), "mono8");
      image->header = header;
      images_.publish(image);
      sensor_msgs::ImagePtr range =
          toImage(cv::Mat(lens.image_size, CV_32FC1, cv::Scalar(1.0)), "32FC1");
      range->header = header;
      ranges_.publish(range);
      if (i % 4 == 0) {
        lens.camera_name = "lens" + std::to_string(i);
        lenses_.publish(toLensModelMessage(lens, header));
      }
      if (i % 16 == 0) goals_.publish(CalibrateActionGoal());
      ros::WallDuration(0.001).sleep();
    }
  }

  ros::NodeHandle node_;
  ros::Publisher images_, ranges_, lenses_, goals_;
  tf2_ros::TransformBroadcaster transforms_;
  std::atomic<bool> stop_{false};
  std::thread thread_;
};

/// Loads and unloads a nodelet many times while all its inputs come in and somebody listens to
/// what it makes of them; mostly it goes as soon as it is there.
template <typename Output>
void comeAndGo(const std::string& name, const std::string& type, const std::string& output,
               int rounds = 100) {
  nodelet::Loader loader(false);
  const Flood flood;
  Collector<Output> outputs(ros::NodeHandle("/busy"), output);
  for (int round = 0; round < rounds; ++round) {
    const std::size_t before = outputs.size();
    ASSERT_TRUE(loader.load(name, type, {}, {})) << round;
    if (round % 10 == 0) {
      ASSERT_TRUE(eventually([&] { return outputs.size() > before; })) << round;
    }
    ASSERT_TRUE(loader.unload(name)) << round;
    outputs.clear();
  }
  EXPECT_TRUE(loader.listLoadedNodelets().empty());
  EXPECT_TRUE(eventually([&] { return !outputs.connected(); }));
}

TEST(CameraNodelet, ComesAndGoesAHundredTimes) {
  ros::NodeHandle parameters("/busy/camera");
  parameters.setParam("device", "replay:" OMNISTER_SOURCE_DIR "/test/data/replay");
  parameters.setParam("loop", true);
  parameters.setParam("frame_id", "busy_optical");
  // The flood speaks on image_raw too.
  comeAndGo<sensor_msgs::CameraInfo>("/busy/camera", "omnister/CameraNodelet", "camera_info");
}

TEST(StereoNodelet, ComesAndGoesAHundredTimes) {
  ros::NodeHandle parameters("/busy/stereo");
  parameters.setParam("fixed_frame", "busy_base");
  parameters.setParam("settle_time", 0.0);
  comeAndGo<sensor_msgs::PointCloud2>("/busy/stereo", "omnister/StereoNodelet", "points2");
  parameters.setParam("matcher", "magic");
  EXPECT_FALSE(nodelet::Loader(false).load("/busy/stereo", "omnister/StereoNodelet", {}, {}));
  // Else it would not load when the test is run again with the same master.
  parameters.deleteParam("matcher");
}

TEST(CalibrationNodelet, ComesAndGoesAHundredTimes) {
  ros::NodeHandle parameters("/busy/calibration");
  // The target is required.
  EXPECT_FALSE(
      nodelet::Loader(false).load("/busy/calibration", "omnister/CalibrationNodelet", {}, {}));
  parameters.setParam("target", OMNISTER_SOURCE_DIR "/config/demo/target.yaml");
  parameters.setParam("store", ::testing::TempDir());
  comeAndGo<CalibrateActionFeedback>("/busy/calibration", "omnister/CalibrationNodelet",
                                     "calibrate/feedback");
}

TEST(ViewNodelet, ComesAndGoesAHundredTimes) {
  comeAndGo<sensor_msgs::Image>("/busy/view_node", "omnister/ViewNodelet", "view/image_raw");
  comeAndGo<sensor_msgs::Image>("/busy/view_node", "omnister/ViewNodelet", "view/depth/image_raw",
                                20);
  ros::NodeHandle parameters("/busy/view_node");
  parameters.setParam("hfov", -1.0);
  EXPECT_FALSE(nodelet::Loader(false).load("/busy/view_node", "omnister/ViewNodelet", {}, {}));
  parameters.deleteParam("hfov");
}

TEST(NodeletManager, GetsItsNodeletsBackAfterItWasKilled) {
  Collector<sensor_msgs::Image> images(ros::NodeHandle("/loaded"), "image_raw");
  for (int round = 0; round < 2; ++round) {
    ASSERT_TRUE(eventually([&] { return images.size() > 3; }, 60.0)) << round;
    pid_t killed = 0;
    ASSERT_TRUE(eventually([&] { return (killed = processOf("/manager")) > 0; }, 60.0));
    ASSERT_EQ(kill(killed, SIGKILL), 0);
    ASSERT_TRUE(eventually([&] { return kill(killed, 0) != 0; }, 60.0));
    images.clear();
  }
  EXPECT_TRUE(eventually([&] { return images.size() > 3; }, 60.0));
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
