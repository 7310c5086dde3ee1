// SPDX-License-Identifier: Apache-2.0
#include "ros/stereo/drift_diagnostic.h"

#include <cstdio>
#include <string>

#include "omnister/common/error.h"
#include "ros/stereo/message_frame.h"

namespace omnister {
namespace {

std::string pixels(double px) {
  char text[32];
  std::snprintf(text, sizeof text, "%.2f px", px);
  return text;
}

}  // namespace

DriftParameters loadDriftParameters(Parameters& parameters) {
  DriftParameters result;
  DriftOptions& options = result.options;
  result.period = parameters.number("drift_period", result.period, 0.0, 3600.0, "s (0: off)");
  options.window = parameters.number("drift_window", options.window, 1.0, 36000.0, "s");
  options.warn_px = parameters.number("drift_warn", options.warn_px, 0.05, 100.0, "px");
  options.error_px = parameters.number("drift_error", options.error_px, 0.05, 100.0, "px");
  if (options.error_px < options.warn_px)
    throw InputError("~drift_error", "", "is below ~drift_warn");
  return result;
}

DriftDiagnostic::DriftDiagnostic(const DriftParameters& parameters)
    : parameters_(parameters), monitor_(parameters.options) {}

void DriftDiagnostic::look(const StereoSet& set, const PreparedSet& prepared,
                           const cv::Mat& range) {
  if (parameters_.period <= 0.0) return;
  const std::lock_guard<std::mutex> lock(mutex_);
  const ros::SteadyTime now = ros::SteadyTime::now();
  if (!last_.isZero() && (now - last_).toSec() < parameters_.period) return;
  last_ = now;
  monitor_.add(messageOf(*set.reference).header.stamp.toSec(), prepared.geometry,
               prepared.reference, prepared.displaced.front(), range);
}

void DriftDiagnostic::diagnose(diagnostic_updater::DiagnosticStatusWrapper& status) {
  using diagnostic_msgs::DiagnosticStatus;
  using State = DriftVerdict::State;
  DriftVerdict verdict;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    verdict = monitor_.verdict();
  }
  const std::string off =
      "features lie " + pixels(verdict.drift_px) +
      " off their epipolar curves: lens or pose is no longer that of the rig; calibrate again";
  switch (verdict.state) {
    case State::kUnknown:
      status.summary(DiagnosticStatus::OK, parameters_.period > 0.0
                                               ? "too few features to tell"
                                               : "off: parameter drift_period is 0");
      status.add("verdict", "unknown");
      break;
    case State::kGood:
      status.summary(DiagnosticStatus::OK, "lens and pose fit the images");
      status.add("verdict", "good");
      break;
    case State::kWarning:
      status.summary(DiagnosticStatus::WARN, off);
      status.add("verdict", "drift");
      break;
    case State::kError:
      status.summary(DiagnosticStatus::ERROR, off);
      status.add("verdict", "drift");
      break;
  }
  status.add("drift [px]", verdict.drift_px);
  status.add("drift, at least [px]", verdict.at_least_px);
  status.add("noise of a feature [px]", verdict.noise_px);
  status.add("features", verdict.features);
  status.add("parts of the image", verdict.parts);
  status.add("pairs", verdict.pairs);
}

}  // namespace omnister
