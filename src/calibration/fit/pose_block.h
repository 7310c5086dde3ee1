// SPDX-License-Identifier: Apache-2.0
/// @file A pose as six numbers for an adjustment: rotation vector [rad] and translation.
#pragma once

#include <Eigen/Geometry>
#include <cmath>

#include "omnister/common/pose.h"

namespace omnister::calibration {

using Vector6d = Eigen::Matrix<double, 6, 1>;

inline Eigen::Matrix3d crossMatrix(const Eigen::Vector3d& v) {
  Eigen::Matrix3d m;
  m << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
  return m;
}

/// A block's rotation and translation with what their derivative needs:
/// d(R p)/d(rotation vector) = -R [p]x right_jacobian.
struct PoseValue {
  Eigen::Matrix3d R;
  Eigen::Vector3d t;
  Eigen::Matrix3d right_jacobian;  ///< of the exponential map at the rotation vector

  explicit PoseValue(const double* block) {
    const Eigen::Map<const Eigen::Vector3d> w(block);
    t = Eigen::Map<const Eigen::Vector3d>(block + 3);
    const double angle = w.norm();
    const Eigen::Matrix3d k = crossMatrix(w);
    // Below, the series is exact to rounding and free of 0 / 0.
    const bool small = angle < 1e-4;
    const double a2 = angle * angle;
    const double a = small ? 1.0 - a2 / 6.0 : std::sin(angle) / angle;
    const double b = small ? 0.5 - a2 / 24.0 : (1.0 - std::cos(angle)) / a2;
    const double c = small ? 1.0 / 6.0 - a2 / 120.0 : (angle - std::sin(angle)) / (a2 * angle);
    R = Eigen::Matrix3d::Identity() + a * k + b * k * k;
    right_jacobian = Eigen::Matrix3d::Identity() - b * k + c * k * k;
  }
};

inline Vector6d blockOf(const Pose& pose) {
  const Eigen::AngleAxisd rotation(pose.linear());
  Vector6d block;
  block << rotation.angle() * rotation.axis(), pose.translation();
  return block;
}

inline Pose poseOf(const Vector6d& block) {
  Pose pose = Pose::Identity();
  const PoseValue value(block.data());
  // Re-orthonormalised, since it goes on into files.
  pose.linear() = Eigen::Quaterniond(value.R).normalized().toRotationMatrix();
  pose.translation() = value.t;
  return pose;
}

}  // namespace omnister::calibration
