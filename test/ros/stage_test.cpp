// SPDX-License-Identifier: Apache-2.0
#include <gmock/gmock.h>
#include <sensor_msgs/JointState.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <cmath>

#include "omnister/sim/simulated_stage.h"
#include "ros/message/conversions.h"
#include "ros/stage/stage_driver.h"
#include "ros/stage_client.h"

namespace omnister {
namespace {

using test::Collector;
using test::eventually;
using test::SimpleClientGoalState;
using testing::HasSubstr;

/// The driver opens links to a stage that goes on existing; a link can be cut.
class Link : public device::Stage {
 public:
  Link(std::shared_ptr<sim::SimulatedStage> stage, std::shared_ptr<std::atomic<bool>> cut)
      : stage_(std::move(stage)), cut_(std::move(cut)) {
    check();
  }
  device::StageIdentity identity() const override { return stage_->identity(); }
  device::StageReading read() override {
    check();
    return stage_->read();
  }
  void moveTo(double position, double speed) override { stage_->moveTo(position, speed); }
  void stop() override { stage_->stop(); }
  void home() override { stage_->home(); }
  void recover() override { stage_->recover(); }

 private:
  void check() const {
    if (*cut_) throw device::StageError("no answer");
  }
  std::shared_ptr<sim::SimulatedStage> stage_;
  std::shared_ptr<std::atomic<bool>> cut_;
};

class StageTest : public test::StageClientTest {
 protected:
  StageTest()
      : StageClientTest("stage_" + std::to_string(++count_)),
        private_("~" + node_.getNamespace().substr(1)) {
    parameters_.retry_period_s = 0.05;
    parameters_.speed_mps = 0.5;
    options_.max_speed_mps = 1.0;
    options_.acceleration_mps2 = 4.0;
    options_.homing_speed_mps = 0.2;
    options_.homed = true;
    options_.start_m = 0.0;
  }

  void open() {
    stage_ = std::make_shared<sim::SimulatedStage>(options_);
    driver_ = std::make_unique<StageDriver>(
        node_, private_, parameters_, [this] { return std::make_unique<Link>(stage_, cut_); });
    connect();
  }

