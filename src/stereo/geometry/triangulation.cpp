// SPDX-License-Identifier: Apache-2.0
#include "stereo/geometry/triangulation.h"

#include <cmath>

namespace omnister {

std::optional<Triangulation> triangulate(const Eigen::Vector3d& p0, const Eigen::Vector3d& dp,
                                         const Eigen::Vector3d& q0, const Eigen::Vector3d& dq) {
  const Eigen::Vector3d p = dp.normalized();
  const Eigen::Vector3d q = dq.normalized();
  const Eigen::Vector3d s0 = q0 - p0;
  // S(a, c) = s0 + c q - a p is orthogonal to p and q:
  //     a       - c p.q = s0.p
  //     a p.q   - c     = s0.q
  // with determinant (p.q)^2 - 1 = -|p x q|^2, which 1 - (p.q)^2 could not resolve for small
  // angles.
  const double pq = p.dot(q);
  const double determinant = p.cross(q).squaredNorm();
  if (!(determinant > 1e-18) || !s0.allFinite()) return std::nullopt;
  const double sp = s0.dot(p);
  const double sq = s0.dot(q);
  const double a = (sp - pq * sq) / determinant;
  const double c = (pq * sp - sq) / determinant;
  if (!(a > 0.0) || !(c > 0.0)) return std::nullopt;
  const Eigen::Vector3d on_p = p0 + a * p;
  const Eigen::Vector3d on_q = q0 + c * q;
  return Triangulation{0.5 * (on_p + on_q), a, c, (on_q - on_p).norm()};
}

std::optional<Triangulation> triangulate(const Eigen::Vector3d& ray_ref,
                                         const Eigen::Vector3d& ray_disp, const Pose& T_ref_disp) {
  return triangulate(Eigen::Vector3d::Zero(), ray_ref, T_ref_disp.translation(),
                     T_ref_disp.linear() * ray_disp);
}

std::optional<double> depthFromDisparity(double focal_px, double baseline, double disparity_px) {
  const double depth = focal_px * baseline / disparity_px;
  if (!std::isfinite(depth)) return std::nullopt;
  return depth;
}

}  // namespace omnister
