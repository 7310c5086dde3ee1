// SPDX-License-Identifier: Apache-2.0
/// @file What the residuals of a fit leave unknown of the lens and whatever else views share.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "calibration/fit/bundle.h"

namespace omnister::calibration {

/// Covariance of all that reducedInformation() has columns for, the poses marginalised; its
/// noise is that of the residuals under the loss of the fit (Huber 1981, sec. 7.6), but at least
/// `least_sigma_px`.
Eigen::MatrixXd sharedCovariance(const std::vector<BundleView>& views, const BundleOptions& options,
                                 const BundleState& state, double loss_px,
                                 double least_sigma_px = 0.0);

/// Its part that belongs to the lens parameters of camera `camera`.
Eigen::MatrixXd lensCovariance(const std::vector<BundleView>& views, const BundleOptions& options,
                               const BundleState& state, double loss_px, int camera,
                               double least_sigma_px = 0.0);

}  // namespace omnister::calibration
