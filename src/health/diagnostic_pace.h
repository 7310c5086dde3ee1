// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>

namespace omnister {

/// [s] between the diagnostics of a node, if nothing else is asked for: often enough that whoever
/// looks hears of a fault within two seconds.
constexpr double kDiagnosticPeriod = 0.5;

/// When a node's diagnostics are due, by the steady clock. The updater's own update() goes by the
/// time of ROS, and falls silent for as long as a clock is set back, or a recording pauses.
class DiagnosticPace {
 public:
  explicit DiagnosticPace(double period_s = kDiagnosticPeriod)
      : period_(
            std::chrono::duration_cast<Steady::duration>(std::chrono::duration<double>(period_s))) {
  }

  /// True once in each period.
  bool due() {
    const Steady::time_point now = Steady::now();
    if (now < next_) return false;
    next_ = now + period_;
    return true;
  }

 private:
  using Steady = std::chrono::steady_clock;
  Steady::duration period_;
  Steady::time_point next_;
};

}  // namespace omnister
