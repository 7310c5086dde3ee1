// SPDX-License-Identifier: Apache-2.0
/// @file When the frames of a camera were exposed, on the host's clock.
#pragma once

#include <chrono>
#include <cstdint>
#include <optional>

#include "device/camera/aravis/aravis_connection.h"
#include "device/camera/clock_mapping.h"
#include "omnister/device/camera.h"

namespace omnister::device {

class AravisClock {
 public:
  explicit AravisClock(AravisConnection& connection) : on_(connection) {}

  /// Asks the camera for chunk data and PTP where the settings want them.
  void configure(const CameraSettings& settings);
  /// Before a stream starts.
  void prepare();
  /// What the camera said that it exposes [us].
  void setExposure(double exposure_us) { exposure_us_ = exposure_us; }
  /// The middle of the exposure.
  Stamp stampOf(ArvBuffer* buffer);

 private:
  using Steady = std::chrono::steady_clock;

  void chooseChunks();
  void choosePtp();
  void readExposureTime();
  void measureClock();
  void watchPtp();
  std::int64_t toNanoseconds(gint64 ticks) const;

  AravisConnection& on_;
  bool ptp_asked_ = false;
  bool stamp_is_exposure_end_ = false;
  double stamp_offset_us_ = 0.0;
  Object<ArvChunkParser> chunks_;
  double exposure_us_ = 0.0;
  bool exposure_changes_ = false;
  Steady::time_point exposure_due_, latch_due_, ptp_due_;
  ClockMapping clock_;
  std::optional<bool> latch_works_;
  std::optional<std::int64_t> latch_offset_;
  gint64 latched_ = 0;
  bool ptp_wanted_ = false, ptp_locked_ = false;
};

}  // namespace omnister::device