  static int count_;
  ros::NodeHandle private_;
  StageParameters parameters_;
  sim::SimulatedStageOptions options_;
  std::shared_ptr<std::atomic<bool>> cut_ = std::make_shared<std::atomic<bool>>(false);
  std::shared_ptr<sim::SimulatedStage> stage_;
  std::unique_ptr<StageDriver> driver_;
};
int StageTest::count_ = 0;

TEST_F(StageTest, MovesToWhereItIsToldAndSaysSoBeforeTheResult) {
  open();
  Collector<MoveStageActionResult> results(node_, "move_stage/result");
  Collector<MoveStageActionFeedback> feedback(node_, "move_stage/feedback");
  ASSERT_TRUE(eventually([&] { return results.connected() && feedback.connected(); }));
  ASSERT_EQ(move(goal(0.2)), SimpleClientGoalState::SUCCEEDED);
  EXPECT_TRUE(client_->getResult()->success);
  EXPECT_NEAR(client_->getResult()->position, 0.2, 1e-4);
  EXPECT_NEAR(stage_->truePosition(device::now()), 0.2, 1e-9);
  ASSERT_TRUE(eventually([&] { return results.size() == 1; }));
  const ros::Time ended = results.last()->header.stamp;
  const auto count = [&](const std::function<bool(const StageState&)>& condition) {
    int found = 0;
    for (const auto& state : states_->messages()) found += condition(*state) ? 1 : 0;
    return found;
  };
  EXPECT_GE(count([](const StageState& state) { return state.moving; }), 3);
  // The state topic may be delivered after the result, but its reading is from before.
  EXPECT_TRUE(eventually([&] {
    return count([&](const StageState& state) {
             return !state.moving && std::abs(state.position - 0.2) < 1e-4 &&
                    state.header.stamp <= ended;
           }) >= 1;
  }));
  EXPECT_GE(feedback.size(), 3u);

  ASSERT_EQ(move(goal(-0.05, true)), SimpleClientGoalState::SUCCEEDED);
  EXPECT_NEAR(client_->getResult()->position, 0.15, 1e-4);
}

TEST_F(StageTest, ReadingsCarryTheirStampsAtTwentyHertzOrMore) {
  parameters_.axis = Eigen::Vector3d(0, 0, 1);
  options_.start_m = 0.07;
  open();
  Collector<sensor_msgs::JointState> joints(node_, "joint_states");
  Collector<tf2_msgs::TFMessage> tf(ros::NodeHandle(), "/tf");
  ASSERT_TRUE(
      eventually([&] { return states_->size() >= 30 && joints.size() >= 20 && tf.size() >= 20; }));
  std::vector<double> gaps;
  const auto states = states_->messages();
  for (std::size_t i = 1; i < states.size(); ++i) {
    gaps.push_back((states[i]->header.stamp - states[i - 1]->header.stamp).toSec());
    EXPECT_GT(gaps.back(), 0.0);
  }
  std::nth_element(gaps.begin(), gaps.begin() + static_cast<long>(gaps.size() / 2), gaps.end());
  EXPECT_LE(gaps[gaps.size() / 2], 0.05);
  EXPECT_EQ(joints.last()->name, std::vector<std::string>{"stage_joint"});
  EXPECT_NEAR(joints.last()->position.at(0), 0.07, 1e-12);
  const auto& transform = tf.last()->transforms.at(0);
  EXPECT_EQ(transform.header.frame_id, "stage_base");
  EXPECT_EQ(transform.child_frame_id, "stage_carriage");
  EXPECT_NEAR(transform.transform.translation.z, 0.07, 1e-12);
  // One reading, one stamp, everywhere.
  int same = 0;
  for (const auto& joint : joints.messages()) {
    for (const auto& state : states_->messages()) {
      if (state->header.stamp == joint->header.stamp) ++same;
    }
  }
  EXPECT_GE(same, 10);
}

TEST_F(StageTest, CancelReallyStopsIt) {
  open();
  client_->sendGoal(goal(0.3, false, 0.05));
  ASSERT_TRUE(eventually([&] { return moving(); }));
  client_->cancelGoal();
  ASSERT_TRUE(client_->waitForResult(ros::Duration(20.0)));
  EXPECT_EQ(client_->getState(), SimpleClientGoalState::PREEMPTED);
  EXPECT_FALSE(client_->getResult()->success);
  EXPECT_FALSE(stage_->read().moving);
  EXPECT_LT(stage_->read().position_m, 0.29);
  EXPECT_NEAR(client_->getResult()->position, stage_->read().position_m, 1e-9);
}

TEST_F(StageTest, ANewGoalReplacesTheOldOne) {
  open();
  Collector<MoveStageActionResult> results(node_, "move_stage/result");
  ASSERT_TRUE(eventually([&] { return results.connected(); }));
  client_->sendGoal(goal(0.3, false, 0.05));
  ASSERT_TRUE(eventually([&] { return moving(); }));
  ASSERT_EQ(move(goal(0.0)), SimpleClientGoalState::SUCCEEDED);
  EXPECT_NEAR(stage_->read().position_m, 0.0, 1e-4);
  ASSERT_TRUE(eventually([&] { return results.size() == 2; }));
  EXPECT_EQ(results.messages()[0]->status.status, actionlib_msgs::GoalStatus::PREEMPTED);
  EXPECT_FALSE(results.messages()[0]->result.success);
}

TEST_F(StageTest, RefusesGoalsThatItCannotReach) {
  parameters_.min_m = 0.05;
  parameters_.max_m = 0.25;
  options_.start_m = 0.1;
  open();
  const double nan = std::nan(""), inf = std::numeric_limits<double>::infinity();
  int refused = 0;
  for (const MoveStageGoal& bad :
       {goal(0.26), goal(0.04), goal(-1.0), goal(0.16, true), goal(-0.06, true), goal(nan),
        goal(inf), goal(nan, true), goal(0.2, false, nan), goal(0.2, false, -0.1),
        goal(0.2, false, inf)}) {
    EXPECT_EQ(move(bad), SimpleClientGoalState::REJECTED) << bad;
    EXPECT_FALSE(client_->getResult()->success);
    EXPECT_NE(client_->getResult()->message, "");
    ++refused;
  }
  EXPECT_EQ(refused, 11);
  EXPECT_FALSE(stage_->read().moving);
  EXPECT_EQ(stage_->read().position_m, 0.1);
  EXPECT_EQ(move(goal(0.25)), SimpleClientGoalState::SUCCEEDED);
  EXPECT_EQ(move(goal(0.05)), SimpleClientGoalState::SUCCEEDED);
}

TEST_F(StageTest, HomesOnRequestOnlyAndThenMovesAbsolutely) {
  options_.homed = false;
  options_.start_m = 0.1;
  open();
  EXPECT_FALSE(states_->last()->homed);
  EXPECT_EQ(move(goal(0.1)), SimpleClientGoalState::REJECTED);
  EXPECT_THAT(client_->getResult()->message, HasSubstr("not homed"));
  EXPECT_EQ(move(goal(0.02, true)), SimpleClientGoalState::SUCCEEDED);
  EXPECT_NEAR(stage_->truePosition(device::now()), 0.12, 1e-9);

  const std_srvs::TriggerResponse response = call("home");
  EXPECT_TRUE(response.success);
  EXPECT_FALSE(stage_->read().homed) << "home must return at once";
  EXPECT_EQ(move(goal(0.01, true)), SimpleClientGoalState::REJECTED) << "while homing";
  ASSERT_TRUE(eventually([&] { return states_->last()->homed && !moving(); }));
  EXPECT_NEAR(states_->last()->position, 0.0, 1e-6);
  EXPECT_EQ(move(goal(0.1)), SimpleClientGoalState::SUCCEEDED);
  EXPECT_NEAR(stage_->truePosition(device::now()), 0.1, 1e-9);
}

TEST_F(StageTest, HaltStopsMotionAndHoming) {
  open();
  client_->sendGoal(goal(0.3, false, 0.05));
  ASSERT_TRUE(eventually([&] { return moving(); }));
  EXPECT_TRUE(call("halt").success);
  ASSERT_TRUE(client_->waitForResult(ros::Duration(20.0)));
  EXPECT_EQ(client_->getState(), SimpleClientGoalState::ABORTED);
  EXPECT_THAT(client_->getResult()->message, HasSubstr("halted"));
  EXPECT_FALSE(stage_->read().moving);
  ASSERT_EQ(move(goal(0.3)), SimpleClientGoalState::SUCCEEDED);
  EXPECT_TRUE(call("home").success);
  ASSERT_TRUE(eventually([&] { return moving(); }));
  EXPECT_TRUE(call("halt").success);
  ASSERT_TRUE(eventually([&] { return !moving(); }));
  EXPECT_FALSE(states_->last()->homed);
}

TEST_F(StageTest, AFaultAbortsAndStaysUntilRecovery) {
  open();
  client_->sendGoal(goal(0.3, false, 0.05));
  ASSERT_TRUE(eventually([&] { return moving(); }));
  stage_->stall();
  ASSERT_TRUE(client_->waitForResult(ros::Duration(20.0)));
  EXPECT_EQ(client_->getState(), SimpleClientGoalState::ABORTED);
  EXPECT_THAT(client_->getResult()->message, HasSubstr("stalled"));
  ASSERT_TRUE(eventually([&] { return states_->last()->fault == "stalled"; }));
  EXPECT_FALSE(states_->last()->homed);
  EXPECT_EQ(move(goal(0.01, true)), SimpleClientGoalState::REJECTED);
  EXPECT_FALSE(call("home").success);
  EXPECT_TRUE(call("recover").success);
  ASSERT_TRUE(eventually([&] { return states_->last()->fault.empty(); }));
  EXPECT_EQ(move(goal(0.1)), SimpleClientGoalState::REJECTED) << "the reference is lost";
  EXPECT_TRUE(call("home").success);
  ASSERT_TRUE(eventually([&] { return states_->last()->homed; }));
  EXPECT_EQ(move(goal(0.1)), SimpleClientGoalState::SUCCEEDED);
}

TEST_F(StageTest, ALostLinkAbortsAndIsFoundAgain) {
  open();
  client_->sendGoal(goal(0.3, false, 0.05));
  ASSERT_TRUE(eventually([&] { return moving(); }));
  *cut_ = true;
  ASSERT_TRUE(client_->waitForResult(ros::Duration(20.0)));
  EXPECT_EQ(client_->getState(), SimpleClientGoalState::ABORTED);
  ASSERT_TRUE(eventually([&] { return states_->last()->fault == "link lost"; }));
  EXPECT_FALSE(call("home").success);
  EXPECT_EQ(move(goal(0.1)), SimpleClientGoalState::REJECTED);
  *cut_ = false;
  ASSERT_TRUE(eventually([&] { return states_->last()->fault.empty(); }));
  EXPECT_TRUE(call("halt").success);
  EXPECT_EQ(move(goal(0.1)), SimpleClientGoalState::SUCCEEDED);
}

TEST_F(StageTest, StopsAtShutdown) {
  open();
  client_->sendGoal(goal(0.3, false, 0.05));
  ASSERT_TRUE(eventually([&] { return moving(); }));
  client_.reset();
  driver_.reset();
  ASSERT_TRUE(eventually([&] { return !stage_->read().moving; }));
  EXPECT_LT(stage_->read().position_m, 0.29);
}

TEST_F(StageTest, RefusesParametersByKeyValueAndRange) {
  const auto refusal = [&](const std::string& key,
                           const XmlRpc::XmlRpcValue& value) -> std::string {
    private_.setParam(key, value);
    std::string message;
    try {
      loadStageParameters(private_);
    } catch (const InputError& e) {
      message = e.what();
    }
    private_.deleteParam(key);
    return message;
  };
  EXPECT_EQ(refusal("axis", "0 2 0"), "");
  EXPECT_THAT(refusal("axis", "0 0"), HasSubstr("axis"));
  EXPECT_THAT(refusal("axis", "nan 0 0"), HasSubstr("axis"));
  EXPECT_THAT(refusal("max_m", -0.1), HasSubstr("max_m"));
  EXPECT_THAT(refusal("speed_mps", 0.0), HasSubstr("speed_mps"));
  EXPECT_THAT(refusal("rate", 5.0), HasSubstr("rate"));
  EXPECT_THAT(refusal("child_frame_id", "a b"), HasSubstr("child_frame_id"));
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "stage_test"); }
