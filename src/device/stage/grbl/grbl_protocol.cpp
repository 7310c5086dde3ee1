// SPDX-License-Identifier: Apache-2.0
#include "device/stage/grbl/grbl_protocol.h"

#include <algorithm>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"

namespace omnister::device {
namespace {

constexpr std::string_view kStates[] = {"Idle", "Run",   "Hold", "Jog",  "Alarm",
                                        "Door", "Check", "Home", "Sleep"};

/// "-12.345": a sign, digits, three or four decimals.
bool isCoordinate(std::string_view text) {
  if (!text.empty() && text.front() == '-') text.remove_prefix(1);
  const std::size_t point = text.find('.');
  if (point == 0 || point == std::string_view::npos) return false;
  const std::size_t decimals = text.size() - point - 1;
  if (decimals < 3 || decimals > 4) return false;
  for (std::size_t i = 0; i < text.size(); ++i) {
    if (i != point && (text[i] < '0' || text[i] > '9')) return false;
  }
  return true;
}

std::optional<std::array<double, 3>> parseAxes(std::string_view text) {
  std::array<double, 3> axes{};
  for (std::size_t i = 0; i < axes.size(); ++i) {
    const std::size_t comma = text.find(',');
    if ((comma == std::string_view::npos) != (i == 2)) return std::nullopt;
    const std::string_view word = text.substr(0, comma);
    const std::optional<double> value = isCoordinate(word) ? parseNumber(word) : std::nullopt;
    if (!value) return std::nullopt;
    axes[i] = *value;
    text.remove_prefix(i == 2 ? text.size() : comma + 1);
  }
  return axes;
}

bool isPlain(std::string_view text) {
  return std::all_of(text.begin(), text.end(), [](char c) {
    return (c >= '0' && c <= '9') || (c >= 'A' && c <= 'Z') || (c >= 'a' && c <= 'z') || c == '.' ||
           c == ',' || c == ':' || c == '-';
  });
}

}  // namespace

std::optional<GrblStatus> parseGrblStatus(std::string_view line) {
  if (line.size() < 2 || line.front() != '<' || line.back() != '>') return std::nullopt;
  line = line.substr(1, line.size() - 2);
  GrblStatus status;
  bool first = true;
  while (true) {
    const std::size_t bar = line.find('|');
    const std::string_view field = line.substr(0, bar);
    if (field.empty() || !isPlain(field)) return std::nullopt;
    if (first) {
      const std::size_t colon = field.find(':');
      const std::string_view state = field.substr(0, colon);
      if (std::find(std::begin(kStates), std::end(kStates), state) == std::end(kStates)) {
        return std::nullopt;
      }
      status.state = std::string(state);
      if (colon != std::string_view::npos) {
        const std::string_view sub = field.substr(colon + 1);
        if (sub.size() != 1 || sub.front() < '0' || sub.front() > '3') return std::nullopt;
        status.sub_state = sub.front() - '0';
      }
      first = false;
    } else {
      const auto take = [&](std::string_view key, std::optional<std::array<double, 3>>* value) {
        if (field.substr(0, key.size()) != key) return true;
        if (*value) return false;
        *value = parseAxes(field.substr(key.size()));
        return value->has_value();
      };
      if (!take("MPos:", &status.machine) || !take("WPos:", &status.work) ||
          !take("WCO:", &status.offset)) {
        return std::nullopt;
      }
    }
    if (bar == std::string_view::npos) break;
    line.remove_prefix(bar + 1);
  }
  if (status.machine.has_value() == status.work.has_value()) return std::nullopt;
  return status;
}

std::optional<int> parseGrblCode(std::string_view line, std::string_view prefix) {
  if (line.substr(0, prefix.size()) != prefix) return std::nullopt;
  line.remove_prefix(prefix.size());
  if (line.empty() || line.size() > 3) return std::nullopt;
  int value = 0;
  for (const char c : line) {
    if (c < '0' || c > '9') return std::nullopt;
    value = 10 * value + (c - '0');
  }
  return value;
}

std::string grblAlarmName(int number) {
  static constexpr const char* kNames[] = {
      "hard limit",
      "soft limit",
      "reset while moving",
      "probe in its first state already",
      "probe found nothing",
      "homing failed: reset",
      "homing failed: door opened",
      "homing failed: the switch did not open",
      "homing failed: no switch found",
      "homing failed: second switch not found",
  };
  const std::string code = " (ALARM:" + std::to_string(number) + ")";
  return (number >= 1 && number <= 10 ? kNames[number - 1] : "alarm") + code;
}

std::string grblErrorName(int number) {
  const char* name = "refused";
  switch (number) {
    case 2:
      name = "bad number";
      break;
    case 3:
      name = "unknown command";
      break;
    case 5:
      name = "homing is not enabled ($22)";
      break;
    case 8:
      name = "only while idle";
      break;
    case 9:
      name = "locked: home it first";
      break;
    case 11:
      name = "line too long";
      break;
    case 15:
      name = "outside the soft limits";
      break;
    case 16:
      name = "bad jog command";
      break;
    default:
      break;
  }
  return std::string(name) + " (error:" + std::to_string(number) + ")";
}

}  // namespace omnister::device
