// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <utility>

#include "omnister/common/numbers.h"
#include "omnister/sim/serial_devices.h"

namespace omnister::sim {
namespace {

constexpr double kMetres = 0.001;  // per millimetre
constexpr double kInch = 25.4;     // [mm]
constexpr double kOffset = 12.5;   // of the work coordinates [mm]
constexpr std::size_t kReceiveBuffer = 128;

}  // namespace

GrblSimulator::GrblSimulator(const GrblOptions& options, std::shared_ptr<SimulatedStage> stage,
                             const SimulatedStageOptions& mechanics)
    : SerialStageDevice(std::move(stage), options.seed),
      options_(options),
      mechanics_(mechanics),
      state_(options.homing_enabled ? State::kAlarm : State::kIdle) {
  // Its thread calls as soon as it is there, and waits until cable_ is.
  const std::lock_guard<std::mutex> lock(mutex_);
  cable_ = std::make_unique<SerialCable>(
      options.link, [this](std::string_view bytes) { onBytes(bytes); }, [this] { onTick(); });
}

void GrblSimulator::say(const std::string& line) {
  if (frozen_ || happens(faults().lose)) return;
  cable_->send(wire(line) + "\r\n");
}

void GrblSimulator::alarm(int number) {
  state_ = State::kAlarm;
  critical_ = number == 1 || number == 2;
  say("ALARM:" + std::to_string(number));
  say(critical_ ? "[MSG:Reset to continue]" : "[MSG:'$H'|'$X' to unlock]");
}

void GrblSimulator::powerCycle() {
  const std::lock_guard<std::mutex> lock(mutex_);
  stage_->powerCycle();
  buffer_.clear();
  critical_ = false;
  reports_ = 0;
  state_ = options_.homing_enabled ? State::kAlarm : State::kIdle;
  say("Grbl 1.1h ['$' for help]");
  if (options_.homing_enabled) say("[MSG:'$H'|'$X' to unlock]");
}

void GrblSimulator::softReset() {
  const device::StageReading reading = stage_->read();
  const bool homed = reading.homed && state_ != State::kHome;
  if (reading.moving) {
    const bool homing = state_ == State::kHome;
    // The steps stop where they are, and what the motor did after them is not known.
    stage_->powerCycle();
    alarm(homing ? 6 : 3);
  }
  critical_ = false;
  reports_ = 0;
  buffer_.clear();
  stage_->recover();
  say("Grbl 1.1h ['$' for help]");
  const bool lock = options_.homing_enabled && (state_ == State::kAlarm || !homed);
  state_ = lock ? State::kAlarm : State::kIdle;
  if (lock) say("[MSG:'$H'|'$X' to unlock]");
}

int GrblSimulator::heard(const std::string& text) {
  const std::lock_guard<std::mutex> lock(mutex_);
  int count = 0;
  for (std::size_t at = heard_.find(text); at != std::string::npos;
       at = heard_.find(text, at + 1)) {
    ++count;
  }
  return count;
}

void GrblSimulator::onBytes(std::string_view bytes) {
  const std::lock_guard<std::mutex> lock(mutex_);
  for (const char byte : bytes) {
    const auto code = static_cast<unsigned char>(byte);
    if (byte == '?' || byte == '!' || byte == '~' || code == 0x18 || code >= 0x80) {
      onRealtime(byte);
    } else if (byte == '\n' || byte == '\r') {
      if (!buffer_.empty()) onLine(wire(std::exchange(buffer_, {})));
    } else if (buffer_.size() < kReceiveBuffer) {
      buffer_.push_back(byte);
    }
  }
}

void GrblSimulator::onRealtime(char byte) {
  const auto code = static_cast<unsigned char>(byte);
  if (byte == '?') ++asked_;
  if (frozen_) return;
  if (code == 0x18) {
    heard_ += "reset\n";
    softReset();
    return;
  }
  // After a limit alarm nothing else is heard; while homing nobody listens.
  if (critical_ || state_ == State::kHome) return;
  if (byte == '?') report();
  if (code == 0x85 && state_ == State::kJog) stage_->stop();
  if (byte == '!' && state_ == State::kJog) {
    stage_->stop();
    state_ = State::kHold;
  }
  if (byte == '~' && state_ == State::kHold) state_ = State::kIdle;
}

void GrblSimulator::report() {
  const device::StageReading reading = stage_->read();
  const char* state = "Idle";
  if (state_ == State::kJog) state = "Jog";
  if (state_ == State::kAlarm) state = "Alarm";
  if (state_ == State::kHold) state = reading.moving ? "Hold:1" : "Hold:0";
  const double scale = options_.inches ? 1.0 / kInch : 1.0;
  const double offset = options_.work_positions ? kOffset : 0.0;
  const double x = (reading.position_m / kMetres - offset) * scale;
  const int decimals = options_.inches ? 4 : 3;
  char text[160];
  std::snprintf(text, sizeof(text), "<%s|%s:%.*f,%.*f,%.*f|FS:%.0f,0", state,
                options_.work_positions ? "WPos" : "MPos", decimals, x, decimals, 0.0, decimals,
                0.0, std::abs(reading.velocity_mps) / kMetres * 60.0 * scale);
  std::string line = text;
  if (reports_++ % 10 == 3) {
    std::snprintf(text, sizeof(text), "|WCO:%.*f,%.*f,%.*f", decimals, offset * scale, decimals,
                  0.0, decimals, 0.0);
    line += text;
  }
  say(line + ">");
}

void GrblSimulator::onLine(const std::string& line) {
  if (frozen_) return;
  heard_ += line + "\n";
  if (critical_ || state_ == State::kHome) return;
  if (line == "$$") {
    char text[64];
    const auto setting = [&](int number, double value) {
      std::snprintf(text, sizeof(text), "$%d=%.3f", number, value);
      say(text);
    };
    say(options_.work_positions ? "$10=0" : "$10=1");
    say(options_.inches ? "$13=1" : "$13=0");
    say(options_.soft_limits ? "$20=1" : "$20=0");
    say(options_.homing_enabled ? "$22=1" : "$22=0");
    setting(110, mechanics_.max_speed_mps / kMetres * 60.0);
    setting(120, mechanics_.acceleration_mps2 / kMetres);
    setting(130, mechanics_.travel_m / kMetres);
    say("ok");
  } else if (line == "$I") {
    say("[VER:1.1h.20190825:]");
    say("[OPT:V,15,128]");
    say("ok");
  } else if (line == "$X") {
    if (state_ == State::kAlarm) {
      state_ = State::kIdle;
      say("[MSG:Caution: Unlocked]");
    }
    say("ok");
  } else if (line == "$H") {
    if (!options_.homing_enabled) {
      say("error:5");
    } else if (state_ == State::kJog || state_ == State::kHold) {
      say("error:8");
    } else {
      stage_->recover();
      stage_->home();
      state_ = State::kHome;
    }
  } else if (line.rfind("$J=", 0) == 0) {
    jog(line);
  } else {
    say(state_ == State::kAlarm ? "error:9" : "error:20");
  }
}

void GrblSimulator::jog(const std::string& line) {
  if (state_ == State::kAlarm) return say("error:9");
  if (state_ != State::kIdle && state_ != State::kJog) return say("error:8");
  double x = NAN, feed = NAN;
  std::size_t at = 3;
  while (at < line.size()) {
    const std::size_t end = std::min(line.find(' ', at), line.size());
    const std::string word = line.substr(at, end - at);
    at = end + 1;
    const std::optional<double> value =
        word.size() > 1 ? parseNumber(word.substr(1)) : std::nullopt;
    if (!value) return say("error:2");
    if (word == "G53" || word == "G21" || word == "G90") continue;
    if (word.front() == 'X') {
      x = *value;
    } else if (word.front() == 'F') {
      feed = *value;
    } else {
      return say("error:16");
    }
  }
  if (!std::isfinite(x) || !(feed > 0.0)) return say("error:16");
  const device::StageReading reading = stage_->read();
  const double target = x * kMetres;
  constexpr double kSlack = 1e-9;
  if (reading.homed && (target < -kSlack || target > mechanics_.travel_m + kSlack)) {
    if (options_.soft_limits) return say("error:15");
    say("ok");
    stage_->moveTo(std::clamp(target, 0.0, mechanics_.travel_m), feed * kMetres / 60.0);
    return alarm(1);
  }
  stage_->moveTo(target, feed * kMetres / 60.0);
  state_ = State::kJog;
  say("ok");
}

void GrblSimulator::onTick() {
  const std::lock_guard<std::mutex> lock(mutex_);
  const device::StageReading reading = stage_->read();
  if (!reading.fault.empty() && state_ != State::kAlarm) {
    // A motor that stalls runs into nothing that GRBL sees: only a switch says so.
    if (reading.fault == "limit") alarm(1);
  }
  if (reading.moving) return;
  if (state_ == State::kJog) state_ = State::kIdle;
  if (state_ == State::kHome) {
    state_ = State::kIdle;
    say("ok");
  }
}

}  // namespace omnister::sim
