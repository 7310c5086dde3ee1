// SPDX-License-Identifier: Apache-2.0
/// @file Fitting a lens to known pairs of bearing and pixel: the inner work of starting values and
/// importers. Calibration from boards, where poses are unknown too, is in calibration/.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "omnister/lens/lens_model.h"

namespace omnister {

struct LensFitOptions {
  int first_parameter = 0;  ///< of LensModel::parameters(): those before it stay
  int parameters = -1;      ///< how many are fitted from there; all that follow when negative
  int max_iterations = 100;
  double tolerance = 1e-13;  ///< ends when a step lowers the cost by less than this part of it
};

struct LensFit {
  LensPtr lens;
  double rms_px = 0.0;  ///< root mean square of the 2-D error [px]
  double max_px = 0.0;  ///< largest 2-D error [px]
  int iterations = 0;
};

/// Least squares by Levenberg and Marquardt with the lens' own Jacobians. Steps to numbers that
/// make no lens over start.maxTheta() are refused, so the result is always a valid lens, at worst
/// the start.
/// @param bearings in the field of `start`, of any length  @param pixels [px], as many
/// @throws Error when a bearing has no image in `start`
LensFit fitLens(const LensModel& start, const std::vector<Eigen::Vector3d>& bearings,
                const std::vector<Eigen::Vector2d>& pixels, const LensFitOptions& options = {});

}  // namespace omnister
