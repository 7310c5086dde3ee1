// SPDX-License-Identifier: Apache-2.0
#include "ros/stage/stage_marker.h"

#include <gmock/gmock.h>
#include <visualization_msgs/InteractiveMarkerFeedback.h>
#include <visualization_msgs/InteractiveMarkerInit.h>
#include <visualization_msgs/InteractiveMarkerUpdate.h>

#include "omnister/sim/simulated_stage.h"
#include "ros/ros_test.h"
#include "ros/stage/stage_driver.h"

namespace omnister {
namespace {

using test::Collector;
using test::eventually;
using visualization_msgs::InteractiveMarkerFeedback;

/// A simulated stage along -y, its handle, and a hand that drags it.
class StageHandle : public testing::Test {
 protected:
  void SetUp() override {
    ros::NodeHandle stage_parameters("~stage");
    stage_parameters.setParam("axis", "0 -1 0");
    stage_parameters.setParam("max_m", 0.3);
    ros::NodeHandle marker_parameters("~marker");
    marker_parameters.setParam("axis", "0 -1 0");
    marker_parameters.setParam("max_m", 0.3);
    marker_parameters.setParam("speed_mps", 0.2);
    sim::SimulatedStageOptions options;
    options.homed = true;
    options.travel_m = 0.3;
    stage_ = std::make_unique<StageDriver>(
        node_, stage_parameters, loadStageParameters(stage_parameters),
        [options] { return std::make_unique<sim::SimulatedStage>(options); });
    marker_ = std::make_unique<StageMarker>(node_, marker_parameters);
    hand_ = node_.advertise<InteractiveMarkerFeedback>("stage_marker/feedback", 10);
    ASSERT_TRUE(eventually([&] { return hand_.getNumSubscribers() > 0 && states_.size() > 0; }));
  }
  void event(std::uint8_t type, double y, std::uint32_t menu_entry = 0) {
    InteractiveMarkerFeedback feedback;
    feedback.header.frame_id = "stage_base";
    feedback.client_id = "hand";
    feedback.marker_name = "stage";
    feedback.event_type = type;
    feedback.menu_entry_id = menu_entry;
    feedback.pose.position.y = y;
    feedback.pose.orientation.w = 1.0;
    hand_.publish(feedback);
    ros::WallDuration(0.05).sleep();
  }
  void drag(double y) {
    event(InteractiveMarkerFeedback::MOUSE_DOWN, 0.0);
    event(InteractiveMarkerFeedback::POSE_UPDATE, y);
    event(InteractiveMarkerFeedback::MOUSE_UP, y);
  }
  double position() const { return states_.last()->position; }

  ros::NodeHandle node_{"handled"};
  Collector<StageState> states_{node_, "stage_state"};
  std::unique_ptr<StageDriver> stage_;
  std::unique_ptr<StageMarker> marker_;
  ros::Publisher hand_;
};

TEST_F(StageHandle, SendsTheStageWhereItIsLetGoAndNoFurtherThanItsLimits) {
  const double start = position();
  // The action client may still be connecting: let go again until the stage has come.
  EXPECT_TRUE(eventually(
      [&] {
        drag(-0.12);
        return eventually([&] { return std::abs(position() - 0.12) < 1e-3; }, 5.0);
      },
      60.0))
      << "from " << start;
  drag(-5.0);
  EXPECT_TRUE(eventually([&] { return std::abs(position() - 0.3) < 1e-3; }, 30.0));
  // A click that does not drag moves nothing, and neither does the marker by itself.
  ASSERT_TRUE(eventually([&] { return !states_.last()->moving; }));
  ros::WallDuration(0.3).sleep();
  event(InteractiveMarkerFeedback::MOUSE_DOWN, -0.3);
  event(InteractiveMarkerFeedback::MOUSE_UP, -0.3);
  event(InteractiveMarkerFeedback::POSE_UPDATE, -0.1);
  event(InteractiveMarkerFeedback::MOUSE_UP, std::nan(""));
  const std::size_t before = states_.size();
  ASSERT_TRUE(eventually([&] { return states_.size() > before + 20; }));
  const auto all = states_.messages();
  for (std::size_t i = before; i < all.size(); ++i) ASSERT_FALSE(all[i]->moving);
  EXPECT_NEAR(position(), 0.3, 1e-3);
}

TEST_F(StageHandle, ShowsWhereTheStageIs) {
  Collector<visualization_msgs::InteractiveMarkerInit> inits(node_, "stage_marker/update_full");
  ASSERT_TRUE(eventually([&] {
    return inits.size() > 0 && !inits.last()->markers.empty() &&
           inits.last()->markers[0].description.find(" m") != std::string::npos;
  }));
  const visualization_msgs::InteractiveMarker marker = inits.last()->markers[0];
  EXPECT_EQ(marker.header.frame_id, "stage_base");
  EXPECT_NEAR(marker.pose.position.y, -position(), 2e-3);
  EXPECT_NEAR(marker.pose.position.z, -0.2, 1e-6) << "below the lens surface, which would hide it";
  EXPECT_EQ(marker.menu_entries.size(), 3u);
  for (const auto& control : marker.controls)
    EXPECT_EQ(control.interaction_mode, visualization_msgs::InteractiveMarkerControl::MOVE_AXIS)
        << "box and arrows are dragged along the travel";
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) {
  return omnister::test::runTests(argc, argv, "stage_marker_test");
}
