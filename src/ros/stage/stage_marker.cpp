// SPDX-License-Identifier: Apache-2.0
#include "ros/stage/stage_marker.h"

#include <std_srvs/Trigger.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <vector>

#include "ros/message/lens_markers.h"

namespace omnister {
namespace {

using visualization_msgs::InteractiveMarker;
using visualization_msgs::InteractiveMarkerControl;
using visualization_msgs::InteractiveMarkerFeedback;
using visualization_msgs::Marker;

constexpr char kName[] = "stage";
constexpr double kShownStep = 5e-4;  // [m] below this the marker stays where it is
// The rail lies so far below the camera [m], where the lens surface does not hide it.
constexpr double kBelow = 0.2;
constexpr double kEndStop = 0.05;  // [m] height of the marks at the ends of the travel

/// Down, square to the travel; where that is upright, forward.
Eigen::Vector3d beside(const Eigen::Vector3d& axis) {
  const Eigen::Vector3d wish = std::abs(axis.z()) < 0.9 ? Eigen::Vector3d(-Eigen::Vector3d::UnitZ())
                                                        : Eigen::Vector3d::UnitX();
  return (wish - wish.dot(axis) * axis).normalized();
}

geometry_msgs::Pose poseAt(double position, const Eigen::Vector3d& axis) {
  geometry_msgs::Pose pose;
  pose.position = toPoint(axis * position + kBelow * beside(axis));
  pose.orientation.w = 1.0;
  return pose;
}

StageMarkerParameters load(const ros::NodeHandle& private_node) {
  Parameters parameters(private_node);
  return loadStageMarkerParameters(parameters);
}

std::string textOf(const StageState& state) {
  if (!state.fault.empty()) return "stage: " + printable(state.fault, 60);
  if (!state.homed) return state.moving ? "stage: moving" : "stage: not homed (menu: Home)";
  char text[48];
  std::snprintf(text, sizeof text, "stage: %.3f m", state.position);
  return text;
}

}  // namespace

StageMarkerParameters loadStageMarkerParameters(Parameters& parameters) {
  StageMarkerParameters result;
  result.axis = parameters.direction("axis", result.axis);
  result.min_m = parameters.number("min_m", result.min_m, -100.0, 100.0, "m");
  result.max_m = parameters.number("max_m", result.max_m, -100.0, 100.0, "m");
  if (!(result.min_m < result.max_m)) throw InputError("~max_m", "", "is not above ~min_m");
  result.speed_mps = parameters.number("speed_mps", 0.0, 0.0, 10.0, "m/s");
  result.frame_id = parameters.frame("frame_id", result.frame_id);
  parameters.warnUnknown();
  return result;
}

StageMarker::StageMarker(const ros::NodeHandle& node, const ros::NodeHandle& private_node)
    : parameters_(load(private_node)),
      node_(node),
      mover_(node_, "move_stage", true),
      server_(node_.resolveName("stage_marker"), "", true) {
  for (const char* service : {"home", "halt", "recover"}) {
    std::string title(service);
    title[0] = static_cast<char>(std::toupper(title[0]));
    menu_.insert(title, [this, name = std::string(service)](const Feedback&) { call(name); });
  }
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    insert(parameters_.min_m, "stage: no state yet");
  }
  state_subscriber_ = node_.subscribe("stage_state", 10, &StageMarker::onState, this);
}

StageMarker::~StageMarker() { state_subscriber_.shutdown(); }

