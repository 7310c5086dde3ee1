// SPDX-License-Identifier: Apache-2.0
// The stage node as a process of its own, with simulated Zaber and GRBL controllers on its serial
// port.
#include <gmock/gmock.h>
#include <sensor_msgs/JointState.h>
#include <signal.h>
#include <std_msgs/Float64.h>
#include <sys/wait.h>
#include <tf2_ros/transform_broadcaster.h>
#include <unistd.h>

#include <cmath>

#include "omnister/sim/serial_devices.h"
#include "ros/message/conversions.h"
#include "ros/stage_client.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

using test::Collector;
using test::eventually;
using test::SimpleClientGoalState;
using testing::HasSubstr;

/// A stage_node in a namespace of its own.
class NodeProcess {
 public:
  NodeProcess(const std::string& name, const std::vector<std::string>& parameters) {
    std::vector<std::string> arguments = {OMNISTER_STAGE_NODE, "__ns:=/" + name, "__name:=driver"};
    for (const std::string& parameter : parameters) arguments.push_back("_" + parameter);
    std::vector<char*> pointers;
    for (std::string& argument : arguments) pointers.push_back(argument.data());
    pointers.push_back(nullptr);
    pid_ = fork();
    if (pid_ == 0) {
      execv(pointers[0], pointers.data());
      _exit(127);
    }
  }
  ~NodeProcess() {
    if (pid_ > 0) end(SIGKILL);
  }
  /// Exit code; 128 + signal for one that was killed.
  int end(int sign) {
    kill(pid_, sign);
    return wait();
  }
  int wait() {
    int status = 0;
    waitpid(pid_, &status, 0);
    pid_ = -1;
    return WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
  }

 private:
  pid_t pid_;
};

class StageNode : public test::StageClientTest {
 protected:
  StageNode() : StageClientTest("/stage_node_" + std::to_string(++count_)) {
    mechanics_.max_speed_mps = 1.0;
    mechanics_.acceleration_mps2 = 4.0;
    mechanics_.homing_speed_mps = 0.3;
    mechanics_.start_m = 0.05;
  }

  void start(std::vector<std::string> parameters) {
    parameters.insert(parameters.end(), {"speed_mps:=0.5", "retry_period:=0.2"});
    process_ = std::make_unique<NodeProcess>(node_.getNamespace().substr(1), parameters);
    connect();
  }

  void startWith(const std::string& kind) {
    truth_ = std::make_shared<sim::SimulatedStage>(mechanics_);
    const std::string link = (folder_.path() / "tty").string();
    if (kind == "zaber") {
      sim::ZaberOptions options;
      options.link = link;
      device_ = std::make_unique<sim::ZaberSimulator>(options, truth_, mechanics_);
      start({"device:=zaber:" + link, "unit_m:=4.9609375e-7"});
    } else {
      sim::GrblOptions options;
      options.link = link;
      device_ = std::make_unique<sim::GrblSimulator>(options, truth_, mechanics_);
      start({"device:=grbl:" + link});
    }
    ASSERT_TRUE(eventually([&] { return states_->last()->fault.empty(); }, 30.0));
  }

  void begin(double position, double speed) {
    client_->sendGoal(goal(position, false, speed));
    ASSERT_TRUE(eventually([&] { return truth_->read().moving && moving(); }, 30.0));
  }
  void home() {
    ASSERT_TRUE(call("home").success);
    ASSERT_TRUE(eventually([&] { return states_->last()->homed; }, 60.0));
  }
  double truth() const { return truth_->truePosition(device::now()); }

