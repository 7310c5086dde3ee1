// SPDX-License-Identifier: Apache-2.0
/// @file Tells on /diagnostics whether lens and pose still fit what a stereo node sees.
#pragma once

#include <diagnostic_updater/diagnostic_updater.h>
#include <ros/time.h>

#include <mutex>

#include "omnister/stereo/drift_monitor.h"
#include "ros/node/parameters.h"
#include "stereo/session/stereo_worker.h"

namespace omnister {

struct DriftParameters {
  double period = 1.0;  ///< between the pairs that are looked at [s]; 0: none is
  DriftOptions options;
};

/// @throws InputError naming key, value and range
DriftParameters loadDriftParameters(Parameters& parameters);

/// For any thread.
class DriftDiagnostic {
 public:
  explicit DriftDiagnostic(const DriftParameters& parameters);

  /// A set that was matched; looked at when it is time to.
  void look(const StereoSet& set, const PreparedSet& prepared, const cv::Mat& range);
  void diagnose(diagnostic_updater::DiagnosticStatusWrapper& status);

 private:
  const DriftParameters parameters_;
  std::mutex mutex_;  ///< all below
  DriftMonitor monitor_;
  ros::SteadyTime last_;  ///< of a pair that was looked at
};

}  // namespace omnister
