// SPDX-License-Identifier: Apache-2.0
#include "ros/stage/stage_driver.h"

#include <ros/console.h>
#include <sensor_msgs/JointState.h>

#include <cmath>

#include "omnister/common/numbers.h"
#include "ros/message/conversions.h"
#include "ros/node/action_status.h"
#include "ros/node/parameters.h"

template <>
void actionlib::ActionServer<omnister::MoveStageAction>::publishStatus() {
  const boost::recursive_mutex::scoped_lock lock(lock_);
  status_pub_.publish(
      omnister::detail::actionStatus(status_list_, last_cancel_, status_list_timeout_));
}

namespace omnister {
namespace {

// A device that was told to move and still reports rest after this long has not moved.
constexpr std::chrono::milliseconds kTimeToBegin(500);
// Position changes below this are noise, not progress [m].
constexpr double kProgress = 1e-7;

}  // namespace

StageParameters loadStageParameters(const ros::NodeHandle& private_node, StageParameters p) {
  Parameters source(private_node);
  p.device = source.text("device", p.device);
  p.settings.unit_m = source.number("unit_m", p.settings.unit_m, -1.0, 1.0, "m");
  p.settings.baud = source.integer("baud", p.settings.baud, 0, 4000000);
  p.settings.device_number = source.integer("device_number", p.settings.device_number, 1, 99);
  p.settings.axis_number = source.integer("axis_number", p.settings.axis_number, 1, 9);
  p.external.topic = source.text("external_topic", p.external.topic);
  p.external.joint = source.text("external_joint", p.external.joint);
  p.external.frame_id = source.frame("external_frame_id", p.external.frame_id);
  p.external.child_frame_id = source.frame("external_child_frame_id", p.external.child_frame_id);
  p.external.command_topic = source.text("external_command", p.external.command_topic);
  p.external.timeout_s = source.number("external_timeout", p.external.timeout_s, 0.02, 60.0, "s");
  p.axis = source.direction("axis", p.axis);
  p.min_m = source.number("min_m", p.min_m, -100.0, 100.0, "m");
  p.max_m = source.number("max_m", p.max_m, -100.0, 100.0, "m");
  if (!(p.min_m < p.max_m)) {
    throw InputError(
        "parameter " + private_node.resolveName("max_m"), "",
        "is " + formatNumber(p.max_m) + ", expected above min_m (" + formatNumber(p.min_m) + " m)");
  }
  p.speed_mps = source.number("speed_mps", p.speed_mps, 1e-6, 10.0, "m/s");
  p.rate_hz = source.number("rate", p.rate_hz, 20.0, 500.0, "Hz");
  p.tolerance_m = source.number("tolerance_m", p.tolerance_m, 1e-9, 0.1, "m");
  p.stall_timeout_s = source.number("stall_timeout", p.stall_timeout_s, 0.2, 600.0, "s");
  p.move_timeout_s = source.number("move_timeout", p.move_timeout_s, 0.1, 36000.0, "s");
  p.home_timeout_s = source.number("home_timeout", p.home_timeout_s, 0.1, 36000.0, "s");
  // What tf says already is not said again.
  const bool from_tf = p.device == "external" && !p.external.frame_id.empty();
  p.publish_tf = source.flag("publish_tf", p.publish_tf && !from_tf);
  p.required = source.flag("required", p.required);
  p.retry_period_s = source.number("retry_period", p.retry_period_s, 0.05, 60.0, "s");
  p.frame_id = source.frame("frame_id", p.frame_id);
  p.child_frame_id = source.frame("child_frame_id", p.child_frame_id);
  p.joint_name = source.frame("joint_name", p.joint_name);
  p.diagnostic_period_s =
      source.number("diagnostic_period", p.diagnostic_period_s, 0.05, 60.0, "s");
  source.warnUnknown();
  return p;
}

OpenStage stageOpener(const ros::NodeHandle& node, const StageParameters& p) {
  if (p.device == "external") {
    const double unit = p.settings.unit_m != 0.0 ? p.settings.unit_m : 1.0;
    return [source = std::make_shared<ExternalStageSource>(node, p.external, p.axis, unit)] {
      return source->openStage();
    };
  }
  const std::string backend = p.device.substr(0, p.device.find(':'));
  if ((backend != "zaber" && backend != "grbl") || p.device.size() < backend.size() + 2) {
    throw InputError(
        "stage", "device",
        "is \"" + printable(p.device) + "\", expected zaber:PORT, grbl:PORT or external");
  }
  if (backend == "zaber" && p.settings.unit_m == 0.0) {
    throw InputError("stage", "unit_m",
                     "is not set, expected the length of a Zaber microstep in metres");
  }
  return [device = p.device, settings = p.settings] { return device::openStage(device, settings); };
}

StageDriver::StageDriver(const ros::NodeHandle& node, const ros::NodeHandle& private_node,
                         StageParameters parameters, OpenStage open)
    : node_(callbacks_.on(node)),
      parameters_(std::move(parameters)),
      open_(std::move(open)),
      state_publisher_(node_.advertise<StageState>("stage_state", 50)),
      diagnostics_(node, private_node, private_node.getNamespace()),
      pace_(parameters_.diagnostic_period_s),
      server_(
          node_, "move_stage", [this](const Server::GoalHandle& handle) { onGoal(handle); },
          [this](const Server::GoalHandle& handle) { onCancel(handle); }, false) {
  const bool echo =
      parameters_.device == "external" && parameters_.external.frame_id.empty() &&
      node_.resolveName(parameters_.external.topic) == node_.resolveName("joint_states");
  if (!echo) joint_publisher_ = node_.advertise<sensor_msgs::JointState>("joint_states", 50);
  home_ = node_.advertiseService("home", &StageDriver::onHome, this);
  halt_ = node_.advertiseService("halt", &StageDriver::onHalt, this);
  recover_ = node_.advertiseService("recover", &StageDriver::onRecover, this);
  diagnostics_.setHardwareID("none");
  diagnostics_.add("stage", this, &StageDriver::diagnose);
  thread_ = std::thread(&StageDriver::run, this);
  server_.start();
  callbacks_.start();
}

StageDriver::~StageDriver() {
  stop_ = true;
  thread_.join();
  callbacks_.stop();
  const std::lock_guard<std::mutex> lock(mutex_);
  try {
    if (stage_ && stage_->read().moving) stage_->stop();
  } catch (const std::exception& e) {
    ROS_WARN_STREAM("stopping the stage: " << printable(e.what()));
  }
  finishLocked(Outcome::kAborted, "the stage node shuts down");
}

void StageDriver::run() {
  const auto period = std::chrono::duration_cast<Steady::duration>(
      std::chrono::duration<double>(1.0 / parameters_.rate_hz));
  Steady::time_point next = Steady::now();
  while (!stop_) {
    openIfNeeded();
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      try {
        if (stage_) {
          pollLocked();
        } else {
          publishLocked(reading_);
        }
      } catch (const std::exception& e) {
        lostLocked(e.what());
      }
    }
    if (pace_.due()) diagnostics_.force_update();
    next = std::max(next + period, Steady::now());
    std::this_thread::sleep_until(next);
  }
}