  /// The life of a stage, the same for every controller.
  void live(const std::string& stall_fault) {
    EXPECT_FALSE(states_->last()->homed);
    EXPECT_EQ(truth(), mechanics_.start_m) << "it moved by itself";
    EXPECT_EQ(move(0.1), SimpleClientGoalState::REJECTED);
    EXPECT_THAT(client_->getResult()->message, HasSubstr("not homed"));
    home();
    EXPECT_NEAR(truth(), 0.0, 1e-5);
    ASSERT_EQ(move(0.2), SimpleClientGoalState::SUCCEEDED) << client_->getResult()->message;
    EXPECT_NEAR(truth(), 0.2, 1e-5);
    EXPECT_NEAR(client_->getResult()->position, 0.2, 1e-5);
    ASSERT_EQ(move(-0.05, true), SimpleClientGoalState::SUCCEEDED);
    EXPECT_NEAR(truth(), 0.15, 1e-5);
    EXPECT_EQ(move(0.31), SimpleClientGoalState::REJECTED);

    begin(0.3, 0.02);
    client_->cancelGoal();
    ASSERT_TRUE(client_->waitForResult(ros::Duration(60.0)));
    EXPECT_EQ(client_->getState(), SimpleClientGoalState::PREEMPTED);
    EXPECT_FALSE(truth_->read().moving);
    EXPECT_LT(truth(), 0.29);
    EXPECT_NEAR(client_->getResult()->position, truth(), 1e-5);

    begin(0.3, 0.02);
    EXPECT_TRUE(call("halt").success);
    ASSERT_TRUE(client_->waitForResult(ros::Duration(60.0)));
    EXPECT_EQ(client_->getState(), SimpleClientGoalState::ABORTED);
    EXPECT_FALSE(truth_->read().moving);
    ASSERT_TRUE(states_->last()->homed);

    // A goal that is replaced while it runs.
    begin(0.3, 0.02);
    ASSERT_EQ(move(0.1), SimpleClientGoalState::SUCCEEDED) << client_->getResult()->message;
    EXPECT_NEAR(truth(), 0.1, 1e-5);

    if (!stall_fault.empty()) {
      begin(0.3, 0.02);
      truth_->stall();
      ASSERT_TRUE(client_->waitForResult(ros::Duration(60.0)));
      EXPECT_EQ(client_->getState(), SimpleClientGoalState::ABORTED);
      EXPECT_THAT(client_->getResult()->message, HasSubstr(stall_fault));
      ASSERT_TRUE(eventually([&] { return states_->last()->fault == stall_fault; }, 30.0));
      EXPECT_FALSE(states_->last()->homed);
      EXPECT_TRUE(call("recover").success);
      ASSERT_TRUE(eventually([&] { return states_->last()->fault.empty(); }, 30.0));
      EXPECT_EQ(move(0.1), SimpleClientGoalState::REJECTED) << "the reference is lost";
      home();
    }

    begin(0.3, 0.05);
    device_->powerCycle();
    ASSERT_TRUE(client_->waitForResult(ros::Duration(60.0)));
    EXPECT_EQ(client_->getState(), SimpleClientGoalState::ABORTED);
    ASSERT_TRUE(eventually([&] { return !states_->last()->homed; }, 30.0));
    EXPECT_EQ(move(0.1), SimpleClientGoalState::REJECTED);
    home();

    begin(0.3, 0.02);
    ros::WallTime event = ros::WallTime::now();
    const auto record = [&](const std::string& what) {
      RecordProperty(what, std::to_string((ros::WallTime::now() - event).toSec()));
    };
    device_->unplug();
    ASSERT_TRUE(client_->waitForResult(ros::Duration(60.0)));
    EXPECT_EQ(client_->getState(), SimpleClientGoalState::ABORTED);
    ASSERT_TRUE(eventually([&] { return states_->last()->fault == "link lost"; }, 30.0));
    record("seconds_to_notice");
    EXPECT_FALSE(states_->last()->homed);
    EXPECT_EQ(move(0.1), SimpleClientGoalState::REJECTED);
    EXPECT_TRUE(truth_->read().moving) << "nobody could tell it to stop";
    event = ros::WallTime::now();
    device_->plugIn();
    ASSERT_TRUE(eventually([&] { return states_->last()->fault.empty(); }, 30.0));
    record("seconds_to_return");
    EXPECT_TRUE(eventually([&] { return !truth_->read().moving; }, 30.0));
    EXPECT_LT(truth(), 0.29) << "it went on without anybody watching";
    if (!states_->last()->homed) home();
    ASSERT_EQ(move(0.1), SimpleClientGoalState::SUCCEEDED) << client_->getResult()->message;
    EXPECT_NEAR(truth(), 0.1, 1e-5);

    // The node ends in the middle of a motion.
    begin(0.3, 0.02);
    EXPECT_EQ(process_->end(SIGINT), 0);
    EXPECT_TRUE(eventually([&] { return !truth_->read().moving; }, 30.0));
    EXPECT_LT(truth(), 0.29);
  }

