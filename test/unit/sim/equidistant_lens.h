// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>

#include "omnister/lens/lens_model.h"

namespace omnister::test {

/// r = f theta about the centre: written down directly, so that tests of the renderer rest on no
/// fitted surface.
class EquidistantLens : public LensModel {
 public:
  EquidistantLens(const Eigen::Vector2d& center, double focal_px, double max_theta)
      : center_(center), focal_(focal_px), max_theta_(max_theta) {}

  std::string_view model() const override { return "equidistant"; }
  std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& bearing, Jacobian23* = nullptr,
                                         JacobianParams* = nullptr) const override {
    const double across = bearing.head<2>().norm();
    const double theta = std::atan2(across, bearing.z());
    if (!(theta <= max_theta_)) return std::nullopt;
    if (across == 0.0) return center_;
    return Eigen::Vector2d(center_ + bearing.head<2>() * (focal_ * theta / across));
  }
  std::optional<Eigen::Vector3d> unproject(const Eigen::Vector2d& pixel,
                                           Jacobian32* = nullptr) const override {
    const Eigen::Vector2d d = pixel - center_;
    const double theta = d.norm() / focal_;
    if (!(theta <= max_theta_)) return std::nullopt;
    const double scale = theta == 0.0 ? 0.0 : std::sin(theta) / d.norm();
    return Eigen::Vector3d(scale * d.x(), scale * d.y(), std::cos(theta));
  }
  double maxTheta() const override { return max_theta_; }
  std::optional<double> surfaceHeight(double x, double y) const override {
    const double r = std::hypot(x, y);
    if (r > focal_ * max_theta_) return std::nullopt;
    return r == 0.0 ? focal_ : r / std::tan(r / focal_);
  }
  Eigen::VectorXd parameters() const override {
    return Eigen::Vector3d(center_.x(), center_.y(), focal_);
  }
  std::vector<std::string> parameterNames() const override { return {"cx", "cy", "focal"}; }
  LensPtr withParameters(const Eigen::VectorXd& p, std::optional<double> max_theta) const override {
    return std::make_shared<EquidistantLens>(p.head<2>(), p[2], max_theta.value_or(max_theta_));
  }

 private:
  Eigen::Vector2d center_;
  double focal_;
  double max_theta_;
};

}  // namespace omnister::test
