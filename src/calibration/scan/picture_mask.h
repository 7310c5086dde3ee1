// SPDX-License-Identifier: Apache-2.0
/// @file Where a camera shows no scene: the black around a fisheye's round picture.
#pragma once

#include <opencv2/core/mat.hpp>
#include <vector>

#include "omnister/calibration/feature_tracks.h"

namespace omnister::calibration {

/// Pixels that no movement changes and that hang together with a corner of the image, grown by
/// `margin_px`. The rim of the picture is the strongest edge there is, and it never moves: a window
/// that touches it follows the rim instead of the scene.
/// @return CV_8U, 255 where nothing is to be looked for; all 0 where the picture fills the image
cv::Mat1b outsidePicture(const std::vector<StageScan>& scans, int margin_px);

}  // namespace omnister::calibration
