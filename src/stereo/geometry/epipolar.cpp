// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/epipolar.h"

#include <algorithm>
#include <cmath>

namespace omnister {

EpipolarCurve::EpipolarCurve(const Eigen::Vector3d& ray, const Pose& T_ref_disp,
                             const LensModel& displaced_lens)
    : ray_in_disp_(T_ref_disp.linear().transpose() * ray),
      center_in_disp_(T_ref_disp.linear().transpose() * T_ref_disp.translation()),
      along_(ray.dot(T_ref_disp.translation())),
      across_(ray.cross(T_ref_disp.translation()).norm()),
      max_parallax_(M_PI - std::atan2(across_, along_)),
      lens_(&displaced_lens) {}

double EpipolarCurve::parallax(double inverse_range) const {
  return std::atan2(inverse_range * across_, 1.0 - inverse_range * along_);
}

double EpipolarCurve::inverseRange(double parallax) const {
  // The law of sines with b sin(theta) = across and b cos(theta) = along.
  return std::sin(parallax) / (across_ * std::cos(parallax) + along_ * std::sin(parallax));
}

std::vector<EpipolarPoint> EpipolarCurve::sample(double inverse_range_begin,
                                                 double inverse_range_end, double step_px) const {
  constexpr std::size_t kMaxPoints = 65536;
  const double first = parallax(inverse_range_begin);
  const double last = parallax(inverse_range_end);
  std::vector<EpipolarPoint> points;
  // Along the baseline there is no parallax: the path is one point.
  if (!(std::abs(last - first) > 0.0)) {
    if (const auto point = pixel(inverse_range_begin)) {
      points.push_back({inverse_range_begin, *point});
    }
    return points;
  }
  // Pixels per radian change slowly along the path, so even steps of parallax are nearly even steps
  // of pixels; they are made finer until the largest one is small enough.
  for (std::size_t steps = 16;; steps *= 2) {
    points.clear();
    double largest = 0.0;
    bool gap = true;
    for (std::size_t i = 0; i <= steps; ++i) {
      double w = inverseRange(first + (last - first) * static_cast<double>(i) / steps);
      if (i == 0) w = inverse_range_begin;
      if (i == steps) w = inverse_range_end;
      const auto point = pixel(w);
      if (point) {
        if (!gap) largest = std::max(largest, (*point - points.back().pixel).norm());
        points.push_back({w, *point});
      }
      gap = !point;
    }
    if (largest <= step_px || steps * 2 + 1 > kMaxPoints) return points;
  }
}

}  // namespace omnister
