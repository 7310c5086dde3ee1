// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <optional>

namespace omnister {

/// Sees that somebody set the clock: it went on by another time than the steady one.
class ClockWatch {
 public:
  /// @param clock time of day [s]  @param steady time by a clock that nobody sets [s], both now
  /// @return by how much it was set since the call before [s], where that is more than a daemon
  /// which keeps time corrects at once
  std::optional<double> jump(double clock, double steady) {
    const double ahead = clock - steady;
    const double by = ahead - last_.value_or(ahead);
    last_ = ahead;
    if (std::abs(by) < kLeast) return std::nullopt;
    return by;
  }

 private:
  static constexpr double kLeast = 0.2;  // [s]
  std::optional<double> last_;
};

}  // namespace omnister
