// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>

namespace omnister {

/// The angle between the rays of two pixels, measured by other means.
struct KnownAngle {
  Eigen::Vector2d first = Eigen::Vector2d::Zero();   ///< [px]
  Eigen::Vector2d second = Eigen::Vector2d::Zero();  ///< [px]
  double angle = 0.0;                                ///< [rad], in (0, pi)
};

}  // namespace omnister