void StageDriver::openIfNeeded() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (stage_ || Steady::now() < next_attempt_) return;
  }
  // Some devices take seconds to open, and nobody shall wait for that.
  std::unique_ptr<device::Stage> stage;
  std::string problem;
  try {
    stage = open_();
    const device::StageReading reading = stage->read();
    if (reading.moving) {
      ROS_WARN("the stage moves though nobody watches it: stopping it");
      stage->stop();
    }
  } catch (const std::exception& e) {
    stage.reset();
    problem = e.what();
  }
  const std::lock_guard<std::mutex> lock(mutex_);
  next_attempt_ = Steady::now() + std::chrono::duration_cast<Steady::duration>(
                                      std::chrono::duration<double>(parameters_.retry_period_s));
  if (!stage) {
    missingLocked(reading_.fault.empty() ? "not connected" : reading_.fault, problem);
    return;
  }
  stage_ = std::move(stage);
  const device::StageIdentity identity = stage_->identity();
  diagnostics_.setHardwareID(identity.serial);
  ROS_INFO_STREAM("opened " << printable(identity.vendor + " " + identity.model + " (" +
                                         identity.serial + ")"));
  told_problem_.clear();
}

void StageDriver::missingLocked(const std::string& fault, const std::string& problem) {
  reading_.velocity_mps = 0.0;
  reading_.moving = false;
  reading_.homed = false;
  reading_.fault = fault;
  if (parameters_.required) failed_ = true;
  if (problem == told_problem_) return;
  told_problem_ = problem;
  ROS_WARN_STREAM("no stage" << (parameters_.required
                                     ? ""
                                     : ", trying again every " +
                                           formatNumber(parameters_.retry_period_s) + " s")
                             << ": " << printable(problem, 1000));
}

