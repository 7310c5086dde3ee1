// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <vector>

namespace omnister::test {

inline Eigen::Vector3d direction(double theta, double phi) {
  return {std::sin(theta) * std::cos(phi), std::sin(theta) * std::sin(phi), std::cos(theta)};
}

struct Residual {
  double rms = 0.0;
  double max = 0.0;
};

/// How far two projections lie apart [px] over rays on rings; 1e9 where one does not see all of
/// them.
/// @param thetas from the axis [rad]
/// @param azimuths rays on each ring, the first at `phi` [rad]
template <typename Expected, typename Project>
Residual projectionResidual(const std::vector<double>& thetas, int azimuths, double phi,
                            const Expected& expected, const Project& project) {
  Residual out;
  for (const double theta : thetas) {
    for (int j = 0; j < azimuths; ++j) {
      const Eigen::Vector3d n = direction(theta, phi + j * 2.0 * M_PI / azimuths);
      const auto wanted = expected(n);
      const auto pixel = project(n);
      if (!wanted || !pixel) return {1e9, 1e9};
      const double error = (*pixel - *wanted).norm();
      out.rms += error * error;
      out.max = std::max(out.max, error);
    }
  }
  out.rms = std::sqrt(out.rms / static_cast<double>(thetas.size() * azimuths));
  return out;
}

}  // namespace omnister::test