void StageMarker::insert(double position, const std::string& text) {
  InteractiveMarker marker;
  marker.header.frame_id = parameters_.frame_id;
  marker.name = kName;
  marker.description = text;
  marker.scale = 0.25F;
  marker.pose = poseAt(position, parameters_.axis);
  // rviz moves along the x axis of the control.
  const Eigen::Quaterniond along =
      Eigen::Quaterniond::FromTwoVectors(Eigen::Vector3d::UnitX(), parameters_.axis);
  InteractiveMarkerControl slide;
  slide.name = "slide";
  slide.interaction_mode = InteractiveMarkerControl::MOVE_AXIS;
  slide.orientation.w = along.w();
  slide.orientation.x = along.x();
  slide.orientation.y = along.y();
  slide.orientation.z = along.z();
  marker.controls.push_back(slide);

  // The box itself can be dragged too; every control has the menu (right click).
  InteractiveMarkerControl body = slide;
  body.name = "body";
  body.always_visible = 1;
  Marker box;
  box.type = Marker::CUBE;
  box.scale.x = box.scale.y = box.scale.z = 0.05;
  box.color.r = 0.95F;
  box.color.g = 0.6F;
  box.color.b = 0.15F;
  box.color.a = 0.9F;
  body.markers.push_back(box);
  // The travel, which stays where it is while the handle slides along it.
  Marker rail;
  rail.header.frame_id = parameters_.frame_id;
  rail.type = Marker::LINE_LIST;
  rail.scale.x = 0.01;
  rail.color.r = rail.color.g = rail.color.b = 0.7F;
  rail.color.a = 0.8F;
  rail.pose.orientation.w = 1.0;
  std::vector<geometry_msgs::Point> ends;
  for (const double end : {parameters_.min_m, parameters_.max_m}) {
    const Eigen::Vector3d down = beside(parameters_.axis);
    rail.points.push_back(toPoint(parameters_.axis * end + (kBelow - 0.5 * kEndStop) * down));
    rail.points.push_back(toPoint(parameters_.axis * end + (kBelow + 0.5 * kEndStop) * down));
    ends.push_back(toPoint(parameters_.axis * end + kBelow * down));
  }
  rail.points.insert(rail.points.end(), ends.begin(), ends.end());
  body.markers.push_back(rail);
  marker.controls.push_back(body);

  server_.insert(marker, [this](const Feedback& feedback) { onFeedback(feedback); });
  menu_.apply(server_, kName);
  server_.applyChanges();
  shown_position_ = position;
  shown_text_ = text;
}

void StageMarker::onState(const StageState::ConstPtr& state) {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (dragged_ || !std::isfinite(state->position)) return;
  // While it moves the handle stays at the goal, where it was let go.
  const double position =
      state->moving && state->homed ? shown_position_ : std::clamp(state->position, -1e3, 1e3);
  const std::string text = textOf(*state);
  if (text != shown_text_ && !state->moving) {
    insert(position, text);
  } else if (std::abs(position - shown_position_) > kShownStep) {
    server_.setPose(kName, poseAt(position, parameters_.axis));
    server_.applyChanges();
    shown_position_ = position;
  }
}

void StageMarker::onFeedback(const Feedback& feedback) {
  const Eigen::Vector3d at(feedback->pose.position.x, feedback->pose.position.y,
                           feedback->pose.position.z);
  if (!at.allFinite()) return;
  if (feedback->event_type == InteractiveMarkerFeedback::MOUSE_DOWN) {
    const std::lock_guard<std::mutex> lock(mutex_);
    dragged_ = true;
    return;
  }
  if (feedback->event_type != InteractiveMarkerFeedback::MOUSE_UP) return;
  const double position =
      std::clamp(at.dot(parameters_.axis), parameters_.min_m, parameters_.max_m);
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    // A click without a drag sends the stage nowhere.
    const bool moved = dragged_ && std::abs(position - shown_position_) > kShownStep;
    dragged_ = false;
    if (!moved) return;
    insert(position, shown_text_);
  }
  if (!mover_.isServerConnected()) {
    ROS_WARN("no stage listens on %s", node_.resolveName("move_stage").c_str());
    return;
  }
  MoveStageGoal goal;
  goal.position = position;
  goal.speed = parameters_.speed_mps;
  mover_.sendGoal(goal, [this](const actionlib::SimpleClientGoalState& state,
                               const MoveStageResultConstPtr& result) {
    if (state != actionlib::SimpleClientGoalState::SUCCEEDED)
      ROS_WARN("the stage did not move: %s",
               result ? printable(result->message, 300).c_str() : state.toString().c_str());
    // Back to where it truly is.
    const std::lock_guard<std::mutex> lock(mutex_);
    if (result && std::isfinite(result->position)) insert(result->position, "stage");
  });
}

void StageMarker::call(const std::string& service) {
  std_srvs::Trigger trigger;
  if (!ros::service::call(node_.resolveName(service), trigger))
    ROS_WARN("service %s does not answer", node_.resolveName(service).c_str());
  else if (trigger.response.success == 0)
    ROS_WARN("%s: %s", service.c_str(), printable(trigger.response.message, 300).c_str());
}

}  // namespace omnister