void StageDriver::lostLocked(const std::string& problem) {
  const std::unique_ptr<device::Stage> stage = std::move(stage_);
  homing_ = false;
  missingLocked("link lost", problem);
  publishLocked(reading_);
  finishLocked(Outcome::kAborted, "the stage was lost: " + problem);
  if (!stage) return;
  try {
    stage->stop();
  } catch (const std::exception&) {
    // It does not hear us; if it still moves when it comes back, it is stopped then.
  }
}

void StageDriver::pollLocked() {
  reading_ = stage_->read();
  for (const std::string& remark : stage_->takeRemarks()) {
    ROS_WARN_STREAM(printable(remark, 1000));
  }
  if (reading_.moving) seen_moving_ = true;
  if (homing_ && motionOverLocked(reading_)) {
    homing_ = false;
    if (reading_.homed) {
      ROS_INFO("the stage is homed");
    } else {
      ROS_WARN("homing ended without a reference");
    }
  }
  // Whoever waits for the end of homing can move right after it.
  if (homing_) {
    reading_.homed = false;
    reading_.moving = true;
  }
  publishLocked(reading_);
  superviseLocked(reading_);
}

void StageDriver::publishLocked(const device::StageReading& reading) {
  // Of a stage that was never there nothing was ever read, but it can be said since when.
  const bool known = reading.stamp != device::Stamp();
  const ros::Time stamp = known ? toRosTime(reading.stamp) : ros::Time::now();
  if (known && parameters_.publish_tf && reading.stamp != transform_stamp_) {
    transform_stamp_ = reading.stamp;
    const Pose pose(Eigen::Translation3d(parameters_.axis * reading.position_m));
    transforms_.sendTransform(
        toTransformStamped(pose, stamp, parameters_.frame_id, parameters_.child_frame_id));
  }

  StageState state;
  state.header.stamp = stamp;
  state.header.frame_id = parameters_.frame_id;
  state.position = known ? reading.position_m : std::nan("");
  state.velocity = reading.velocity_mps;
  state.homed = reading.homed;
  state.moving = reading.moving;
  state.fault = reading.fault;
  state_publisher_.publish(state);
  if (!stage_ || !joint_publisher_) return;

  sensor_msgs::JointState joint;
  joint.header.stamp = stamp;
  joint.name = {parameters_.joint_name};
  joint.position = {reading.position_m};
  joint.velocity = {reading.velocity_mps};
  joint_publisher_.publish(joint);
}

bool StageDriver::motionOverLocked(const device::StageReading& reading) const {
  return !reading.moving && (seen_moving_ || Steady::now() - began_ > kTimeToBegin);
}

void StageDriver::beganLocked() {
  seen_moving_ = false;
  began_ = Steady::now();
  progress_at_ = began_;
  progress_position_m_ = reading_.position_m;
}

