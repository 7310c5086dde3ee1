// SPDX-License-Identifier: Apache-2.0
/// @file From a device's clock to the host's.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <optional>

#include "omnister/device/camera.h"

namespace omnister::device {

/// News of an event arrives after it by a delay that is now and then at its least. So the smallest
/// difference between the host's clock at arrival and the device's clock at the event, over the
/// last events, is the difference of the clocks (and that least delay), whatever the load of the
/// host. Clocks may drift, and the host's may be set.
class ClockMapping {
 public:
  /// @param device time of the event on the device's clock [ns]  @param arrival on the host's
  void observe(std::int64_t device, Stamp arrival) {
    const std::int64_t offset = arrival.time_since_epoch().count() - device;
    const bool backwards = last_ && device < *last_;
    last_ = device;
    if (!older_ || backwards || std::llabs(offset - *offset_) > kJump) {
      older_ = current_ = offset;
      seen_ = 0;
    }
    current_ = std::min(*current_, offset);
    offset_ = std::min(*older_, *current_);
    if (++seen_ >= kWindow) {
      older_ = current_;
      current_ = offset;
      seen_ = 0;
    }
  }

  /// observe() comes first.
  Stamp toHost(std::int64_t device) const {
    return Stamp(std::chrono::nanoseconds(device + offset_.value_or(0)));
  }

  /// Host minus device [ns].
  std::optional<std::int64_t> offset() const { return offset_; }

 private:
  static constexpr int kWindow = 50;
  // No delay is as long as this: a clock was set.
  static constexpr std::int64_t kJump = 1000000000;
  std::optional<std::int64_t> last_, older_, current_, offset_;
  int seen_ = 0;
};

}  // namespace omnister::device
