// SPDX-License-Identifier: Apache-2.0
#include <gmock/gmock.h>

#include <cmath>
#include <opencv2/imgproc.hpp>

#include "omnister/common/image_file.h"
#include "omnister/common/image_motion.h"
#include "omnister/device/replay_camera.h"
#include "ros/message/conversions.h"
#include "ros/rendered_views.h"
#include "ros/rig_drivers.h"
#include "ros/ros_test.h"
#include "ros/scan/scan_server.h"
#include "ros/stereo/stereo_pipeline.h"

namespace omnister {
namespace {

using actionlib::SimpleClientGoalState;
using test::Collector;
using test::eventually;
using testing::HasSubstr;
using Client = actionlib::SimpleActionClient<ScanAction>;

const std::string kSource = OMNISTER_SOURCE_DIR;

TEST(ImageMotion, IsTheShiftOfThePicture) {
  cv::Mat noise(480, 640, CV_8UC1), picture;
  cv::theRNG().state = 5;
  cv::randu(noise, 0, 255);
  cv::GaussianBlur(noise, picture, {}, 3.0);
  cv::normalize(picture, picture, 0, 255, cv::NORM_MINMAX);
  int checked = 0;
  for (const double shift : {0.0, 0.3, 1.0, 3.0}) {
    cv::Mat moved;
    const cv::Mat map = (cv::Mat_<double>(2, 3) << 1, 0, shift, 0, 1, 0);
    cv::warpAffine(picture, moved, map, picture.size(), cv::INTER_CUBIC, cv::BORDER_REFLECT);
    const std::optional<double> motion = imageMotion(picture, moved);
    ASSERT_TRUE(motion);
    EXPECT_NEAR(*motion, shift, 0.1);
    ++checked;
  }
  EXPECT_EQ(checked, 4);
  cv::Mat other(480, 640, CV_8UC1), another;
  cv::randu(other, 0, 255);
  cv::GaussianBlur(other, another, {}, 3.0);
  cv::normalize(another, another, 0, 255, cv::NORM_MINMAX);
  EXPECT_GT(imageMotion(picture, another).value_or(0.0), 5.0) << "another picture altogether";
  const cv::Mat wall(480, 640, CV_8UC1, cv::Scalar(128));
  EXPECT_FALSE(imageMotion(wall, wall));
  EXPECT_FALSE(imageMotion(picture, picture.rowRange(0, 100)));
}

TEST(ScanGoal, BecomesStopsOrASweep) {
  ScanGoal goal;
  goal.positions = {0.1, 0.05, 0.2};
  EXPECT_EQ(stopsOf(goal), goal.positions);
  goal.positions.clear();
  goal.start = 0.3;
  goal.stop = 0.0;
  goal.step = 0.1;
  EXPECT_THAT(stopsOf(goal), testing::Pointwise(testing::DoubleNear(1e-12), {0.3, 0.2, 0.1, 0.0}));
  goal.step = 0.0;
  EXPECT_TRUE(stopsOf(goal).empty());
  int refused = 0;
  for (int i = 0; i < 7; ++i) {
    ScanGoal bad;
    bad.stop = 0.3;
    if (i == 0) bad.stop = 0.0;
    if (i == 1) bad.step = -0.1;
    if (i == 2) bad.start = std::nan("");
    if (i == 3) bad.speed = -1.0;
    if (i == 4) bad.positions = {0.1, INFINITY};
    if (i == 5) bad.step = 1e-9;
    if (i == 6) bad.frames = 4294967295u;
    EXPECT_THROW(stopsOf(bad), InputError) << i;
    ++refused;
  }
  EXPECT_EQ(refused, 7);
}

class Scan : public testing::Test {
 protected:
  void SetUp() override {
    SimRigParameters parameters;
    parameters.scene = kSource + "/config/scenes/room.yaml";
    parameters.lens = lens_;
    parameters.stage.homed = true;
    parameters.stage.start_m = 0.0;
    parameters.stage.acceleration_mps2 = 2.0;
    parameters.camera.frame_rate_hz = frame_rate_;
    rig_ = std::make_unique<test::RigWithDrivers>(node_, ros::NodeHandle("~rig"), parameters);
    ScanParameters scan;
    scan.stop_timeout_s = 60.0;
    scan.max_wait_s = 10.0;
    scan.folder = folder_.path();
    scan_ = std::make_unique<ScanServer>(node_, scan);
    ASSERT_TRUE(client_.waitForServer(ros::Duration(60.0)));
    ASSERT_TRUE(eventually([&] { return frames_.connected() && settled_.connected(); }, 60.0));
    ASSERT_TRUE(eventually([&] { return states_.last() && states_.last()->fault.empty(); }, 60.0));
  }