void StageDriver::superviseLocked(const device::StageReading& reading) {
  if (reading.fault != told_fault_) {
    told_fault_ = reading.fault;
    if (!reading.fault.empty()) ROS_WARN_STREAM("stage fault: " << printable(reading.fault));
  }
  // A device that gives no readings while it homes, or few, makes progress by giving one.
  if (std::abs(reading.position_m - progress_position_m_) > kProgress ||
      (reading.stamp == progress_stamp_ && homing_)) {
    progress_position_m_ = reading.position_m;
    progress_at_ = Steady::now();
  }
  progress_stamp_ = reading.stamp;
  if (!reading.fault.empty()) {
    if (reading.moving) stage_->stop();
    homing_ = false;
    finishLocked(Outcome::kAborted, "the stage has the fault \"" + reading.fault + "\"");
    return;
  }
  if (goal_ && reading.reference != goal_->reference) {
    if (reading.moving) stage_->stop();
    finishLocked(Outcome::kAborted, "the stage lost its reference on the way");
    return;
  }
  const bool ours = goal_ || homing_;
  const bool stalled = ours && reading.moving &&
                       std::chrono::duration<double>(Steady::now() - progress_at_).count() >
                           parameters_.stall_timeout_s;
  if (stalled) {
    ROS_WARN_STREAM("the stage makes no progress, stopping it");
    stage_->stop();
    homing_ = false;
    progress_at_ = Steady::now();
    if (goal_) goal_->ending = Ending::kStall;
  }
  const double took = std::chrono::duration<double>(Steady::now() - began_).count();
  const double allowed = homing_ ? parameters_.home_timeout_s : parameters_.move_timeout_s;
  if (ours && reading.moving && took > allowed &&
      (homing_ || (goal_ && goal_->ending == Ending::kArrive))) {
    ROS_WARN_STREAM("the stage takes longer than " << allowed << " s, stopping it");
    stage_->stop();
    homing_ = false;
    if (goal_) goal_->ending = Ending::kTimeout;
  }
  if (!goal_) return;
  MoveStageFeedback feedback;
  feedback.position = reading.position_m;
  goal_->handle.publishFeedback(feedback);
  const double error = reading.position_m - goal_->target_m;
  const bool there = std::abs(error) <= parameters_.tolerance_m;
  if (reading.moving || !(motionOverLocked(reading) || there)) return;
  switch (goal_->ending) {
    case Ending::kCancel:
      finishLocked(Outcome::kCanceled, "canceled");
      break;
    case Ending::kHalt:
      finishLocked(Outcome::kAborted, "halted");
      break;
    case Ending::kStall:
      finishLocked(Outcome::kAborted, "the stage made no progress for " +
                                          formatNumber(parameters_.stall_timeout_s) + " s");
      break;
    case Ending::kTimeout:
      finishLocked(Outcome::kAborted, "the stage did not arrive within " +
                                          formatNumber(parameters_.move_timeout_s) + " s");
      break;
    case Ending::kArrive:
      if (there) {
        finishLocked(Outcome::kSucceeded, "");
      } else {
        finishLocked(Outcome::kAborted, "the stage stopped " + formatNumber(std::abs(error)) +
                                            " m away from the goal");
      }
      break;
  }
}

MoveStageResult StageDriver::resultOf(bool success, double position_m, const std::string& message) {
  MoveStageResult result;
  result.success = success;
  result.position = position_m;
  result.message = message;
  return result;
}

void StageDriver::finishLocked(Outcome outcome, const std::string& message) {
  if (!goal_) return;
  Goal goal = std::move(*goal_);
  goal_.reset();
  const MoveStageResult result =
      resultOf(outcome == Outcome::kSucceeded, reading_.position_m, message);
  switch (outcome) {
    case Outcome::kSucceeded:
      goal.handle.setSucceeded(result, message);
      break;
    case Outcome::kAborted:
      goal.handle.setAborted(result, message);
      break;
    case Outcome::kCanceled:
      goal.handle.setCanceled(result, message);
      break;
  }
}

device::Stage& StageDriver::stageLocked() {
  if (!stage_) {
    throw device::StageError("there is no stage" +
                             (told_problem_.empty() ? std::string() : ": " + told_problem_));
  }
  return *stage_;
}

double StageDriver::targetOfLocked(const MoveStageGoal& goal) {
  if (!std::isfinite(goal.position)) throw InputError("move_stage", "position", "is not finite");
  if (!std::isfinite(goal.speed) || goal.speed < 0.0) {
    throw InputError("move_stage", "speed",
                     "is " + formatNumber(goal.speed) + ", expected 0 (default) or above");
  }
  reading_ = stageLocked().read();
  if (!reading_.fault.empty()) {
    throw device::StageError("the stage has the fault \"" + reading_.fault +
                             "\": recover it first");
  }
  if (homing_) throw device::StageError("the stage is homing");
  const double target = goal.relative ? reading_.position_m + goal.position : goal.position;
  if (reading_.homed) {
    // Decimals written in a goal must not fail by a rounding error.
    constexpr double kSlack = 1e-9;
    if (target < parameters_.min_m - kSlack || target > parameters_.max_m + kSlack) {
      throw InputError("move_stage", "position",
                       "would be " + formatNumber(target) + " m, expected " +
                           formatNumber(parameters_.min_m) + " to " +
                           formatNumber(parameters_.max_m) + " m");
    }
  } else if (!goal.relative) {
    throw device::StageError("the stage is not homed: only relative moves until home was called");
  } else if (std::abs(goal.position) > parameters_.max_m - parameters_.min_m) {
    throw InputError("move_stage", "position",
                     "moves by more than the travel of " +
                         formatNumber(parameters_.max_m - parameters_.min_m) + " m");
  }
  return target;
}

