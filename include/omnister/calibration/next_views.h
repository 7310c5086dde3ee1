// SPDX-License-Identifier: Apache-2.0
/// @file Which pictures would help a calibration most.
#pragma once

#include <Eigen/Core>
#include <string>
#include <vector>

#include "omnister/calibration/calibrate.h"

namespace omnister {

/// A picture to take next.
struct NextView {
  Pose T_camera_board = Pose::Identity();  ///< board units
  std::vector<Eigen::Vector2d> outline;    ///< of the board's points in the image, clockwise [px]
  std::string where;  ///< in plain words, e.g. "at the upper right, tilted ..."
  /// CalibrationResult::uncertainty_rms_px with this view and those before it.
  double uncertainty_px = 0.0;
};

/// Tries boards all over the field, tilted to either side, and takes the one that lowers the
/// uncertainty of projection most; then the next with that one taken as seen.
/// @param board the points of the board, board units   @param count how many at most
/// @return fewer, or none, where the lens has no covariance or none helps by a twentieth
std::vector<NextView> nextViews(const CalibrationResult& result,
                                const std::vector<Eigen::Vector3d>& board, int count);

}  // namespace omnister
