// SPDX-License-Identifier: Apache-2.0
/// @file From images to corners.
#pragma once

#include <opencv2/core/mat.hpp>
#include <optional>
#include <string>
#include <vector>

#include "omnister/calibration/detections.h"
#include "omnister/calibration/target.h"
#include "omnister/common/progress.h"
#include "omnister/lens/lens_model.h"

namespace omnister {

struct DetectorOptions {
  double seconds_per_image = 3.0;  ///< bound on the time spent on one image [s]
  int threads = 0;                 ///< 0: every core
};

/// Finds the target in one image of any depth and channel count. Corner positions carry no
/// half-pixel bias.
/// @return nullopt when it is not there, or when it is part of a larger checkerboard; partial
/// boards only with coded targets
std::optional<ViewDetections> detectTarget(const cv::Mat& image, const Target& target,
                                           const DetectorOptions& options = {});

/// Second pass: predicts every corner with a fitted lens, refines each in a window of a quarter of
/// the local spacing, and adds those that the detector missed.
/// @param first corners of the first pass (at least 4)
ViewDetections refineGuided(const cv::Mat& image, const Target& target, const LensModel& lens,
                            const ViewDetections& first);

/// Reads and detects all images; those without the target are named in `missed`.
/// @throws InputError for an unreadable image or images of different size
Detections detectInFiles(const std::vector<std::string>& image_files, const Target& target,
                         const DetectorOptions& options, std::vector<std::string>* missed,
                         const Progress& progress = {});

/// For telling a person which board the images show when it is not the one that was asked for:
/// columns and rows, counted as in Target, of a board of the same type (and dictionary) but another
/// size. Of a checkerboard the larger comes first; of a coded board partly out of the picture the
/// rows are those that are seen.
/// @return nullopt when no board is seen, or the one that was asked for
std::optional<cv::Size> otherBoardSize(const cv::Mat& image, const Target& asked);

}  // namespace omnister
