// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <sstream>
#include <utility>
#include <vector>

#include "device/stage/zaber/zaber_protocol.h"
#include "omnister/common/numbers.h"
#include "omnister/sim/serial_devices.h"

namespace omnister::sim {
namespace {

constexpr double kSpeedScale = 1.6384;

std::vector<std::string> wordsOf(const std::string& line) {
  std::istringstream stream(line);
  std::vector<std::string> words;
  for (std::string word; stream >> word;) words.push_back(word);
  return words;
}

bool isNumber(const std::string& word) {
  return !word.empty() && word.find_first_not_of("0123456789") == std::string::npos;
}

/// Whole numbers separated by blanks; empty for anything else.
std::vector<std::int64_t> integersOf(const std::string& text) {
  std::vector<std::int64_t> numbers;
  for (const std::string& word : wordsOf(text)) {
    const std::optional<double> value = parseNumber(word);
    if (!value || *value != std::floor(*value) || !(std::abs(*value) < 1e12)) return {};
    numbers.push_back(static_cast<std::int64_t>(*value));
  }
  return numbers;
}

}  // namespace

ZaberSimulator::ZaberSimulator(const ZaberOptions& options, std::shared_ptr<SimulatedStage> stage,
                               const SimulatedStageOptions& mechanics)
    : SerialStageDevice(std::move(stage), options.seed),
      options_(options),
      mechanics_(mechanics),
      alert_(options.alerts),
      max_speed_(std::llround(mechanics.max_speed_mps / options.unit_m * kSpeedScale)) {
  // Its thread calls as soon as it is there, and waits until cable_ is.
  const std::lock_guard<std::mutex> lock(mutex_);
  cable_ = std::make_unique<SerialCable>(
      options.link, [this](std::string_view bytes) { onBytes(bytes); }, [this] { onTick(); });
}

std::int64_t ZaberSimulator::native(double position_m) const {
  return std::llround(position_m / options_.unit_m);
}

void ZaberSimulator::powerCycle() {
  const std::lock_guard<std::mutex> lock(mutex_);
  stage_->powerCycle();
  buffer_.clear();
  was_busy_ = false;
}

void ZaberSimulator::rejectNext(const std::string& reason) {
  const std::lock_guard<std::mutex> lock(mutex_);
  reject_next_ = reason;
}

void ZaberSimulator::onBytes(std::string_view bytes) {
  const std::lock_guard<std::mutex> lock(mutex_);
  for (const char byte : bytes) {
    if (byte != '\n' && byte != '\r') {
      buffer_.push_back(byte);
      continue;
    }
    if (!buffer_.empty()) onLine(wire(std::exchange(buffer_, {})));
  }
}

void ZaberSimulator::onTick() {
  const std::lock_guard<std::mutex> lock(mutex_);
  const bool busy = stage_->read().moving;
  if (was_busy_ && !busy && alert_ && !frozen_) {
    std::string body = std::to_string(options_.device_number) + " 1 IDLE " + warningFlags(false);
    if (body.size() < 2 || options_.device_number < 10) body.insert(0, "0");
    if (checksum_) body += ":" + device::zaberChecksum(body);
    cable_->send("!" + body + "\r\n");
  }
  was_busy_ = busy;
}

void ZaberSimulator::onLine(std::string line) {
  if (frozen_ || line.front() != '/') return;
  line.erase(0, 1);
  const std::size_t colon = line.rfind(':');
  if (colon != std::string::npos) {
    // A command with a wrong checksum is not answered.
    if (line.substr(colon + 1) != device::zaberChecksum(line.substr(0, colon))) return;
    line.erase(colon);
  }
  std::vector<std::string> words = wordsOf(line);
  std::vector<std::string> address;
  while (!words.empty() && address.size() < 3 && isNumber(words.front())) {
    address.push_back(words.front());
    words.erase(words.begin());
  }
  const int device = address.empty() ? 0 : std::stoi(address[0].substr(0, 4));
  const int axis = address.size() < 2 ? 0 : std::stoi(address[1].substr(0, 4));
  const std::string id = address.size() < 3 ? "" : address[2];
  if (device != 0 && device != options_.device_number) return;
  bool accepted = true;
  std::string data;
  std::string command;
  for (const std::string& word : words) command += (command.empty() ? "" : " ") + word;
  if (axis > 1) {
    accepted = false;
    data = "BADAXIS";
  } else if (!reject_next_.empty()) {
    accepted = false;
    data = std::exchange(reject_next_, {});
  } else if (happens(faults().reject)) {
    accepted = false;
    data = "AGAIN";
  } else {
    data = execute(command, &accepted);
  }
  reply(axis, id, accepted, data);
}

std::string ZaberSimulator::warningFlags(bool all) {
  const device::StageReading reading = stage_->read();
  std::vector<std::string> flags;
  if (reading.fault == "stalled") flags.emplace_back("FS");
  if (reading.fault == "limit") flags.emplace_back("WL");
  if (!reading.homed && !reading.moving) flags.emplace_back("WR");
  if (!all) return flags.empty() ? "--" : flags.front();
  char count[8];
  std::snprintf(count, sizeof(count), "%02zu", flags.size());
  std::string text = count;
  for (const std::string& flag : flags) text += " " + flag;
  return text;
}

void ZaberSimulator::reply(int axis, const std::string& id, bool accepted,
                           const std::string& data) {
  char head[16];
  std::snprintf(head, sizeof(head), "%02d %d", options_.device_number, axis);
  std::string body = head;
  if (!id.empty()) body += " " + id;
  body += accepted ? " OK " : " RJ ";
  body += stage_->read().moving ? "BUSY " : "IDLE ";
  body += warningFlags(false) + " " + data;
  if (checksum_) body += ":" + device::zaberChecksum(body);
  if (happens(faults().lose)) return;
  cable_->send(wire("@" + body) + "\r\n");
}

std::string ZaberSimulator::move(const std::string& kind, const std::string& arguments,
                                 bool* accepted) {
  const auto refuse = [&](const char* reason) {
    *accepted = false;
    return reason;
  };
  const device::StageReading reading = stage_->read();
  std::vector<std::int64_t> numbers = integersOf(arguments);
  double target = 0.0;
  std::int64_t speed = max_speed_;
  const bool has_target = kind == "abs" || kind == "rel" || kind == "vel";
  if (numbers.size() < (has_target ? 1u : 0u)) return refuse("BADDATA");
  if (numbers.size() > (has_target ? 2u : 1u)) return refuse("BADDATA");
  if (kind != "vel" && numbers.size() == (has_target ? 2u : 1u)) {
    if (!options_.speed_in_move) return refuse("BADDATA");
    speed = numbers.back();
  }
  if (kind == "abs" || kind == "min" || kind == "max") {
    // Without a reference an absolute position means nothing.
    if (!reading.homed) return refuse("BADDATA");
    target = kind == "abs" ? static_cast<double>(numbers[0]) * options_.unit_m
                           : (kind == "min" ? 0.0 : mechanics_.travel_m);
  } else if (kind == "rel") {
    target = reading.position_m + static_cast<double>(numbers[0]) * options_.unit_m;
  } else if (kind == "vel") {
    speed = std::abs(numbers[0]);
    target = numbers[0] > 0 ? mechanics_.travel_m : -mechanics_.travel_m;
    if (reading.homed) target = std::clamp(target, 0.0, mechanics_.travel_m);
  } else {
    return refuse("BADCOMMAND");
  }
  if (speed < 1 || speed > max_speed_) return refuse("BADDATA");
  try {
    // A new motion clears the fault of the last one.
    if (!reading.fault.empty()) stage_->recover();
    stage_->moveTo(target, static_cast<double>(speed) / kSpeedScale * options_.unit_m);
  } catch (const device::StageError&) {
    return refuse("BADDATA");
  }
  return "0";
}

std::string ZaberSimulator::execute(const std::string& command, bool* accepted) {
  const auto refuse = [&](const char* reason) -> std::string {
    *accepted = false;
    return reason;
  };
  const auto starts = [&](const char* prefix) { return command.rfind(prefix, 0) == 0; };
  if (command.empty()) return "0";
  if (command == "get pos") return std::to_string(native(stage_->read().position_m));
  if (command == "get limit.min") return "0";
  if (command == "get limit.max") return std::to_string(native(mechanics_.travel_m));
  if (command == "get maxspeed") return std::to_string(max_speed_);
  if (command == "get deviceid") return "50081";
  if (command == "get version") return options_.speed_in_move ? "7.34" : "6.28";
  if (command == "get system.serial") return options_.serial;
  if (command == "get comm.checksum" && options_.has_checksums) return checksum_ ? "1" : "0";
  if (command == "get comm.alert") return alert_ ? "1" : "0";
  if (command == "warnings") return warningFlags(true);
  if (command == "stop" || command == "estop") {
    stage_->stop();
    return "0";
  }
  if (command == "warnings clear") {
    const std::string flags = warningFlags(true);
    stage_->recover();
    return flags;
  }
  if (command == "home") {
    stage_->recover();
    stage_->home();
    return "0";
  }
  if (starts("move ")) {
    const std::size_t end = std::min(command.find(' ', 5), command.size());
    return move(command.substr(5, end - 5), command.substr(end), accepted);
  }
  const auto setting = [&](const char* name) {
    return starts((std::string("set ") + name + " ").c_str())
               ? integersOf(command.substr(command.rfind(' ')))
               : std::vector<std::int64_t>();
  };
  if (const auto value = setting("comm.checksum"); !value.empty() && options_.has_checksums) {
    if (value[0] != 0 && value[0] != 1) return refuse("BADDATA");
    checksum_ = value[0] == 1;
    return "0";
  }
  if (const auto value = setting("comm.alert"); !value.empty()) {
    alert_ = value[0] == 1;
    return "0";
  }
  if (const auto value = setting("maxspeed"); !value.empty()) {
    if (value[0] < 1) return refuse("BADDATA");
    max_speed_ = value[0];
    return "0";
  }
  return refuse("BADCOMMAND");
}

}  // namespace omnister::sim
