// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <actionlib/client/simple_action_client.h>
#include <omnister/MoveStageAction.h>
#include <omnister/StageState.h>
#include <std_srvs/Trigger.h>

#include <memory>
#include <string>

#include "ros/ros_test.h"

namespace omnister::test {

using actionlib::SimpleClientGoalState;
using StageClient = actionlib::SimpleActionClient<MoveStageAction>;

/// A test that uses a stage as others do: by topics, services and its action.
class StageClientTest : public testing::Test {
 protected:
  explicit StageClientTest(const std::string& name) : node_(name) {}

  /// Waits for a stage in the namespace of node_.
  void connect() {
    states_ = std::make_unique<Collector<StageState>>(node_, "stage_state");
    client_ = std::make_unique<StageClient>(node_, "move_stage", false);
    ASSERT_TRUE(client_->waitForServer(ros::Duration(30.0)));
    ASSERT_TRUE(eventually([&] { return states_->size() > 0; }, 30.0));
  }

  static MoveStageGoal goal(double position, bool relative = false, double speed = 0.0) {
    MoveStageGoal goal;
    goal.position = position;
    goal.relative = relative;
    goal.speed = speed;
    return goal;
  }
  SimpleClientGoalState move(const MoveStageGoal& goal) {
    client_->sendGoal(goal);
    EXPECT_TRUE(client_->waitForResult(ros::Duration(60.0)));
    return client_->getState();
  }
  SimpleClientGoalState move(double position, bool relative = false) {
    return move(goal(position, relative));
  }
  std_srvs::TriggerResponse call(const std::string& service) {
    std_srvs::Trigger call;
    EXPECT_TRUE(ros::service::call(node_.resolveName(service), call));
    return call.response;
  }
  bool moving() const { return states_->last()->moving; }

  ros::NodeHandle node_;
  std::unique_ptr<Collector<StageState>> states_;
  std::unique_ptr<StageClient> client_;
};

}  // namespace omnister::test
