// SPDX-License-Identifier: Apache-2.0
#include "ros/stage/external_stage.h"

#include <std_msgs/Float64.h>

#include <algorithm>
#include <cmath>

#include "omnister/common/numbers.h"
#include "ros/message/conversions.h"

namespace omnister {
namespace {

using device::StageError;

// Slower than this it rests [m/s].
constexpr double kRest = 1e-4;

class ExternalStage : public device::Stage {
 public:
  explicit ExternalStage(std::shared_ptr<ExternalStageSource> source)
      : source_(std::move(source)) {}
  device::StageIdentity identity() const override {
    return {"external", "stage", source_->description()};
  }
  device::StageReading read() override { return source_->read(); }
  void moveTo(double position_m, double /*speed_mps*/) override {
    if (!source_->canCommand()) {
      throw StageError(
          "the external stage takes no commands: parameter external_command names no topic");
    }
    source_->command(position_m);
    if (!std::exchange(told_speed_, true)) {
      remarks_.emplace_back("the external stage moves at its own speed");
    }
  }
  void stop() override {
    if (source_->canCommand()) source_->command(source_->read().position_m);
  }
  void home() override { throw StageError("an external stage is homed by its own driver"); }
  void recover() override {}
  std::vector<std::string> takeRemarks() override { return std::exchange(remarks_, {}); }

 private:
  const std::shared_ptr<ExternalStageSource> source_;
  bool told_speed_ = false;
  std::vector<std::string> remarks_;
};

}  // namespace

ExternalStageSource::ExternalStageSource(const ros::NodeHandle& node,
                                         const ExternalStageOptions& options,
                                         const Eigen::Vector3d& axis, double unit_m)
    : node_(node), options_(options), axis_(axis), unit_m_(unit_m) {
  if (!options_.command_topic.empty()) {
    command_publisher_ = node_.advertise<std_msgs::Float64>(options_.command_topic, 10);
  }
  if (options_.frame_id.empty()) {
    joint_subscriber_ =
        node_.subscribe(options_.topic, 50, &ExternalStageSource::onJointState, this);
  } else {
    if (options_.child_frame_id.empty()) {
      throw InputError("stage", "external_child_frame_id", "is empty, expected a tf frame");
    }
    buffer_ = std::make_unique<tf2_ros::Buffer>();
    listener_ = std::make_unique<TransformInput>(*buffer_);
  }
}

std::string ExternalStageSource::description() const {
  if (!options_.frame_id.empty()) {
    return "tf " + options_.frame_id + " to " + options_.child_frame_id;
  }
  return node_.resolveName(options_.topic) +
         (options_.joint.empty() ? "" : " joint " + options_.joint);
}

std::unique_ptr<device::Stage> ExternalStageSource::openStage() {
  read();
  return std::make_unique<ExternalStage>(shared_from_this());
}

void ExternalStageSource::take(double position, double velocity, const ros::Time& stamp) {
  if (!std::isfinite(position)) {
    problem_ = "its position is not finite";
    return;
  }
  const ros::Time time = stamp.isZero() ? ros::Time::now() : stamp;
  const device::Stamp at{std::chrono::nanoseconds(time.toNSec())};
  const double position_m = position * unit_m_;
  double velocity_mps = velocity * unit_m_;
  if (!std::isfinite(velocity_mps)) {
    const double seconds = std::chrono::duration<double>(at - reading_.stamp).count();
    velocity_mps = known_ && seconds > 1e-6 ? (position_m - reading_.position_m) / seconds : 0.0;
  }
  reading_.stamp = at;
  reading_.position_m = position_m;
  reading_.velocity_mps = velocity_mps;
  reading_.homed = true;
  reading_.moving = std::abs(velocity_mps) > kRest;
  received_ = ros::SteadyTime::now();
  known_ = true;
}

void ExternalStageSource::onJointState(const sensor_msgs::JointState::ConstPtr& message) {
  const std::lock_guard<std::mutex> lock(mutex_);
  std::size_t index = 0;
  if (!options_.joint.empty()) {
    const auto found = std::find(message->name.begin(), message->name.end(), options_.joint);
    // Other drivers publish other joints on the same topic.
    if (found == message->name.end()) return;
    index = static_cast<std::size_t>(found - message->name.begin());
  } else if (message->position.size() != 1) {
    problem_ = "a message holds " + std::to_string(message->position.size()) +
               " joints, and parameter external_joint names none";
    return;
  }
  if (index >= message->position.size()) {
    problem_ = "the joint has no position";
    return;
  }
  const double velocity =
      index < message->velocity.size() ? message->velocity[index] : std::nan("");
  take(message->position[index], velocity, message->header.stamp);
}

void ExternalStageSource::lookUp() {
  try {
    const geometry_msgs::TransformStamped transform =
        buffer_->lookupTransform(options_.frame_id, options_.child_frame_id, ros::Time(0));
    if (known_ && reading_.stamp.time_since_epoch().count() ==
                      static_cast<std::int64_t>(transform.header.stamp.toNSec())) {
      return;
    }
    const auto& t = transform.transform.translation;
    take(axis_.dot(Eigen::Vector3d(t.x, t.y, t.z)), std::nan(""), transform.header.stamp);
  } catch (const tf2::TransformException& e) {
    problem_ = e.what();
  }
}

device::StageReading ExternalStageSource::read() {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (buffer_) lookUp();
  const double age = known_ ? (ros::SteadyTime::now() - received_).toSec() : 0.0;
  if (!known_ || age > options_.timeout_s) {
    known_ = false;
    throw StageError("no position of the external stage (" + description() + ")" +
                     (problem_.empty() ? "" : ": " + problem_));
  }
  return reading_;
}

void ExternalStageSource::command(double position_m) {
  std_msgs::Float64 message;
  message.data = position_m / unit_m_;
  command_publisher_.publish(message);
}

}  // namespace omnister
