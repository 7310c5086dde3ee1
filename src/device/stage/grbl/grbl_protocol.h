// SPDX-License-Identifier: Apache-2.0
/// @file The lines of GRBL 1.1 (gnea/grbl, doc/markdown/interface.md).
#pragma once

#include <array>
#include <optional>
#include <string>
#include <string_view>

namespace omnister::device {

/// A real-time report, `<Jog|MPos:1.000,0.000,0.000|FS:500,0|WCO:0.000,0.000,0.000>`.
struct GrblStatus {
  std::string
      state;  ///< without the sub-state: Idle, Run, Hold, Jog, Alarm, Door, Check, Home, Sleep
  int sub_state = 0;                             ///< of Hold and Door
  std::optional<std::array<double, 3>> machine;  ///< MPos
  std::optional<std::array<double, 3>> work;     ///< WPos = MPos - offset
  std::optional<std::array<double, 3>> offset;   ///< WCO, now and then
};

/// Taken strictly: whatever is not exactly a report is refused.
std::optional<GrblStatus> parseGrblStatus(std::string_view line);

/// N of "ALARM:N" or "error:N" or another prefix; nullopt for other lines.
std::optional<int> parseGrblCode(std::string_view line, std::string_view prefix);

/// What alarm N means, e.g. "hard limit (ALARM:1)".
std::string grblAlarmName(int number);
/// What error N means, e.g. "travel exceeded (error:15)".
std::string grblErrorName(int number);

}  // namespace omnister::device
