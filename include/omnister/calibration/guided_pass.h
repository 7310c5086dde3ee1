// SPDX-License-Identifier: Apache-2.0
/// @file Detection once more, with a first lens to guide it.
#pragma once

#include <string>
#include <vector>

#include "omnister/calibration/calibrate.h"
#include "omnister/calibration/detector.h"

namespace omnister {

struct GuidedPass {
  Detections detections;            ///< every image in which either pass found the target, in order
  std::vector<std::string> missed;  ///< images in which neither did
  int views_added = 0;              ///< images in which only this pass found it
  int corners_before = 0;
  int corners_after = 0;
};

/// Refines the corners of the first pass by refineGuided(); where it saw no target, looks for it in
/// virtual views through the lens, in which boards are straight.
/// @param first what detectInFiles() found in these files, in order
/// @throws InputError for an unreadable image
GuidedPass detectGuided(const std::vector<std::string>& image_files, const Target& target,
                        const LensModel& lens, const Detections& first,
                        const DetectorOptions& options, const Progress& progress = {});

/// Whether the corners of a second pass served the fit better than those of the first: less noise a
/// corner or more corners, and no worse outliers.
bool servesBetter(const CalibrationResult& first, const CalibrationResult& second);
/// Both cameras together.
bool servesBetter(const StereoCalibrationResult& first, const StereoCalibrationResult& second);

}  // namespace omnister
