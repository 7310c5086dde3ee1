// SPDX-License-Identifier: Apache-2.0
#include "ros/sim/sim_rig.h"

#include <actionlib/client/simple_action_client.h>
#include <sensor_msgs/Image.h>
#include <tf2_ros/buffer.h>
#include <tf2_ros/transform_listener.h>

#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>

#include "ros/message/conversions.h"
#include "ros/rig_drivers.h"
#include "ros/ros_test.h"

namespace omnister {
namespace {

using test::Collector;
using test::eventually;

const std::string kSource = OMNISTER_SOURCE_DIR;

SimRigParameters rigParameters() {
  SimRigParameters parameters;
  parameters.scene = kSource + "/config/scenes/room.yaml";
  parameters.lens = kSource + "/test/data/replay/lens.yaml";
  parameters.stage.homed = true;
  parameters.stage.start_m = 0.0;
  parameters.camera.frame_rate_hz = 20.0;
  return parameters;
}

/// The first image that was taken after a time.
cv::Mat imageAfter(const Collector<sensor_msgs::Image>& images, const ros::Time& time) {
  EXPECT_TRUE(
      eventually([&] { return images.last() && images.last()->header.stamp > time; }, 60.0));
  return toMat8(images.last(), true).clone();
}

TEST(SimRig, TheCameraSeesTheSceneFromWhereTheStageStands) {
  ros::NodeHandle node("rig"), private_node("~rig");
  const SimRigParameters parameters = rigParameters();
  test::RigWithDrivers rig(node, private_node, parameters);
  Collector<sensor_msgs::Image> images(node, "camera/image_raw");
  tf2_ros::Buffer buffer;
  const tf2_ros::TransformListener listener(buffer);
  actionlib::SimpleActionClient<MoveStageAction> client(node, "stage/move_stage", false);
  ASSERT_TRUE(client.waitForServer(ros::Duration(60.0)));
  const auto moveTo = [&](double position) {
    MoveStageGoal goal;
    goal.position = position;
    goal.speed = 0.2;
    client.sendGoal(goal);
    EXPECT_TRUE(client.waitForResult(ros::Duration(60.0)));
    EXPECT_TRUE(client.getResult()->success) << client.getResult()->message;
  };

  const sim::ScenePtr scene = sim::readScene(parameters.scene);
  const LensFile lens = readLensFile(parameters.lens);
  int compared = 0;
  for (const double position : {0.0, 0.2, 0.05}) {
    moveTo(position);
    const cv::Mat seen = imageAfter(images, ros::Time::now());
    // A positive position is to the right: along x of the optical frame.
    // Its controller counts whole microsteps.
    const double truth = rig.rig().stage().truePosition(device::now());
    EXPECT_NEAR(truth, position, 1e-6);
    const Pose pose(Eigen::Translation3d(truth, 0.0, 0.0));
    const cv::Mat expected =
        sim::render(*scene, *lens.lens, lens.image_size, pose, parameters.render).image;
    EXPECT_LE(cv::norm(seen, expected, cv::NORM_INF), 1.0) << position;
    const cv::Mat elsewhere =
        sim::render(*scene, *lens.lens, lens.image_size,
                    Pose(Eigen::Translation3d(position + 0.1, 0.0, 0.0)), parameters.render)
            .image;
    EXPECT_GT(cv::norm(seen, elsewhere, cv::NORM_INF), 10.0);
    // And tf says the same.
    const ros::Time stamp = images.last()->header.stamp;
    ASSERT_TRUE(eventually(
        [&] { return buffer.canTransform("stage_base", "camera_optical", stamp); }, 60.0));
    const Pose T_base_optical = fromTransform(
        buffer.lookupTransform("stage_base", "camera_optical", stamp).transform, "tf");
    EXPECT_NEAR((opticalInLink().inverse() * T_base_optical).translation().x(), position, 1e-6);
    ++compared;
  }
  EXPECT_EQ(compared, 3);
}

TEST(SimRig, WhileMovingTheImageBelongsToTheMiddleOfItsExposure) {
  ros::NodeHandle node("moving"), private_node("~moving");
  const SimRigParameters parameters = rigParameters();
  const test::RigWithDrivers rig(node, private_node, parameters);
  Collector<sensor_msgs::Image> images(node, "camera/image_raw");
  tf2_ros::Buffer buffer;
  const tf2_ros::TransformListener listener(buffer);
  actionlib::SimpleActionClient<MoveStageAction> client(node, "stage/move_stage", false);
  ASSERT_TRUE(client.waitForServer(ros::Duration(60.0)));
  ASSERT_TRUE(eventually([&] { return images.size() > 0; }, 60.0));
  MoveStageGoal goal;
  goal.position = 0.3;
  goal.speed = 0.15;
  client.sendGoal(goal);
  ASSERT_TRUE(client.waitForResult(ros::Duration(60.0)));

  const sim::ScenePtr scene = sim::readScene(parameters.scene);
  const LensFile lens = readLensFile(parameters.lens);
  int compared = 0;
  for (const auto& image : images.messages()) {
    if (!buffer.canTransform("stage_base", "camera_optical", image->header.stamp)) continue;
    const Pose T_base_optical = fromTransform(
        buffer.lookupTransform("stage_base", "camera_optical", image->header.stamp).transform,
        "tf");
    const Pose pose = opticalInLink().inverse() * T_base_optical;
    const double position = pose.translation().x();
    if (position < 0.03 || position > 0.27) continue;
    const Pose there(Eigen::Translation3d(position, 0.0, 0.0));
    const cv::Mat expected =
        sim::render(*scene, *lens.lens, lens.image_size, there, parameters.render).image;
    // Straight lines between the readings are within micrometres of the motion.
    EXPECT_LT(cv::norm(toMat8(image, true), expected, cv::NORM_L1) /
                  static_cast<double>(expected.total() * 3),
              0.5)
        << position;
    ++compared;
  }
  EXPECT_GE(compared, 5);
}

TEST(SimRig, RefusesParametersAndFilesByName) {
  ros::NodeHandle private_node("~refused");
  private_node.setParam("supersampling", 100);
  EXPECT_THROW(loadSimRigParameters(private_node), InputError);
  private_node.deleteParam("supersampling");
  SimRigParameters parameters = rigParameters();
  parameters.scene = "/none.yaml";
  EXPECT_THROW(SimRig(private_node, parameters), Error);
  parameters = rigParameters();
  parameters.lens = parameters.scene;
  EXPECT_THROW(SimRig(private_node, parameters), Error);
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "sim_rig_test"); }