  SimpleClientGoalState run(const ScanGoal& goal) {
    client_.sendGoal(goal);
    EXPECT_TRUE(client_.waitForResult(ros::Duration(120.0)));
    return client_.getState();
  }
  /// Where the carriage truly was.
  double truth(const StageFrame& frame) {
    return rig_->rig().stage().truePosition(
        device::Stamp(std::chrono::nanoseconds(frame.header.stamp.toNSec())));
  }

  std::string lens_ = kSource + "/test/data/replay/lens.yaml";
  double frame_rate_ = 20.0;
  ros::NodeHandle node_{"scan_rig"};
  // The scan takes what the drivers of the rig say, as by the remappings of scan.launch.
  std::unique_ptr<test::RigWithDrivers> rig_;
  std::unique_ptr<ScanServer> scan_;
  Client client_{node_, "scan", false};
  Collector<StageFrame> frames_{node_, "stage_frames"};
  Collector<StageState> states_{node_, "stage/stage_state"};
  Collector<sensor_msgs::Image> settled_{node_, "scan/image_raw"};
  test::TemporaryFolder folder_;
};

TEST_F(Scan, TagsImagesAtStopsAndKeepsThemAsARecording) {
  ScanGoal goal;
  goal.start = 0.0;
  goal.stop = 0.2;
  goal.step = 0.1;
  goal.speed = 0.1;
  goal.frames = 2;
  goal.folder = (folder_.path() / "scan").string();
  ASSERT_EQ(run(goal), SimpleClientGoalState::SUCCEEDED) << client_.getResult()->message;
  const ScanResultConstPtr result = client_.getResult();
  EXPECT_TRUE(result->success);
  EXPECT_GE(result->settled, 6u);
  EXPECT_GT(result->frames, result->settled) << "those in motion are tagged too";
  ASSERT_TRUE(eventually([&] { return frames_.size() == result->frames; }, 60.0));
  ASSERT_TRUE(eventually([&] { return settled_.size() == result->settled; }, 60.0));
  int settled = 0, moving = 0;
  for (const auto& frame : frames_.messages()) {
    EXPECT_EQ(frame->header.frame_id, "camera_optical");
    EXPECT_EQ(frame->scan, frames_.last()->scan);
    // In motion the position is that of the line between two readings.
    EXPECT_NEAR(frame->position, truth(*frame), frame->settled ? 2e-6 : 2e-3);
    if (frame->settled) {
      EXPECT_NEAR(frame->position, 0.1 * frame->index, 1e-5);
      ++settled;
    } else if (std::abs(frame->velocity) > 0.05) {
      ++moving;
    }
  }
  EXPECT_GE(settled, 6);
  EXPECT_GE(moving, 1);
  // What is kept is what a replayed camera and `calibrate-scan` read.
  const device::Recording recording = device::readRecording(goal.folder);
  ASSERT_EQ(recording.frames.size(), 6u);
  for (std::size_t i = 0; i < recording.frames.size(); ++i) {
    EXPECT_NEAR(*recording.frames[i].stage_position_m, 0.1 * static_cast<double>(i / 2), 1e-5);
    EXPECT_TRUE(*recording.frames[i].settled);
    EXPECT_EQ(readImage(recording.frames[i].image).channels(), 3);
  }
  EXPECT_EQ(run(goal), SimpleClientGoalState::ABORTED) << "the folder is full";
  EXPECT_THAT(client_.getResult()->message, HasSubstr("not empty"));
  for (const char* elsewhere : {"/tmp/omnister_elsewhere", "../elsewhere", "a/../../elsewhere"}) {
    goal.folder = elsewhere;
    EXPECT_EQ(run(goal), SimpleClientGoalState::ABORTED);
    EXPECT_THAT(client_.getResult()->message, HasSubstr("folder"));
    EXPECT_FALSE(std::filesystem::exists(folder_.path() / elsewhere));
  }

  goal.positions = {0.1, 0.31};
  goal.folder.clear();
  EXPECT_EQ(run(goal), SimpleClientGoalState::ABORTED);
  EXPECT_THAT(client_.getResult()->message, HasSubstr("0.31 m"));
}

TEST_F(Scan, SweepsTagImagesInMotion) {
  ScanGoal goal;
  goal.start = 0.02;
  goal.stop = 0.25;
  goal.speed = 0.06;
  goal.folder = (folder_.path() / "sweep").string();
  // Somebody says of the stage what cannot be.
  ros::Publisher liar = node_.advertise<StageState>("stage/stage_state", 10);
  int lies = 0;
  const ros::WallTimer lying =
      node_.createWallTimer(ros::WallDuration(0.02), [&](const ros::WallTimerEvent&) {
        StageState lie;
        lie.header.stamp = ros::Time::now();
        lie.position = ++lies % 2 == 0 ? std::nan("") : 1e300;
        lie.homed = true;
        liar.publish(lie);
      });
  ASSERT_EQ(run(goal), SimpleClientGoalState::SUCCEEDED) << client_.getResult()->message;
  const device::Recording recording = device::readRecording(goal.folder);
  ASSERT_GE(recording.frames.size(), 3u);
  EXPECT_EQ(recording.frames.size(), client_.getResult()->frames);
  int moving = 0;
  for (const auto& frame : recording.frames) {
    const double position = *frame.stage_position_m;
    EXPECT_GE(position, 0.02 - 1e-4);
    EXPECT_LE(position, 0.25 + 1e-4);
    if (position > 0.04 && position < 0.23) {
      EXPECT_FALSE(*frame.settled);
      EXPECT_NEAR(position, rig_->rig().stage().truePosition(*frame.stamp), 2e-3);
      ++moving;
    }
  }
  EXPECT_GE(moving, 2);
  EXPECT_GE(lies, 20);
}

/// With images that are large enough to be matched.
class ScanOfTheRoom : public Scan {
 protected:
  ScanOfTheRoom() {
    lens_ = (folder_.path() / "lens.yaml").string();
    frame_rate_ = 5.0;
    writeLensFile(lens_, test::lensFile());
  }
};

TEST_F(ScanOfTheRoom, FeedsTheStereoNode) {
  ros::NodeHandle private_node("~scan_stereo");
  private_node.setParam("lens", lens_);
  private_node.setParam("min_baseline", 0.05);
  private_node.setParam("max_baseline", 0.15);
  private_node.setParam("max_range", 20.0);
  // Its images are those of the scan on which all stood still.
  const ros::NodeHandle scan_node(node_, "scan");
  const StereoPipeline stereo(scan_node, private_node);
  Collector<sensor_msgs::Image> ranges(scan_node, "range");
  ScanGoal goal;
  goal.positions = {0.0, 0.1, 0.2};
  goal.speed = 0.1;
  // The first images may come before tf and images of the rig are heard.
  for (int run_number = 0; run_number < 5 && ranges.size() == 0; ++run_number) {
    ASSERT_EQ(run(goal), SimpleClientGoalState::SUCCEEDED) << client_.getResult()->message;
    eventually([&] { return ranges.size() > 0; }, 5.0);
  }
  ASSERT_GT(ranges.size(), 0u);
  const sensor_msgs::Image& message = *ranges.last();
  EXPECT_EQ(message.header.frame_id, "camera_optical");
  const double x = rig_->rig().stage().truePosition(
      device::Stamp(std::chrono::nanoseconds(message.header.stamp.toNSec())));
  const cv::Mat truth = test::roomFrom(x).range;
  const cv::Mat range(static_cast<int>(message.height), static_cast<int>(message.width), CV_32FC1,
                      const_cast<std::uint8_t*>(message.data.data()), message.step);
  ASSERT_EQ(range.size(), truth.size());
  double share = 0.0;
  EXPECT_LT(test::medianError(range, truth, &share), 0.02);
  EXPECT_GT(share, 0.5);
}

TEST_F(Scan, CancelReallyStopsTheStage) {
  ScanGoal goal;
  goal.stop = 0.3;
  goal.speed = 0.02;
  client_.sendGoal(goal);
  ASSERT_TRUE(
      eventually([&] { return states_.last()->moving && states_.last()->position > 1e-3; }, 60.0));
  client_.cancelGoal();
  ASSERT_TRUE(client_.waitForResult(ros::Duration(60.0)));
  EXPECT_EQ(client_.getState(), SimpleClientGoalState::PREEMPTED);
  EXPECT_FALSE(rig_->rig().stage().read().moving);
  EXPECT_LT(rig_->rig().stage().read().position_m, 0.29);
  // And the node goes down in the middle of the next.
  client_.sendGoal(goal);
  ASSERT_TRUE(eventually([&] { return rig_->rig().stage().read().moving; }, 60.0));
  scan_.reset();
  EXPECT_TRUE(eventually([&] { return !rig_->rig().stage().read().moving; }, 60.0));
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) {
  ros::M_string remappings;
  testing::InitGoogleTest(&argc, argv);
  // As scan.launch does.
  remappings["/scan_rig/image_raw"] = "/scan_rig/camera/image_raw";
  remappings["/scan_rig/stage_state"] = "/scan_rig/stage/stage_state";
  for (const char* part : {"goal", "cancel", "feedback", "result", "status"}) {
    remappings[std::string("/scan_rig/move_stage/") + part] =
        std::string("/scan_rig/stage/move_stage/") + part;
  }
  remappings["__name"] = "scan_test";
  ros::init(remappings, "scan_test");
  const ros::NodeHandle keep;
  ros::AsyncSpinner spinner(4);
  spinner.start();
  return RUN_ALL_TESTS();
}
