// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <limits>
#include <set>
#include <thread>

#include "device/stage/serial_port.h"
#include "device/stage/serial_stage.h"
#include "device/stage/zaber/zaber_protocol.h"
#include "omnister/common/numbers.h"
#include "omnister/common/stamp.h"

namespace omnister::device {
namespace {

constexpr int kDefaultBaud = 115200;
// A reply takes some 70 ms at 9600 baud. What went unheard is asked again, each time with twice the
// patience; all of it is under two seconds, within which a lost link must be noticed.
constexpr std::chrono::milliseconds kFirstReplyTimeout(100);
constexpr int kSilences = 4;
constexpr std::chrono::milliseconds kReplyTimeout(500);
// Values that are no numbers, or refused settings, in a row.
constexpr int kAttempts = 3;
// Garbled replies in a row.
constexpr int kGarbled = 20;
// A device that is busy with something else says so (AGAIN); it is asked again this often.
constexpr int kAgainAttempts = 20;
constexpr std::chrono::milliseconds kAgainPause(10);
// Data of speeds are microsteps per second times this (ASCII protocol manual, `maxspeed`).
constexpr double kSpeedScale = 1.6384;
// All warning flags are asked for this often while there is one: a reply shows only the worst.
constexpr std::chrono::milliseconds kWarningsPeriod(100);
// The reply to `home` may come before the device is busy.
constexpr std::chrono::milliseconds kTimeToBegin(500);
constexpr std::chrono::seconds kTimeToBrake(2);

struct Named {
  const char* flag;
  const char* name;
};
constexpr Named kFaults[] = {
    {"FD", "driver off"},
    {"FQ", "encoder error"},
    {"FS", "stalled"},
    {"FT", "twisted"},
    {"FB", "out of bounds"},
    {"FP", "off the path"},
    {"FE", "limit error"},
    {"FF", "critical error"},
    {"FN", "peripheral not supported"},
    {"FZ", "peripheral inactive"},
    {"FO", "driver off"},
    {"FH", "device not homed"},
    {"WL", "unexpected limit hit"},
};
constexpr Named kRemarks[] = {
    {"WV", "supply voltage out of range"},
    {"WT", "controller too hot"},
    {"WM", "was displaced while resting"},
    {"WP", "calibration of another type"},
};
constexpr Named kReasons[] = {
    {"AGAIN", "cannot do it just now"},
    {"BADAXIS", "no such axis"},
    {"BADCOMMAND", "unknown command"},
    {"BADDATA", "value out of range"},
    {"BADMESSAGEID", "bad message id"},
    {"DEVICEONLY", "for the whole device only"},
    {"FULL", "out of memory"},
    {"LOCKSTEP", "the axis is part of a lockstep group"},
    {"NOACCESS", "no access"},
    {"PARKED", "the device is parked"},
    {"STATUSBUSY", "not while it moves"},
};

template <std::size_t N>
const char* nameOf(const Named (&names)[N], const std::string& flag) {
  for (const Named& entry : names) {
    if (flag == entry.flag) return entry.name;
  }
  return nullptr;
}

std::string describeReason(const std::string& reason) {
  const char* name = nameOf(kReasons, reason);
  return name ? std::string(name) + " (" + reason + ")" : printable(reason);
}

std::optional<std::int64_t> parseInteger(const std::string& text) {
  const std::optional<double> value = parseNumber(text);
  if (!value || !(std::abs(*value) < 9e15) || *value != std::floor(*value)) return std::nullopt;
  return static_cast<std::int64_t>(*value);
}

class ZaberStage : public SerialStage {
 public:
  ZaberStage(const std::string& port, const StageSettings& settings);
  ~ZaberStage() override;
  StageReading read() override;
  void moveTo(double position_m, double speed_mps) override;
  void stop() override;
  void home() override;
  void recover() override;

 private:
  /// Sends a command until a valid reply comes. Only for commands that may be sent twice.
  ZaberReply request(const std::string& command, bool whole_device = false);
  /// Sends a command once. @param silent [out] nothing came; may be null
  /// @return nullopt without a valid reply
  std::optional<ZaberReply> requestOnce(const std::string& command, bool whole_device,
                                        std::chrono::milliseconds timeout, bool* silent);
  /// As request(), asking again while the answer is AGAIN.
  ZaberReply requestPatiently(const std::string& command, bool whole_device = false);
  void requireAccepted(const ZaberReply& reply, const std::string& command) const;
  std::optional<std::int64_t> ask(const std::string& setting, bool whole_device = false);
  void meet();
  std::int64_t askPosition(ZaberReply* reply);
  void updateWarnings(const ZaberReply& reply);
  void moveAbsolute(std::int64_t target, std::int64_t speed);
  void moveRelative(std::int64_t target, std::int64_t speed);
  /// Sends a move with the speed in it, or with the speed as a setting where a device knows no
  /// other.
  void sendMove(const std::string& command, std::int64_t speed, bool repeatable);
  void setReferenced(bool referenced);

