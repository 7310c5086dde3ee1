// SPDX-License-Identifier: Apache-2.0
/// @file Where a pixel of the reference image can lie in the displaced image: a curved path, in
/// closed form for any central lens and any pose.
///
/// A point at inverse range w along the unit reference ray r is r / w; the displaced camera at
/// T_ref_disp = [R | t] sees it in the direction
///     q(w) = R^T (r - w t)                                                 (w = 0: at infinity)
/// which is a straight line of directions, and a curve of pixels after projection. For a sideways
/// move without rotation it is the straight line of shifts of the dewarped image,
/// (u + n, v, R0) with n = -R0 t_x / Z (Johnson 1997, sec. 5.1, fig. 5.2), Z = r_z / w.
///
/// With b = |t|, theta the angle of r from t, and delta the angle between r and R q (the parallax),
///     1 / w = b sin(theta + delta) / sin(delta)                            (law of sines).
#pragma once

#include <Eigen/Core>
#include <optional>
#include <vector>

#include "omnister/common/pose.h"
#include "omnister/lens/lens_model.h"

namespace omnister {

/// One place on the path.
struct EpipolarPoint {
  double inverse_range = 0.0;  ///< along the reference ray [1/m]
  Eigen::Vector2d pixel;       ///< in the displaced image, not clipped to it [px]
};

/// The path of one reference ray. Keeps a reference to the lens: it must outlive the curve.
class EpipolarCurve {
 public:
  /// @param ray in the reference frame, of length 1
  /// @param T_ref_disp maps coordinates of the displaced camera into the reference camera
  EpipolarCurve(const Eigen::Vector3d& ray, const Pose& T_ref_disp,
                const LensModel& displaced_lens);

  /// Direction in the displaced frame, not of length 1. @param inverse_range [1/m], >= 0
  Eigen::Vector3d bearing(double inverse_range) const {
    return ray_in_disp_ - inverse_range * center_in_disp_;
  }

  /// nullopt where the displaced lens has no image of it.
  std::optional<Eigen::Vector2d> pixel(double inverse_range) const {
    return lens_->project(bearing(inverse_range));
  }

  /// Angle between the two rays [rad], 0 at infinity, below pi. Grows with inverse_range.
  double parallax(double inverse_range) const;

  /// The inverse of parallax(). @param parallax [rad], in [0, maxParallax())
  double inverseRange(double parallax) const;

  /// The parallax that is reached at range 0: pi minus the angle between ray and baseline [rad].
  double maxParallax() const { return max_parallax_; }

  /// The path between two inverse ranges, in steps of at most `step_px` where it is inside the
  /// field; pieces outside the field are left out (a gap shows as a larger step). At most 65536
  /// points.
  std::vector<EpipolarPoint> sample(double inverse_range_begin, double inverse_range_end,
                                    double step_px) const;

 private:
  Eigen::Vector3d ray_in_disp_;     // R^T r
  Eigen::Vector3d center_in_disp_;  // R^T t
  double along_ = 0.0;              // r . t
  double across_ = 0.0;             // |r x t|
  double max_parallax_ = 0.0;
  const LensModel* lens_;
};

}  // namespace omnister
