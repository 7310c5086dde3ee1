// SPDX-License-Identifier: Apache-2.0
/// @file The formulas of foreign cameras: unit bearing to pixel, each as its authors state it.
#pragma once

#include <Eigen/Core>
#include <functional>
#include <optional>
#include <vector>

namespace omnister::detail {

using ForeignProject = std::function<std::optional<Eigen::Vector2d>(const Eigen::Vector3d&)>;
using Numbers = std::vector<double>;

/// Bends a point of the normalised plane; nullopt where the formula has a pole.
using PlaneBend = std::function<std::optional<Eigen::Vector2d>(const Eigen::Vector2d&)>;

/// OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]: plumb_bob (4 or 5), rational (8), thin prism
/// (12).
PlaneBend openCvBend(Numbers coefficients);
/// Kalibr's "fov" (Devernay and Faugeras 2001).
PlaneBend fovBend(double w);
/// Kannala and Brandt 2006, OpenCV's fisheye: over the angle, so it holds past 90 degrees.
ForeignProject equidistantProject(const Eigen::Matrix3d& K, Numbers k);
/// Perspective division, bend, K.
ForeignProject pinholeProject(const Eigen::Matrix3d& K, PlaneBend bend);
/// Mei and Rives 2007: n_xy / (n_z + xi), bend, K.
ForeignProject omniProject(const Eigen::Matrix3d& K, double xi, PlaneBend bend);
/// Double sphere (Usenko et al. 2018).
ForeignProject doubleSphereProject(const Eigen::Matrix3d& K, double xi, double alpha);
/// Enhanced unified camera model (Khomutenko et al. 2016).
ForeignProject eucmProject(const Eigen::Matrix3d& K, double alpha, double beta);

/// OCamCalib (Scaramuzza et al. 2006). In its axes x points down along rows and y right along
/// columns:
///     [row; col] = [c, d; e, 1] [x; y] + [center_row; center_col],  ray = (x, y, f(rho)), f(0) <
///     0,
/// and forward is -z.
struct OcamNumbers {
  Numbers polynomial;
  double c = 1.0;
  double d = 0.0;
  double e = 0.0;
  double center_row = 0.0;
  double center_col = 0.0;
};
/// @param max_rho how far from the centre pixels are looked for [px]
ForeignProject ocamProject(OcamNumbers ocam, double max_rho);

/// mrcal's CAHVOR: alpha, beta (direction of the axis O), r0, r1, r2 after fx fy cx cy.
ForeignProject cahvorProject(const Eigen::Matrix3d& K, const Numbers& distortion);

/// mrcal's LENSMODEL_SPLINED_STEREOGRAPHIC: u = 2 tan(theta/2) (cos phi, sin phi), corrected by a
/// B-spline surface of order 2 or 3 over an Nx x Ny grid of control points (two numbers each, row
/// by row).
struct SplinedStereographic {
  int order = 3;
  int nx = 0;
  int ny = 0;
  double fov_x = 0.0;  // [rad]
  Numbers control_points;
};
ForeignProject splinedStereographicProject(const Eigen::Matrix3d& K, SplinedStereographic spline);

}  // namespace omnister::detail