void StageDriver::onGoal(Server::GoalHandle handle) {
  const std::lock_guard<std::mutex> lock(mutex_);
  try {
    const MoveStageGoal goal = *handle.getGoal();
    const double target = targetOfLocked(goal);
    stageLocked().moveTo(target, goal.speed > 0.0 ? goal.speed : parameters_.speed_mps);
    finishLocked(Outcome::kCanceled, "replaced by a new goal");
    handle.setAccepted();
    goal_ = Goal();
    goal_->handle = handle;
    goal_->target_m = target;
    goal_->reference = reading_.reference;
    beganLocked();
  } catch (const std::exception& e) {
    ROS_WARN_STREAM("move_stage refused: " << printable(e.what(), 1000));
    handle.setRejected(resultOf(false, reading_.position_m, e.what()), e.what());
  }
}

void StageDriver::onCancel(Server::GoalHandle handle) {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (!goal_ || !(goal_->handle == handle)) return;
  goal_->ending = Ending::kCancel;
  try {
    stageLocked().stop();
  } catch (const std::exception& e) {
    lostLocked(e.what());
  }
}

bool StageDriver::onHome(std_srvs::Trigger::Request& /*request*/,
                         std_srvs::Trigger::Response& response) {
  const std::lock_guard<std::mutex> lock(mutex_);
  try {
    stageLocked().home();
    finishLocked(Outcome::kAborted, "homing was asked for");
    homing_ = true;
    beganLocked();
    response.success = true;
    response.message = "homing; stage_state tells when it is done";
  } catch (const std::exception& e) {
    response.success = false;
    response.message = e.what();
  }
  return true;
}

bool StageDriver::onHalt(std_srvs::Trigger::Request& /*request*/,
                         std_srvs::Trigger::Response& response) {
  const std::lock_guard<std::mutex> lock(mutex_);
  try {
    stageLocked().stop();
    homing_ = false;
    if (goal_) goal_->ending = Ending::kHalt;
    response.success = true;
    response.message = "halted";
  } catch (const std::exception& e) {
    response.success = false;
    response.message = e.what();
  }
  return true;
}

bool StageDriver::onRecover(std_srvs::Trigger::Request& /*request*/,
                            std_srvs::Trigger::Response& response) {
  const std::lock_guard<std::mutex> lock(mutex_);
  try {
    stageLocked().recover();
    reading_ = stage_->read();
    response.success = reading_.fault.empty();
    response.message = reading_.fault.empty()
                           ? (reading_.homed ? "ready" : "no fault; the stage is not homed")
                           : "the fault \"" + reading_.fault + "\" stays";
  } catch (const std::exception& e) {
    response.success = false;
    response.message = e.what();
  }
  return true;
}

void StageDriver::diagnose(diagnostic_updater::DiagnosticStatusWrapper& status) {
  using diagnostic_msgs::DiagnosticStatus;
  const std::lock_guard<std::mutex> lock(mutex_);
  if (!stage_) {
    status.summary(DiagnosticStatus::ERROR, "no stage");
  } else if (!reading_.fault.empty()) {
    status.summary(DiagnosticStatus::ERROR, reading_.fault);
  } else if (!reading_.homed) {
    status.summary(DiagnosticStatus::WARN, "not homed");
  } else {
    status.summary(DiagnosticStatus::OK, reading_.moving ? "moving" : "resting");
  }
  status.add("position [m]", reading_.position_m);
  status.add("velocity [m/s]", reading_.velocity_mps);
  status.add("homed", reading_.homed ? "yes" : "no");
  status.add("last problem", printable(told_problem_));
}

}  // namespace omnister