  static int count_;
  test::TemporaryFolder folder_;
  sim::SimulatedStageOptions mechanics_;
  std::shared_ptr<sim::SimulatedStage> truth_;
  std::unique_ptr<sim::SerialStageDevice> device_;
  std::unique_ptr<NodeProcess> process_;
};
int StageNode::count_ = 0;

TEST_F(StageNode, DrivesAZaber) {
  startWith("zaber");
  live("stalled (FS)");
}

TEST_F(StageNode, DrivesAGrbl) {
  startWith("grbl");
  live("");
}

TEST_F(StageNode, WaitsForAPortThatIsNotThere) {
  const std::string link = (folder_.path() / "tty").string();
  start({"device:=grbl:" + link});
  ASSERT_TRUE(eventually([&] { return states_->last()->fault == "not connected"; }, 30.0));
  EXPECT_TRUE(std::isnan(states_->last()->position));
  EXPECT_EQ(move(0.1), SimpleClientGoalState::REJECTED);
  EXPECT_THAT(client_->getResult()->message, HasSubstr("there is no port " + link));
  truth_ = std::make_shared<sim::SimulatedStage>(mechanics_);
  sim::GrblOptions options;
  options.link = link;
  device_ = std::make_unique<sim::GrblSimulator>(options, truth_, mechanics_);
  EXPECT_TRUE(eventually([&] { return states_->last()->fault.empty(); }, 30.0));
}

TEST_F(StageNode, EndsWhereItIsToldToOrCannotWork) {
  const std::string absent = "device:=grbl:" + (folder_.path() / "tty").string();
  EXPECT_EQ(NodeProcess("required", {absent, "required:=true"}).wait(), 1);
  EXPECT_EQ(NodeProcess("unit", {"device:=zaber:/dev/tty"}).wait(), 1);
  EXPECT_EQ(NodeProcess("unknown", {"device:=newport:/dev/tty"}).wait(), 1);
}

TEST_F(StageNode, FollowsJointStatesOfOthersAndCommandsThem) {
  ros::Publisher joints = node_.advertise<sensor_msgs::JointState>("robot_joints", 10);
  Collector<std_msgs::Float64> commands(node_, "command");
  std::atomic<double> position{0.1};
  const ros::SteadyTimer robot =
      node_.createSteadyTimer(ros::WallDuration(0.02), [&](const ros::SteadyTimerEvent&) {
        sensor_msgs::JointState message;
        message.header.stamp = ros::Time::now();
        message.name = {"elbow", "slider"};
        message.position = {7.0, position};
        // It goes where it is told to.
        if (commands.last()) {
          position = position + std::clamp(commands.last()->data - position, -0.01, 0.01);
        }
        message.velocity = {0.0, (position - message.position[1]) / 0.02};
        joints.publish(message);
      });
  start({"device:=external", "external_topic:=robot_joints", "external_joint:=slider",
         "external_command:=command"});
  ASSERT_TRUE(eventually([&] { return states_->last()->fault.empty(); }, 30.0));
  EXPECT_NEAR(states_->last()->position, 0.1, 1e-9);
  EXPECT_TRUE(states_->last()->homed);
  ASSERT_EQ(move(0.2), SimpleClientGoalState::SUCCEEDED) << client_->getResult()->message;
  EXPECT_NEAR(position, 0.2, 1e-4);
  EXPECT_FALSE(call("home").success);
}

TEST_F(StageNode, FollowsTfOfOthers) {
  tf2_ros::TransformBroadcaster broadcaster;
  const ros::SteadyTimer robot =
      node_.createSteadyTimer(ros::WallDuration(0.02), [&](const ros::SteadyTimerEvent&) {
        broadcaster.sendTransform(toTransformStamped(Pose(Eigen::Translation3d(0.0, 0.0, 0.25)),
                                                     ros::Time::now(), "robot_rail",
                                                     "robot_slider"));
      });
  start({"device:=external", "external_frame_id:=robot_rail",
         "external_child_frame_id:=robot_slider", "axis:=0 0 1"});
  ASSERT_TRUE(eventually([&] { return states_->last()->fault.empty(); }, 30.0));
  EXPECT_NEAR(states_->last()->position, 0.25, 1e-9);
  EXPECT_EQ(move(0.1), SimpleClientGoalState::REJECTED);
  EXPECT_THAT(client_->getResult()->message, HasSubstr("external_command"));
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "stage_node_test"); }
