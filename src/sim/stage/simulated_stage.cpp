// SPDX-License-Identifier: Apache-2.0
#include "omnister/sim/simulated_stage.h"

#include <algorithm>
#include <cmath>

#include "omnister/common/numbers.h"

namespace omnister::sim {
namespace {

using device::StageError;

constexpr std::size_t kRememberedMotions = 64;

double seconds(std::chrono::nanoseconds duration) {
  return static_cast<double>(duration.count()) * 1e-9;
}

std::chrono::nanoseconds nanoseconds(double s) {
  return std::chrono::nanoseconds(static_cast<std::int64_t>(std::llround(s * 1e9)));
}

}  // namespace

MotionProfile::MotionProfile(Stamp start, double position) : start_(start), position_(position) {}

MotionProfile::MotionProfile(Stamp start, double position, double velocity, double target,
                             double speed, double acceleration)
    : start_(start), position_(position), velocity_(velocity) {
  const double a = acceleration;
  // Mirrored so that the target lies ahead of where braking from here would end.
  const double rest = position + velocity * std::abs(velocity) / (2.0 * a);
  const double sign = target >= rest ? 1.0 : -1.0;
  const double v = sign * velocity;
  const double distance = sign * (target - position);
  if (v > speed) {
    // Faster than allowed: slow down first.
    phases_[0] = {(v - speed) / a, -sign * a};
    const double covered = (v * v - speed * speed) / (2.0 * a) + speed * speed / (2.0 * a);
    phases_[1] = {std::max(0.0, (distance - covered) / speed), 0.0};
    phases_[2] = {speed / a, -sign * a};
    return;
  }
  const double peak = std::sqrt(std::max(0.0, a * distance + 0.5 * v * v));
  const double top = std::min(peak, speed);
  phases_[0] = {std::max(0.0, (top - v) / a), sign * a};
  const double covered = (top * top - v * v) / (2.0 * a) + top * top / (2.0 * a);
  phases_[1] = {peak > speed ? std::max(0.0, (distance - covered) / speed) : 0.0, 0.0};
  phases_[2] = {top / a, -sign * a};
}

MotionProfile MotionProfile::braking(Stamp start, double position, double velocity,
                                     double acceleration) {
  MotionProfile profile(start, position);
  profile.velocity_ = velocity;
  profile.phases_[0] = {std::abs(velocity) / acceleration,
                        velocity > 0.0 ? -acceleration : acceleration};
  return profile;
}

Stamp MotionProfile::end() const {
  double duration = 0.0;
  for (const Phase& phase : phases_) duration += phase.duration;
  return start_ + nanoseconds(duration);
}

void MotionProfile::evaluate(Stamp time, double* position, double* velocity) const {
  double left = std::max(0.0, seconds(time - start_));
  *position = position_;
  *velocity = velocity_;
  for (const Phase& phase : phases_) {
    const double t = std::min(left, phase.duration);
    *position += *velocity * t + 0.5 * phase.acceleration * t * t;
    *velocity += phase.acceleration * t;
    left -= t;
    if (left <= 0.0) return;
  }
  *velocity = 0.0;
}

double MotionProfile::position(Stamp time) const {
  double position = 0.0, velocity = 0.0;
  evaluate(time, &position, &velocity);
  return position;
}

double MotionProfile::velocity(Stamp time) const {
  double position = 0.0, velocity = 0.0;
  evaluate(time, &position, &velocity);
  return time < start_ ? 0.0 : velocity;
}

SimulatedStage::SimulatedStage(const SimulatedStageOptions& options, Clock clock)
    : options_(options), clock_(std::move(clock)), homed_(options.homed) {
  const auto positive = [](const char* key, double value) {
    if (!(value > 0.0) || !std::isfinite(value)) {
      throw InputError("simulated stage", key, "is " + formatNumber(value) + ", expected above 0");
    }
  };
  positive("travel", options.travel_m);
  positive("max_speed", options.max_speed_mps);
  positive("acceleration", options.acceleration_mps2);
  positive("homing_speed", options.homing_speed_mps);
  if (!(options.start_m >= 0.0 && options.start_m <= options.travel_m)) {
    throw InputError("simulated stage", "start",
                     "is " + formatNumber(options.start_m) + ", expected 0 to " +
                         formatNumber(options.travel_m) + " m");
  }
  motions_.emplace_back(clock_(), options.start_m);
  // Without a reference the counter begins at 0 wherever the carriage stands.
  counter_offset_ = homed_ ? 0.0 : options.start_m;
}

device::StageIdentity SimulatedStage::identity() const {
  return {"omnister", "simulated stage", options_.serial};
}

double SimulatedStage::truePositionLocked(Stamp time) const {
  for (auto motion = motions_.rbegin(); motion != motions_.rend(); ++motion) {
    if (time >= motion->start()) return motion->position(time);
  }
  return motions_.front().position(time);
}

double SimulatedStage::truePosition(Stamp time) const {
  const std::lock_guard<std::mutex> lock(mutex_);
  return truePositionLocked(time);
}

void SimulatedStage::updateLocked(Stamp time) {
  const MotionProfile& motion = motions_.back();
  if (time < motion.end()) return;
  if (homing_) {
    homing_ = false;
    homed_ = true;
    counter_offset_ = 0.0;
    ++reference_;
  }
  if (hits_end_) {
    hits_end_ = false;
    fault_ = "limit";
  }
}

void SimulatedStage::beginLocked(const MotionProfile& profile) {
  motions_.push_back(profile);
  if (motions_.size() > kRememberedMotions) motions_.pop_front();
}

void SimulatedStage::requireNoFaultLocked() const {
  if (!fault_.empty())
    throw StageError("the stage has the fault \"" + fault_ + "\": recover it first");
}

device::StageReading SimulatedStage::read() {
  const std::lock_guard<std::mutex> lock(mutex_);
  const Stamp time = clock_();
  updateLocked(time);
  const MotionProfile& motion = motions_.back();
  device::StageReading reading;
  reading.stamp = time;
  reading.position_m = motion.position(time) - counter_offset_;
  reading.velocity_mps = motion.velocity(time);
  reading.homed = homed_;
  reading.moving = time < motion.end();
  reading.fault = fault_;
  reading.reference = reference_;
  return reading;
}

void SimulatedStage::moveTo(double position_m, double speed_mps) {
  if (!std::isfinite(position_m)) throw StageError("position is not finite");
  if (!(speed_mps > 0.0) || !std::isfinite(speed_mps)) throw StageError("speed is not above 0");
  const std::lock_guard<std::mutex> lock(mutex_);
  const Stamp time = clock_();
  updateLocked(time);
  requireNoFaultLocked();
  if (homing_) throw StageError("the stage is homing");
  const double target = position_m + counter_offset_;
  constexpr double kSlack = 1e-9;  // a limit given in decimals is still within
  const bool outside = target < -kSlack || target > options_.travel_m + kSlack;
  if (homed_ && outside) {
    throw StageError("position " + formatNumber(position_m) + " m is outside the travel of 0 to " +
                     formatNumber(options_.travel_m) + " m");
  }
  const double reachable = std::clamp(target, 0.0, options_.travel_m);
  const MotionProfile& motion = motions_.back();
  beginLocked(MotionProfile(time, motion.position(time), motion.velocity(time), reachable,
                            std::min(speed_mps, options_.max_speed_mps),
                            options_.acceleration_mps2));
  hits_end_ = outside;
}

void SimulatedStage::stop() {
  const std::lock_guard<std::mutex> lock(mutex_);
  const Stamp time = clock_();
  updateLocked(time);
  const MotionProfile& motion = motions_.back();
  homing_ = false;
  hits_end_ = false;
  if (time >= motion.end()) return;
  beginLocked(MotionProfile::braking(time, motion.position(time), motion.velocity(time),
                                     options_.acceleration_mps2));
}

void SimulatedStage::home() {
  const std::lock_guard<std::mutex> lock(mutex_);
  const Stamp time = clock_();
  updateLocked(time);
  requireNoFaultLocked();
  const MotionProfile& motion = motions_.back();
  beginLocked(MotionProfile(time, motion.position(time), motion.velocity(time), 0.0,
                            options_.homing_speed_mps, options_.acceleration_mps2));
  homing_ = true;
  homed_ = false;
  hits_end_ = false;
}

void SimulatedStage::recover() {
  const std::lock_guard<std::mutex> lock(mutex_);
  updateLocked(clock_());
  fault_.clear();
}

void SimulatedStage::stall() {
  const std::lock_guard<std::mutex> lock(mutex_);
  const Stamp time = clock_();
  updateLocked(time);
  beginLocked(MotionProfile(time, motions_.back().position(time)));
  homing_ = false;
  hits_end_ = false;
  homed_ = false;
  fault_ = "stalled";
  ++reference_;
}

void SimulatedStage::powerCycle() {
  const std::lock_guard<std::mutex> lock(mutex_);
  const Stamp time = clock_();
  const double position = motions_.back().position(time);
  beginLocked(MotionProfile(time, position));
  counter_offset_ = position;
  homing_ = false;
  hits_end_ = false;
  homed_ = false;
  fault_.clear();
  ++reference_;
}

}  // namespace omnister::sim
