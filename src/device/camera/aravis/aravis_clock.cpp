// SPDX-License-Identifier: Apache-2.0
#include "device/camera/aravis/aravis_clock.h"

#include <cmath>
#include <cstdlib>
#include <thread>

#include "device/camera/aravis/aravis_features.h"

namespace omnister::device {
namespace {

using std::chrono::milliseconds;
using std::chrono::nanoseconds;
using std::chrono::seconds;

// What the clocks of device and host drift apart in between is less than a millisecond.
constexpr seconds kLatchAgain(10), kExposureAgain(1), kPtpAgain(1);
constexpr int kLatches = 3;
constexpr std::int64_t kClockWasSet = 1000000000;  // [ns]

}  // namespace

void AravisClock::configure(const CameraSettings& settings) {
  ptp_asked_ = settings.ptp;
  stamp_is_exposure_end_ = settings.stamp_is_exposure_end;
  stamp_offset_us_ = settings.stamp_offset_us;
  if (settings.chunks) chooseChunks();
  if (settings.ptp) choosePtp();
}

void AravisClock::prepare() {
  readExposureTime();
  if (ptp_asked_ || !clock_.offset()) measureClock();
}

void AravisClock::chooseChunks() {
  Failure failure;
  if (!arv_camera_are_chunks_available(on_.camera(), failure.out())) {
    on_.detail("this camera has no chunk data");
    return;
  }
  arv_camera_set_chunks(on_.camera(), "ExposureTime,Timestamp", failure.out());
  if (on_.tellIf(failure, "chunk data")) return;
  chunks_.reset(arv_camera_create_chunk_parser(on_.camera()));
}

void AravisClock::choosePtp() {
  Failure failure;
  for (const char* feature : {"PtpEnable", "GevIEEE1588"}) {
    if (!on_.has(feature)) continue;
    arv_camera_set_boolean(on_.camera(), feature, TRUE, failure.out());
    if (on_.tellIf(failure, feature)) continue;
    ptp_wanted_ = true;
    return;
  }
  on_.remark("this camera has no PTP; its clock is mapped by arrival");
}

void AravisClock::readExposureTime() {
  if (const std::optional<double> exposure = readExposure(on_)) exposure_us_ = *exposure;
  const std::string mode = readExposureAuto(on_);
  exposure_changes_ = !mode.empty() && mode != "off";
  exposure_due_ = Steady::now() + kExposureAgain;
}

/// The device's clock against ours, asked for on the wire.
void AravisClock::measureClock() {
  latch_due_ = Steady::now() + kLatchAgain;
  if (latch_works_ && !*latch_works_) return;
  const struct {
    const char* command;
    const char* value;
  } names[] = {{"TimestampLatch", "TimestampLatchValue"},
               {"GevTimestampControlLatch", "GevTimestampValue"}};
  Failure failure;
  for (const auto& name : names) {
    if (!on_.has(name.command) || !on_.has(name.value)) continue;
    nanoseconds least = seconds(1);
    std::optional<std::int64_t> offset;
    for (int i = 0; i < kLatches; ++i) {
      const Stamp before = now();
      arv_camera_execute_command(on_.camera(), name.command, failure.out());
      const Stamp after = now();
      if (failure) break;
      // The latched value may stand there a little later.
      gint64 ticks = latched_;
      for (int wait = 0; wait < 10 && ticks == latched_; ++wait) {
        ticks = arv_camera_get_integer(on_.camera(), name.value, failure.out());
        if (failure) break;
        if (ticks == latched_) std::this_thread::sleep_for(milliseconds(1));
      }
      if (failure || ticks == latched_) break;
      latched_ = ticks;
      if (after - before >= least) continue;
      least = after - before;
      offset = (before + (after - before) / 2).time_since_epoch().count() - toNanoseconds(ticks);
    }
    if (offset) {
      latch_works_ = true;
      latch_offset_ = offset;
      return;
    }
  }
  if (!latch_works_) {
    latch_works_ = false;
    on_.detail("the camera's clock cannot be read, it is mapped by arrival");
  }
}

std::int64_t AravisClock::toNanoseconds(gint64 ticks) const {
  if (ARV_IS_GV_DEVICE(arv_camera_get_device(on_.camera()))) {
    Failure failure;
    const guint64 frequency = arv_gv_device_get_timestamp_tick_frequency(
        ARV_GV_DEVICE(arv_camera_get_device(on_.camera())), failure.out());
    if (!failure && frequency > 0 && frequency != 1000000000u) {
      return static_cast<std::int64_t>(static_cast<long double>(ticks) * 1e9L /
                                       static_cast<long double>(frequency));
    }
  }
  return ticks;
}

void AravisClock::watchPtp() {
  if (!ptp_wanted_ || Steady::now() < ptp_due_) return;
  ptp_due_ = Steady::now() + kPtpAgain;
  Failure failure;
  for (const char* feature : {"PtpStatus", "GevIEEE1588Status"}) {
    if (!on_.has(feature)) continue;
    const std::string status =
        lower(string(arv_camera_get_string(on_.camera(), feature, failure.out())));
    const bool locked = !failure && (status == "slave" || status == "master");
    if (locked != ptp_locked_) {
      on_.detail("PTP: " + status);
      clock_ = ClockMapping();
    }
    ptp_locked_ = locked;
    return;
  }
}

Stamp AravisClock::stampOf(ArvBuffer* buffer) {
  if (exposure_changes_ && Steady::now() >= exposure_due_) readExposureTime();
  if (latch_works_.value_or(false) && Steady::now() >= latch_due_) measureClock();
  watchPtp();
  double exposure_us = exposure_us_;
  if (chunks_) {
    Failure failure;
    const double value =
        arv_chunk_parser_get_float_value(chunks_.get(), buffer, "ChunkExposureTime", failure.out());
    if (!failure && value > 0.0) exposure_us = value;
  }
  const nanoseconds exposure(std::llround(exposure_us * 1e3));
  const nanoseconds extra(std::llround(stamp_offset_us_ * 1e3));
  const Stamp arrival{
      nanoseconds(static_cast<std::int64_t>(arv_buffer_get_system_timestamp(buffer)))};
  const auto device = static_cast<std::int64_t>(arv_buffer_get_timestamp(buffer));
  if (device == 0) return arrival - exposure / 2 + extra;
  const std::int64_t start = stamp_is_exposure_end_ ? device - exposure.count() : device;
  // The first packet leaves after the end of the exposure.
  clock_.observe(start + exposure.count(), arrival);
  std::int64_t offset = *clock_.offset();
  // The host's clock was set: what was measured before holds no more.
  if (latch_works_.value_or(false) && latch_offset_ &&
      std::llabs(*latch_offset_ - offset) > kClockWasSet) {
    latch_offset_.reset();
    latch_due_ = Steady::now();
  }
  if (ptp_locked_) {
    // Both clocks are synchronous, but may count leap seconds differently.
    constexpr std::int64_t kSecond = 1000000000, kSlack = 50000000;
    std::int64_t whole = (offset + kSlack) / kSecond;
    if ((offset + kSlack) % kSecond < 0) --whole;
    offset = whole * kSecond;
  } else if (latch_works_.value_or(false) && latch_offset_) {
    offset = *latch_offset_;
  }
  return Stamp(nanoseconds(start + offset)) + exposure / 2 + extra;
}

}  // namespace omnister::device
