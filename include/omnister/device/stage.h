// SPDX-License-Identifier: Apache-2.0
/// @file What every translation stage does. No ROS here. Metres, seconds; device units end at the
/// backend.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/common/stamp.h"

namespace omnister::device {

/// One consistent reading.
struct StageReading {
  Stamp stamp;              ///< when the position was so
  double position_m = 0.0;  ///< along the axis, from home; from power-up while not homed
  double velocity_mps = 0.0;
  bool homed = false;   ///< the position is referenced
  bool moving = false;  ///< includes homing
  std::string fault;    ///< by name; empty when there is none. A fault stays until recover()
  /// Changes whenever positions before and after do not compare: homing, a reset, a lost reference.
  std::uint64_t reference = 0;
};

struct StageIdentity {
  std::string vendor;
  std::string model;
  std::string serial;
};

/// The stage refused a command (says why), or was lost.
class StageError : public Error {
 public:
  using Error::Error;
};

/// All calls return at once; motion is watched by read(). Used from one thread at a time. Never
/// moves unless told to, also not at construction.
class Stage {
 public:
  virtual ~Stage() = default;
  virtual StageIdentity identity() const = 0;
  /// @throws StageError when the stage does not answer
  virtual StageReading read() = 0;
  /// Begins to move to a position; a motion under way is replaced.
  /// @param speed_mps > 0; above the device's own limit, that limit
  /// @throws StageError when refused: a fault, out of the device's limits, not homed where that
  /// matters
  virtual void moveTo(double position_m, double speed_mps) = 0;
  /// Brakes as fast as the device can.
  virtual void stop() = 0;
  /// Begins to look for the reference. @throws StageError when refused
  virtual void home() = 0;
  /// Clears a fault as far as the device allows; never moves. @throws StageError
  virtual void recover() = 0;
  /// What a person should know and no call failed for, a line each; every line is told once.
  virtual std::vector<std::string> takeRemarks() { return {}; }
};

/// What the stages on serial ports need to know.
struct StageSettings {
  /// Metres per native unit (Zaber: microstep; GRBL: millimetre); 0: the backend's own (GRBL:
  /// 0.001; a Zaber has none). Negative reverses the direction.
  double unit_m = 0.0;
  int baud = 0;           ///< 0: the backend's own (115200)
  int device_number = 1;  ///< Zaber: in the chain, 1 to 99
  int axis_number = 1;    ///< Zaber: of the controller; GRBL: 1 X, 2 Y, 3 Z
};

/// Opens `zaber:PORT` (ASCII protocol, see zaber_protocol.h) or `grbl:PORT` (GRBL 1.1). May take
/// some seconds; moves nothing.
/// @throws StageError saying what is wrong with the port, or what answered; InputError for a text
/// that names no backend, or settings out of range
std::unique_ptr<Stage> openStage(const std::string& device, const StageSettings& settings);

}  // namespace omnister::device
