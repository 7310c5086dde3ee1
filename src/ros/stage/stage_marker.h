// SPDX-License-Identifier: Apache-2.0
/// @file A handle in rviz that drives the stage.
#pragma once

#include <actionlib/client/simple_action_client.h>
#include <interactive_markers/interactive_marker_server.h>
#include <interactive_markers/menu_handler.h>
#include <omnister/MoveStageAction.h>
#include <ros/ros.h>

#include <memory>
#include <mutex>
#include <string>

#include "ros/message/messages.h"
#include "ros/node/parameters.h"

namespace omnister {

/// Private parameters: those of the stage of the same names.
struct StageMarkerParameters {
  Eigen::Vector3d axis = Eigen::Vector3d::UnitX();  ///< of travel, in frame_id
  double min_m = 0.0;
  double max_m = 0.3;
  double speed_mps = 0.0;  ///< 0: the stage's own
  std::string frame_id = "stage_base";
};

/// @throws InputError naming key, value and range
StageMarkerParameters loadStageMarkerParameters(Parameters& parameters);

/// Interactive marker `stage_marker/update`: dragged along the axis, the stage is sent where it is
/// let go (action `move_stage`, within the limits); its menu homes, halts and recovers (the
/// services of the stage). Shows position, travel and faults of `stage_state`. It never moves the
/// stage by itself.
class StageMarker {
 public:
  StageMarker(const ros::NodeHandle& node, const ros::NodeHandle& private_node);
  ~StageMarker();
  StageMarker(const StageMarker&) = delete;
  StageMarker& operator=(const StageMarker&) = delete;

 private:
  using Feedback = visualization_msgs::InteractiveMarkerFeedbackConstPtr;
  void onState(const StageState::ConstPtr& state);
  void onFeedback(const Feedback& feedback);
  void call(const std::string& service);
  /// mutex_ is held.
  void insert(double position, const std::string& text);

  const StageMarkerParameters parameters_;
  ros::NodeHandle node_;
  actionlib::SimpleActionClient<MoveStageAction> mover_;
  interactive_markers::InteractiveMarkerServer server_;
  interactive_markers::MenuHandler menu_;

  std::mutex mutex_;  ///< all below
  bool dragged_ = false;
  double shown_position_ = 0.0;
  std::string shown_text_;

  ros::Subscriber state_subscriber_;
};

}  // namespace omnister