  const StageSettings settings_;
  SerialPort port_;
  int id_ = 0;
  bool replies_protected_ = false;
  bool restore_checksum_ = false;
  std::optional<std::int64_t> limit_min_, limit_max_, max_speed_;
  bool speed_in_move_ = true;
  bool speed_was_set_ = false;
  std::string noise_;    ///< the last line that was no reply
  bool silent_ = false;  ///< the last request found nobody

  std::set<std::string> flags_;
  std::string shown_flag_ = "--";
  Steady::time_point flags_at_;
  bool lost_reference_ = false;  ///< by a stall; the device may not say so
  bool referenced_ = false;
  std::uint64_t reference_ = 0;
  bool homing_ = false;
  bool homing_seen_ = false;
  Steady::time_point homing_began_;

  std::optional<Stamp> last_stamp_;
  std::int64_t last_position_ = 0;
};

ZaberStage::ZaberStage(const std::string& port, const StageSettings& settings)
    : settings_(settings), port_(port, settings.baud > 0 ? settings.baud : kDefaultBaud) {
  // Ends what somebody may have left half-written in the device's input.
  port_.write("\n");
  meet();
  const auto text = [&](const std::string& setting) -> std::string {
    const ZaberReply reply = request("get " + setting, true);
    return reply.accepted ? printable(reply.data, 40) : "unknown";
  };
  identity_.vendor = "Zaber";
  identity_.model = "device " + text("deviceid") + ", firmware " + text("version");
  identity_.serial = text("system.serial");
  limit_min_ = ask("limit.min");
  limit_max_ = ask("limit.max");
  max_speed_ = ask("maxspeed");
  if (!limit_min_ || !limit_max_) remarkOnce("the stage does not tell its limits");
  read();
}

ZaberStage::~ZaberStage() {
  if (silent_) return;
  try {
    if (speed_was_set_ && max_speed_) request("set maxspeed " + std::to_string(*max_speed_));
    if (restore_checksum_) request("set comm.checksum 0", true);
  } catch (const std::exception&) {
    // Nobody is there to take it back.
  }
}

/// Makes sure that a Zaber device is there, and has it protect its replies.
void ZaberStage::meet() {
  const std::string where =
      printable(port_.path()) + " at " + std::to_string(port_.baud()) + " baud";
  ZaberReply reply;
  try {
    reply = request("get comm.checksum", true);
  } catch (const StageError& e) {
    if (noise_.empty()) noise_ = port_.unfinished();
    if (!noise_.empty()) {
      throw StageError(where + " answered \"" + printable(noise_, 60) +
                       "\", which is no reply of Zaber device " +
                       std::to_string(settings_.device_number));
    }
    throw StageError(std::string(e.what()) + ": expected Zaber device " +
                     std::to_string(settings_.device_number) + " on " + where);
  }
  for (int attempt = 0; attempt < kAttempts && reply.accepted && !reply.has_checksum; ++attempt) {
    restore_checksum_ = request("set comm.checksum 1", true).accepted;
    reply = request("get comm.checksum", true);
  }
  replies_protected_ = reply.has_checksum;
  if (!replies_protected_) {
    remarkOnce("the stage sends no checksums: each position is read twice instead");
  }
}

std::optional<ZaberReply> ZaberStage::requestOnce(const std::string& command, bool whole_device,
                                                  std::chrono::milliseconds timeout, bool* silent) {
  id_ = (id_ + 1) % 100;
  if (silent) *silent = false;
  const int axis = whole_device ? 0 : settings_.axis_number;
  port_.write(zaberCommand(settings_.device_number, axis, id_, command));
  const Steady::time_point deadline = Steady::now() + timeout;
  while (const std::optional<std::string> line = port_.readLine(deadline)) {
    if (isZaberNotice(*line)) continue;
    const std::optional<ZaberReply> reply = parseZaberReply(*line);
    if (!reply || (replies_protected_ && !reply->has_checksum)) {
      // It may have been our reply: asking again is quicker than waiting for the deadline.
      noise_ = *line;
      return std::nullopt;
    }
    const bool ours =
        reply->id == id_ && reply->device == settings_.device_number && reply->axis == axis;
    if (ours) return reply;
  }
  if (silent) *silent = true;
  return std::nullopt;
}

ZaberReply ZaberStage::request(const std::string& command, bool whole_device) {
  std::chrono::milliseconds timeout = kFirstReplyTimeout;
  int silences = 0;
  for (int garbled = 0; silences < kSilences && garbled < kGarbled;) {
    bool silent = false;
    if (const auto reply = requestOnce(command, whole_device, timeout, &silent)) {
      silent_ = false;
      return *reply;
    }
    if (silent) {
      ++silences;
      timeout *= 2;
    } else {
      ++garbled;
    }
  }
  silent_ = true;
  throw StageError("the stage on " + printable(port_.path()) + " does not answer (\"" + command +
                   "\")");
}

ZaberReply ZaberStage::requestPatiently(const std::string& command, bool whole_device) {
  ZaberReply reply = request(command, whole_device);
  for (int i = 0; i < kAgainAttempts && !reply.accepted && reply.data == "AGAIN"; ++i) {
    std::this_thread::sleep_for(kAgainPause);
    reply = request(command, whole_device);
  }
  return reply;
}

void ZaberStage::requireAccepted(const ZaberReply& reply, const std::string& command) const {
  if (reply.accepted) return;
  throw StageError("the stage refused \"" + command + "\": " + describeReason(reply.data));
}

std::optional<std::int64_t> ZaberStage::ask(const std::string& setting, bool whole_device) {
  for (int attempt = 0; attempt < kAttempts; ++attempt) {
    const ZaberReply reply = requestPatiently("get " + setting, whole_device);
    if (!reply.accepted) return std::nullopt;
    if (const auto value = parseInteger(reply.data)) return value;
  }
  return std::nullopt;
}

std::int64_t ZaberStage::askPosition(ZaberReply* reply) {
  for (int attempt = 0; attempt < kAttempts; ++attempt) {
    *reply = requestPatiently("get pos");
    requireAccepted(*reply, "get pos");
    if (const auto position = parseInteger(reply->data)) return *position;
  }
  throw StageError("the stage answered \"" + printable(reply->data) + "\" for its position");
}

void ZaberStage::setReferenced(bool referenced) {
  if (referenced != referenced_) ++reference_;
  referenced_ = referenced;
}

void ZaberStage::updateWarnings(const ZaberReply& reply) {
  if (reply.warning == "--") {
    flags_.clear();
  } else if (reply.warning != shown_flag_ || Steady::now() - flags_at_ > kWarningsPeriod) {
    flags_at_ = Steady::now();
    flags_ = {reply.warning};
    const ZaberReply all = request("warnings");
    // "02 FS WR": how many, then each.
    if (all.accepted) {
      for (std::size_t at = all.data.find(' '); at != std::string::npos;
           at = all.data.find(' ', at + 1)) {
        flags_.insert(all.data.substr(at + 1, 2));
      }
    }
  }
  shown_flag_ = reply.warning;
  for (const Named& remark : kRemarks) {
    if (flags_.count(remark.flag) != 0) {
      remarkOnce("the stage warns: " + std::string(remark.name) + " (" + remark.flag + ")");
    }
  }
}

StageReading ZaberStage::read() {
  const auto before = now();
  ZaberReply reply;
  std::int64_t position = askPosition(&reply);
  Stamp stamp = before + (now() - before) / 2;
  // Without checksums a garbled digit shows as a difference: at rest any, in motion a jump.
  for (int attempt = 0; !replies_protected_; ++attempt) {
    const auto again_before = now();
    const std::int64_t again = askPosition(&reply);
    const double seconds = std::chrono::duration<double>(now() - stamp).count();
    const double reach =
        reply.busy ? (max_speed_ ? 2.0 * static_cast<double>(*max_speed_) / kSpeedScale * seconds
                                 : std::numeric_limits<double>::infinity())
                   : 0.0;
    const bool agree = std::abs(static_cast<double>(again - position)) <= reach;
    position = again;
    stamp = again_before + (now() - again_before) / 2;
    if (agree) break;
    if (attempt == 10) throw StageError("the stage's readings contradict each other");
  }
  updateWarnings(reply);

  StageReading reading;
  for (const Named& fault : kFaults) {
    if (flags_.count(fault.flag) == 0) continue;
    reading.fault = std::string(fault.name) + " (" + fault.flag + ")";
    break;
  }
  for (const std::string& flag : flags_) {
    if (reading.fault.empty() && flag.front() == 'F') reading.fault = "fault " + printable(flag);
  }
  if (!reading.fault.empty()) lost_reference_ = true;
  const bool device_referenced = flags_.count("WR") == 0 && flags_.count("WH") == 0;
  if (homing_) {
    homing_seen_ = homing_seen_ || reply.busy;
    if (!reply.busy && (homing_seen_ || Steady::now() - homing_began_ > kTimeToBegin)) {
      homing_ = false;
      // NI: the last motion, which was this one, was interrupted.
      if (reading.fault.empty() && device_referenced && flags_.count("NI") == 0) {
        lost_reference_ = false;
      }
      ++reference_;
    }
  }
  setReferenced(device_referenced && !lost_reference_);
  reading.stamp = stamp;
  reading.position_m = static_cast<double>(position) * settings_.unit_m;
  reading.homed = referenced_ && !homing_;
  reading.moving = reply.busy || homing_;
  reading.reference = reference_;
  if (last_stamp_ && reading.moving && stamp > *last_stamp_) {
    reading.velocity_mps = static_cast<double>(position - last_position_) * settings_.unit_m /
                           std::chrono::duration<double>(stamp - *last_stamp_).count();
  }
  last_stamp_ = stamp;
  last_position_ = position;
  return reading;
}

void ZaberStage::sendMove(const std::string& command, std::int64_t speed, bool repeatable) {
  const auto send = [&](const std::string& text) -> ZaberReply {
    if (repeatable) return requestPatiently(text);
    if (const auto reply = requestOnce(text, false, kReplyTimeout, nullptr)) return *reply;
    // Whether it was heard is not known; what is certain is that it must not be heard twice.
    stop();
    throw StageError("the stage did not confirm \"" + text + "\" and was stopped");
  };
  if (speed_in_move_) {
    const std::string with_speed = command + " " + std::to_string(speed);
    const ZaberReply reply = send(with_speed);
    if (reply.accepted) return;
    if (reply.data != "BADDATA" && reply.data != "BADCOMMAND") {
      requireAccepted(reply, with_speed);
    }
  }
  // Firmware before 7 has the speed as a setting only.
  bool set = false;
  if (max_speed_) {
    set = requestPatiently("set maxspeed " + std::to_string(speed)).accepted;
    speed_was_set_ = speed_was_set_ || set;
  }
  requireAccepted(send(command), command);
  speed_in_move_ = false;
  if (!set) remarkOnce("the stage takes no speed: it moves at its own");
}

void ZaberStage::moveAbsolute(std::int64_t target, std::int64_t speed) {
  if ((limit_min_ && target < *limit_min_) || (limit_max_ && target > *limit_max_)) {
    const auto metres = [&](std::int64_t native) {
      return formatNumber(std::round(static_cast<double>(native) * settings_.unit_m * 1e6) * 1e-6);
    };
    throw StageError("position " + metres(target) + " m is outside the stage's limits (" +
                     (limit_min_ ? metres(*limit_min_) : "?") + " to " +
                     (limit_max_ ? metres(*limit_max_) : "?") + " m)");
  }
  sendMove("move abs " + std::to_string(target), speed, true);
}

void ZaberStage::moveRelative(std::int64_t target, std::int64_t speed) {
  ZaberReply reply;
  std::int64_t position = askPosition(&reply);
  if (reply.busy) {
    stop();
    const Steady::time_point deadline = Steady::now() + kTimeToBrake;
    while (reply.busy) {
      if (Steady::now() > deadline) throw StageError("the stage is still braking");
      std::this_thread::sleep_for(kAgainPause);
      position = askPosition(&reply);
    }
  }
  sendMove("move rel " + std::to_string(target - position), speed, false);
}

void ZaberStage::moveTo(double position_m, double speed_mps) {
  const double native = position_m / settings_.unit_m;
  const double native_speed = speed_mps / std::abs(settings_.unit_m) * kSpeedScale;
  if (!(std::abs(native) < 2e9)) throw StageError("position is not finite or too far");
  if (!(native_speed > 0.0)) throw StageError("speed is not above 0");
  if (homing_) throw StageError("the stage is homing");
  const auto target = static_cast<std::int64_t>(std::llround(native));
  auto speed = static_cast<std::int64_t>(std::clamp(std::round(native_speed), 1.0, 2e9));
  if (max_speed_) speed = std::min(speed, *max_speed_);
  if (referenced_) {
    moveAbsolute(target, speed);
  } else {
    moveRelative(target, speed);
  }
}

void ZaberStage::stop() {
  requireAccepted(requestPatiently("stop"), "stop");
  if (homing_) {
    homing_ = false;
    lost_reference_ = true;
    setReferenced(false);
  }
}

void ZaberStage::home() {
  requireAccepted(requestPatiently("home"), "home");
  homing_ = true;
  homing_seen_ = false;
  homing_began_ = Steady::now();
  ++reference_;
}

void ZaberStage::recover() {
  requireAccepted(requestPatiently("warnings clear"), "warnings clear");
  // The next reading shows what stays.
  shown_flag_.clear();
}

}  // namespace

std::unique_ptr<Stage> openZaberStage(const std::string& port, const StageSettings& settings) {
  if (settings.unit_m == 0.0) {
    throw InputError("stage", "unit_m",
                     "is not set, expected the length of a microstep in metres (it stands on the "
                     "stage's data sheet)");
  }
  return std::make_unique<ZaberStage>(port, settings);
}

}  // namespace omnister::device
