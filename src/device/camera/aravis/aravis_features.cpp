// SPDX-License-Identifier: Apache-2.0
#include "device/camera/aravis/aravis_features.h"

#include <cmath>

#include "device/camera/aravis/aravis_discovery.h"
#include "device/camera/pixel_format.h"
#include "omnister/common/numbers.h"

namespace omnister::device {
namespace {

/// A feature that is a number, under all the names that Aravis knows for it.
struct NumberFeature {
  const char* name;
  const char* unit;
  gboolean (*available)(ArvCamera*, GError**);
  void (*bounds)(ArvCamera*, double*, double*, GError**);
  void (*set)(ArvCamera*, double, GError**);
  double (*get)(ArvCamera*, GError**);
};
constexpr NumberFeature kExposure = {"exposure time",
                                     " us",
                                     arv_camera_is_exposure_time_available,
                                     arv_camera_get_exposure_time_bounds,
                                     arv_camera_set_exposure_time,
                                     arv_camera_get_exposure_time};
constexpr NumberFeature kGain = {"gain",
                                 "",
                                 arv_camera_is_gain_available,
                                 arv_camera_get_gain_bounds,
                                 arv_camera_set_gain,
                                 arv_camera_get_gain};
constexpr NumberFeature kBlackLevel = {"black level",
                                       "",
                                       arv_camera_is_black_level_available,
                                       arv_camera_get_black_level_bounds,
                                       arv_camera_set_black_level,
                                       arv_camera_get_black_level};
constexpr NumberFeature kFrameRate = {"frame rate",
                                      " Hz",
                                      arv_camera_is_frame_rate_available,
                                      arv_camera_get_frame_rate_bounds,
                                      arv_camera_set_frame_rate,
                                      arv_camera_get_frame_rate};

struct AutoFeature {
  const char* name;
  gboolean (*available)(ArvCamera*, GError**);
  void (*set)(ArvCamera*, ArvAuto, GError**);
  ArvAuto (*get)(ArvCamera*, GError**);
};
constexpr AutoFeature kExposureAuto = {"automatic exposure", arv_camera_is_exposure_auto_available,
                                       arv_camera_set_exposure_time_auto,
                                       arv_camera_get_exposure_time_auto};
constexpr AutoFeature kGainAuto = {"automatic gain", arv_camera_is_gain_auto_available,
                                   arv_camera_set_gain_auto, arv_camera_get_gain_auto};

std::optional<double> read(AravisConnection& on, const NumberFeature& feature) {
  Failure failure;
  if (!feature.available(on.camera(), failure.out())) return std::nullopt;
  const double value = feature.get(on.camera(), failure.out());
  if (failure || !std::isfinite(value)) return std::nullopt;
  return value;
}

void set(AravisConnection& on, const NumberFeature& feature, double wanted) {
  Failure failure;
  if (!feature.available(on.camera(), failure.out())) {
    on.remark(std::string("this camera has no ") + feature.name);
    return;
  }
  double min = 0.0, max = 0.0;
  feature.bounds(on.camera(), &min, &max, failure.out());
  double value = wanted;
  if (!failure && max > min) value = std::clamp(wanted, min, max);
  feature.set(on.camera(), value, failure.out());
  if (on.tellIf(failure, feature.name)) return;
  const std::optional<double> taken = read(on, feature);
  if (taken && std::abs(*taken - wanted) > 0.01 * std::max(std::abs(wanted), 1e-3)) {
    on.remark(std::string(feature.name) + ": asked for " + formatNumber(wanted) +
              ", the camera took " + formatNumber(*taken) + feature.unit);
  }
}

std::string read(AravisConnection& on, const AutoFeature& feature) {
  Failure failure;
  if (!feature.available(on.camera(), failure.out())) return "";
  const ArvAuto mode = feature.get(on.camera(), failure.out());
  if (failure) return "";
  return mode == ARV_AUTO_OFF ? "off" : mode == ARV_AUTO_ONCE ? "once" : "continuous";
}

void set(AravisConnection& on, const AutoFeature& feature, const std::string& wanted) {
  Failure failure;
  if (!feature.available(on.camera(), failure.out())) {
    if (wanted != "off") on.remark(std::string("this camera has no ") + feature.name);
    return;
  }
  const ArvAuto mode = wanted == "off"    ? ARV_AUTO_OFF
                       : wanted == "once" ? ARV_AUTO_ONCE
                                          : ARV_AUTO_CONTINUOUS;
  feature.set(on.camera(), mode, failure.out());
  on.tellIf(failure, feature.name);
}

void choosePixelFormat(AravisConnection& on, const CameraSettings& settings) {
  Failure failure;
  guint count = 0;
  const Names names(
      arv_camera_dup_available_pixel_formats_as_strings(on.camera(), &count, failure.out()),
      &g_free);
  std::string offered;
  bool there = false;
  for (guint i = 0; names && i < count; ++i) {
    const std::string name = string(names.get()[i]);
    offered += (offered.empty() ? "" : ", ") + name;
    there = there || name == settings.pixel_format;
  }
  if (!settings.pixel_format.empty()) {
    if (!there) {
      throw CameraError(describe(on.device()) + " has no pixel format \"" +
                        printable(settings.pixel_format) + "\"; it offers " + offered);
    }
    arv_camera_set_pixel_format_from_string(on.camera(), settings.pixel_format.c_str(),
                                            failure.out());
    on.refuseIf(failure, "pixel format");
  }
  const ArvPixelFormat code = arv_camera_get_pixel_format(on.camera(), failure.out());
  on.refuseIf(failure, "pixel format");
  if (!findPixelFormat(code)) {
    throw CameraError(describe(on.device()) + " streams in " +
                      string(arv_camera_get_pixel_format_as_string(on.camera(), failure.out())) +
                      ", for which there is no encoding; it offers " + offered);
  }
}

void chooseRegion(AravisConnection& on, const CameraSettings& settings) {
  Failure failure;
  if (settings.binning.width > 0 && settings.binning.height > 0) {
    if (arv_camera_is_binning_available(on.camera(), failure.out())) {
      arv_camera_set_binning(on.camera(), settings.binning.width, settings.binning.height,
                             failure.out());
      on.tellIf(failure, "binning");
    } else if (settings.binning != cv::Size(1, 1)) {
      on.remark("this camera has no binning");
    }
  }
  const bool sized = settings.size.width > 0 && settings.size.height > 0;
  const bool placed = settings.offset.x >= 0 && settings.offset.y >= 0;
  if (!sized && !placed) return;
  int x = 0, y = 0, width = 0, height = 0;
  arv_camera_get_region(on.camera(), &x, &y, &width, &height, failure.out());
  on.refuseIf(failure, "region");
  const cv::Size size = sized ? settings.size : cv::Size(width, height);
  const cv::Point offset = placed ? settings.offset : cv::Point(0, 0);
  arv_camera_set_region(on.camera(), offset.x, offset.y, size.width, size.height, failure.out());
  on.tellIf(failure, "region");
  arv_camera_get_region(on.camera(), &x, &y, &width, &height, failure.out());
  on.refuseIf(failure, "region");
  if (cv::Size(width, height) != size || (placed && cv::Point(x, y) != offset)) {
    on.remark("region: asked for " + std::to_string(size.width) + "x" +
              std::to_string(size.height) + " at (" + std::to_string(offset.x) + ", " +
              std::to_string(offset.y) + "), the camera took " + std::to_string(width) + "x" +
              std::to_string(height) + " at (" + std::to_string(x) + ", " + std::to_string(y) +
              ")");
  }
}

void chooseTrigger(AravisConnection& on, const CameraSettings& settings) {
  Failure failure;
  if (settings.trigger == "off") {
    arv_camera_clear_triggers(on.camera(), failure.out());
    if (failure) on.detail("TriggerMode: " + failure.text());
    return;
  }
  guint count = 0;
  const Names names(arv_camera_dup_available_trigger_sources(on.camera(), &count, failure.out()),
                    &g_free);
  std::string offered, source;
  for (guint i = 0; names && i < count; ++i) {
    const std::string name = string(names.get()[i]);
    offered += (offered.empty() ? "" : ", ") + name;
    if (lower(name) == lower(settings.trigger)) source = name;
  }
  if (source.empty()) {
    throw CameraError(describe(on.device()) + " has no trigger \"" + printable(settings.trigger) +
                      "\"; it offers " + (offered.empty() ? "none" : offered));
  }
  arv_camera_set_trigger(on.camera(), source.c_str(), failure.out());
  on.refuseIf(failure, "trigger");
}

}  // namespace

void applySettings(AravisConnection& on, const CameraSettings& settings) {
  Failure failure;
  // It may still be running for one who did not say goodbye.
  arv_camera_stop_acquisition(on.camera(), failure.out());
  arv_camera_set_acquisition_mode(on.camera(), ARV_ACQUISITION_MODE_CONTINUOUS, failure.out());
  if (failure) on.detail("AcquisitionMode: " + failure.text());
  for (const std::string& feature : settings.features) {
    arv_device_set_features_from_string(arv_camera_get_device(on.camera()), feature.c_str(),
                                        failure.out());
    on.tellIf(failure, "feature " + printable(feature));
  }
  choosePixelFormat(on, settings);
  chooseRegion(on, settings);
  if (settings.frame_rate_hz > 0.0 && settings.trigger == "off") {
    set(on, kFrameRate, settings.frame_rate_hz);
  }
  chooseTrigger(on, settings);
  if (!settings.exposure_auto.empty()) set(on, kExposureAuto, settings.exposure_auto);
  if (settings.exposure_us) set(on, kExposure, *settings.exposure_us);
  if (!settings.gain_auto.empty()) set(on, kGainAuto, settings.gain_auto);
  if (settings.gain) set(on, kGain, *settings.gain);
  if (settings.black_level) set(on, kBlackLevel, *settings.black_level);
}

CameraControls readControls(AravisConnection& on) {
  CameraControls now;
  now.exposure_us = read(on, kExposure);
  now.gain = read(on, kGain);
  now.black_level = read(on, kBlackLevel);
  now.frame_rate_hz = read(on, kFrameRate);
  now.exposure_auto = read(on, kExposureAuto);
  now.gain_auto = read(on, kGainAuto);
  return now;
}

void setControls(AravisConnection& on, const CameraControls& wanted, bool triggered) {
  on.requireAlive();
  if (wanted.frame_rate_hz) {
    // Aravis switches triggers off when it sets the frame rate.
    if (!triggered) {
      set(on, kFrameRate, *wanted.frame_rate_hz);
    } else {
      on.remark("a triggered camera has no frame rate");
    }
  }
  if (!wanted.exposure_auto.empty()) set(on, kExposureAuto, wanted.exposure_auto);
  if (wanted.exposure_us) set(on, kExposure, *wanted.exposure_us);
  if (!wanted.gain_auto.empty()) set(on, kGainAuto, wanted.gain_auto);
  if (wanted.gain) set(on, kGain, *wanted.gain);
  if (wanted.black_level) set(on, kBlackLevel, *wanted.black_level);
}

std::optional<double> readExposure(AravisConnection& on) { return read(on, kExposure); }

std::string readExposureAuto(AravisConnection& on) { return read(on, kExposureAuto); }

std::optional<double> readNumber(AravisConnection& on, const char* feature) {
  if (!on.has(feature)) return std::nullopt;
  Failure failure;
  const double value = arv_camera_get_float(on.camera(), feature, failure.out());
  if (failure || !std::isfinite(value)) return std::nullopt;
  return value;
}

std::optional<SensorRegion> readGeometry(AravisConnection& on) {
  Failure failure;
  int x = 0, y = 0, width = 0, height = 0, dx = 1, dy = 1, sensor_width = 0, sensor_height = 0;
  arv_camera_get_region(on.camera(), &x, &y, &width, &height, failure.out());
  if (failure) return std::nullopt;
  if (arv_camera_is_binning_available(on.camera(), failure.out())) {
    arv_camera_get_binning(on.camera(), &dx, &dy, failure.out());
    if (failure || dx < 1 || dy < 1) dx = dy = 1;
  }
  arv_camera_get_sensor_size(on.camera(), &sensor_width, &sensor_height, failure.out());
  SensorRegion region;
  region.binning = {dx, dy};
  region.region = {x * dx, y * dy, width * dx, height * dy};
  region.sensor = {std::max(sensor_width, region.region.br().x),
                   std::max(sensor_height, region.region.br().y)};
  return region;
}

}  // namespace omnister::device
