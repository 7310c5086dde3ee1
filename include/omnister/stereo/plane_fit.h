// SPDX-License-Identifier: Apache-2.0
/// @file How flat a cloud of something flat is.
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <vector>

namespace omnister {

struct PlaneFitOptions {
  /// A point belongs to the plane when its distance from it is within this share of the point's
  /// range. In (0, 1).
  double tolerance = 0.03;
  int iterations = 500;  ///< of the random search, 1 to 100000
  std::uint64_t seed = 1;
};

/// Points within a range of off-axis angles.
struct PlaneFitBand {
  double from_theta = 0.0, to_theta = 0.0;  ///< [rad]
  std::size_t points = 0, inliers = 0;
  double rms = 0.0;              ///< of the inliers' distances from the plane [m]
  double median_residual = 0.0;  ///< median |distance from the plane| of all points [m]
  double median_range_error =
      0.0;  ///< median |range - the plane's range| / the plane's range, all points
};

struct PlaneFit {
  Eigen::Vector3d normal = Eigen::Vector3d::Zero();  ///< of length 1, towards the camera
  double distance = 0.0;            ///< of the camera's centre from the plane, >= 0 [m]
  PlaneFitBand all;                 ///< over the whole field
  std::vector<PlaneFitBand> bands;  ///< of 10 degrees each, empty ones left out
};

/// Random search for the plane that most points agree with, then least squares over those, each
/// weighted by 1 / range^2: the error of a triangulated range grows with range^2, and seen across
/// the plane (at distance / range, the sine of the ray's slope) with range.
/// @param xyz CV_32FC3, in the camera's frame [m]; NaN points are left out
/// @throws Error for fewer than 10 points, or where no plane has 10 % of them
PlaneFit fitPlane(const cv::Mat& xyz, const PlaneFitOptions& options = {});

}  // namespace omnister
