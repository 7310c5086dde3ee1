// SPDX-License-Identifier: Apache-2.0
/// @file Two rays to one point.
#pragma once

#include <Eigen/Core>
#include <optional>

#include "omnister/common/pose.h"

namespace omnister {

/// The nearest point of two rays (Johnson 1997, eqs 2.2-2.9).
struct Triangulation {
  Eigen::Vector3d point;      ///< middle of the shortest segment between the rays [m]
  double range_first = 0.0;   ///< from the first origin to the foot of the segment on its ray [m]
  double range_second = 0.0;  ///< likewise on the second ray [m]
  double residual = 0.0;      ///< length of the shortest segment: 0 when the rays meet [m]
};

/// P(a) = p0 + a dp and Q(c) = q0 + c dq in one frame. The segment Q(c) - P(a) orthogonal to both
/// gives two linear equations, solved by Cramer's rule.
/// @param dp, dq directions of any length > 0
/// @return nullopt for parallel rays (closer than 1e-9 rad), for non-finite input, and where a foot
/// of
///         the segment lies behind its camera
std::optional<Triangulation> triangulate(const Eigen::Vector3d& p0, const Eigen::Vector3d& dp,
                                         const Eigen::Vector3d& q0, const Eigen::Vector3d& dq);

/// The same for two cameras, in the reference frame.
/// @param ray_ref in the reference frame  @param ray_disp in the displaced frame
std::optional<Triangulation> triangulate(const Eigen::Vector3d& ray_ref,
                                         const Eigen::Vector3d& ray_disp, const Pose& T_ref_disp);

/// Pinhole depth from disparity, Z = f b / (x2 - x1) (Johnson 1997, eq. 2.1).
/// @param focal_px distance of the undistorted image plane, in the unit of the disparity
/// @param baseline [m]
/// @return depth along the optical axis [m], of the sign of focal_px * baseline / disparity;
/// nullopt
///         for a disparity of 0 and for non-finite input
std::optional<double> depthFromDisparity(double focal_px, double baseline, double disparity_px);

}  // namespace omnister
