// SPDX-License-Identifier: Apache-2.0
/// @file How far a calibrated lens can be trusted over its image.
#pragma once

#include <Eigen/Core>
#include <opencv2/core/types.hpp>
#include <optional>
#include <vector>

#include "omnister/lens/lens_model.h"

namespace omnister {

/// Uncertainty or difference of projection over a grid of the image [px].
struct ProjectionField {
  int cols = 0;
  int rows = 0;
  cv::Size image_size;
  std::vector<double> sigma_px;  ///< row by row; NaN outside the field of the lens
  double rms_px = 0.0;           ///< over the grid points inside the field
  double max_px = 0.0;

  double at(int col, int row) const { return sigma_px[static_cast<std::size_t>(row * cols + col)]; }
};

/// Standard deviation of where a fixed direction of the scene is imaged (root of the trace of its
/// 2x2 covariance) [px], given the covariance of LensModel::parameters(). What a small rotation of
/// the camera does is taken out, since no calibration with free board poses can tell it from a
/// shift of the centre.
ProjectionField projectionUncertainty(const LensModel& lens, const Eigen::MatrixXd& covariance,
                                      cv::Size image_size, int cols = 40);

/// The same for points at a distance, where a small shift of the camera can be told from a
/// rotation: the movement that is taken out is the one that answers best at the distance of the
/// boards, since their poses have answered there. Near them the projection is known best.
/// @param board_distance of the boards from the camera, > 0
/// @param distance of the points, in the same unit, > 0; may be infinite
ProjectionField projectionUncertaintyAt(const LensModel& lens, const Eigen::MatrixXd& covariance,
                                        cv::Size image_size, double board_distance, double distance,
                                        int cols = 40);

/// Distance between the projections of two lenses over the field of `lens`, after the best rotation
/// between them [px].
ProjectionField projectionDifference(const LensModel& lens, const LensModel& other,
                                     cv::Size image_size, int cols = 40);

}  // namespace omnister
