// SPDX-License-Identifier: Apache-2.0
/// @file A translation stage that exists in memory: travel time, limits, homing, faults.
#pragma once

#include <array>
#include <deque>
#include <functional>
#include <mutex>
#include <string>

#include "omnister/device/stage.h"

namespace omnister::sim {

using device::Stamp;
using Clock = std::function<Stamp()>;

struct SimulatedStageOptions {
  double travel_m = 0.3;  ///< the carriage runs from 0 (the reference switch) to here
  double max_speed_mps = 0.2;
  double acceleration_mps2 = 0.5;
  double homing_speed_mps = 0.05;
  double start_m = 0.02;  ///< where the carriage stands at power-up, in [0, travel]
  bool homed = false;     ///< the reference is known at power-up (absolute encoder)
  std::string serial = "sim-stage";
};

/// From rest or motion to rest at a target, with bounded speed and acceleration: three phases of
/// constant acceleration.
class MotionProfile {
 public:
  /// Stands still.
  MotionProfile(Stamp start, double position);
  /// @param speed, acceleration > 0
  MotionProfile(Stamp start, double position, double velocity, double target, double speed,
                double acceleration);
  /// Brakes.
  static MotionProfile braking(Stamp start, double position, double velocity, double acceleration);

  Stamp start() const { return start_; }
  Stamp end() const;
  double position(Stamp time) const;  ///< constant before start() and after end()
  double velocity(Stamp time) const;

 private:
  struct Phase {
    double duration = 0.0;  // [s]
    double acceleration = 0.0;
  };
  void evaluate(Stamp time, double* position, double* velocity) const;

  Stamp start_;
  double position_;
  double velocity_ = 0.0;
  std::array<Phase, 3> phases_;
};

/// Safe to use from several threads: the simulated camera asks where the carriage truly is while
/// the driver moves it. Hitting an end of the travel stops it with the fault "limit" (recover()
/// clears it).
class SimulatedStage : public device::Stage {
 public:
  explicit SimulatedStage(const SimulatedStageOptions& options, Clock clock = device::now);

  device::StageIdentity identity() const override;
  device::StageReading read() override;
  void moveTo(double position_m, double speed_mps) override;
  void stop() override;
  void home() override;
  void recover() override;

  /// Where the carriage truly was [m], whatever its counter says. The last motions are remembered.
  double truePosition(Stamp time) const;

  /// The motor stalls now: stops at once, loses its reference, fault "stalled".
  void stall();
  /// The power goes and comes: stops at once, counts from 0 here, without a reference or a fault.
  void powerCycle();

 private:
  double truePositionLocked(Stamp time) const;
  void updateLocked(Stamp time);
  void beginLocked(const MotionProfile& profile);
  void requireNoFaultLocked() const;

  const SimulatedStageOptions options_;
  const Clock clock_;
  mutable std::mutex mutex_;
  std::deque<MotionProfile> motions_;  // oldest first; the last one is under way or over
  double counter_offset_ = 0.0;        // true position = counter + offset
  bool homed_ = false;
  bool homing_ = false;
  bool hits_end_ = false;  // the motion under way runs into an end of the travel
  std::uint64_t reference_ = 0;
  std::string fault_;
};

}  // namespace omnister::sim
