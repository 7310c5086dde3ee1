// SPDX-License-Identifier: Apache-2.0
#include "lens/file/equidistant.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

namespace omnister::detail {
namespace {

// fx, fy, cx, cy, k1..k4.
using Numbers = Eigen::Matrix<double, 8, 1>;

struct Sample {
  double theta;
  Eigen::Vector2d azimuth;  // (cos phi, sin phi)
  Eigen::Vector2d pixel;
};

std::vector<Sample> sample(const LensModel& lens, cv::Size size) {
  std::vector<Sample> out;
  const auto add = [&](const Eigen::Vector2d& pixel) {
    const auto n = lens.unproject(pixel);
    if (!n) return;
    const double s = n->head<2>().norm();
    out.push_back({std::atan2(s, n->z()),
                   s > 0.0 ? Eigen::Vector2d(n->head<2>() / s) : Eigen::Vector2d(1.0, 0.0), pixel});
  };
  constexpr int kGrid = 40;
  for (int i = 0; i <= kGrid; ++i) {
    for (int j = 0; j <= kGrid; ++j) {
      add({(size.width - 1.0) * j / kGrid, (size.height - 1.0) * i / kGrid});
    }
  }
  // The border of the field, where it lies within the image: the grid steps over it.
  for (int j = 0; j < 72; ++j) {
    const double phi = j * (2.0 * 3.14159265358979323846 / 72);
    const double theta = lens.maxTheta() * (1.0 - 1e-9);
    const auto pixel = lens.project(
        {std::sin(theta) * std::cos(phi), std::sin(theta) * std::sin(phi), std::cos(theta)});
    if (pixel && pixel->x() >= 0.0 && pixel->y() >= 0.0 && pixel->x() <= size.width - 1.0 &&
        pixel->y() <= size.height - 1.0) {
      add(*pixel);
    }
  }
  return out;
}

double radius(const Numbers& p, double theta) {
  const double t = theta * theta;
  return theta * (1.0 + t * (p[4] + t * (p[5] + t * (p[6] + t * p[7]))));
}

}  // namespace

std::optional<StandardCameraInfo> fitEquidistant(const LensModel& lens, cv::Size image_size) {
  const std::vector<Sample> samples = sample(lens, image_size);
  if (samples.size() < 20) return std::nullopt;

  // Start: the slope on the axis, equal to both sides.
  const Eigen::Vector2d center = lens.center();
  Jacobian23 slope;
  if (!lens.project({0.0, 0.0, 1.0}, &slope)) return std::nullopt;
  Numbers p;
  p << slope(0, 0), slope(1, 1), center, 0.0, 0.0, 0.0, 0.0;

  const auto residual = [&](const Numbers& q, const Sample& s) -> Eigen::Vector2d {
    return q.segment<2>(2) + radius(q, s.theta) * q.head<2>().cwiseProduct(s.azimuth) - s.pixel;
  };
  const auto cost = [&](const Numbers& q) {
    double sum = 0.0;
    for (const Sample& s : samples) sum += residual(q, s).squaredNorm();
    return sum;
  };
  double now = cost(p);
  double damping = 1e-9;
  for (int iteration = 0; iteration < 50; ++iteration) {
    Eigen::Matrix<double, 8, 8> A = Eigen::Matrix<double, 8, 8>::Zero();
    Numbers b = Numbers::Zero();
    for (const Sample& s : samples) {
      const double r = radius(p, s.theta);
      Eigen::Matrix<double, 2, 8> J = Eigen::Matrix<double, 2, 8>::Zero();
      J(0, 0) = r * s.azimuth.x();
      J(1, 1) = r * s.azimuth.y();
      J(0, 2) = J(1, 3) = 1.0;
      double power = s.theta;
      for (int k = 4; k < 8; ++k) {
        power *= s.theta * s.theta;
        J.col(k) = power * p.head<2>().cwiseProduct(s.azimuth);
      }
      A += J.transpose() * J;
      b += J.transpose() * residual(p, s);
    }
    const Numbers scale = A.diagonal().cwiseMax(1e-30).cwiseSqrt().cwiseInverse();
    bool moved = false;
    bool converged = false;
    while (damping < 1e9) {
      Eigen::Matrix<double, 8, 8> damped = scale.asDiagonal() * A * scale.asDiagonal();
      damped.diagonal().array() += damping;
      const Numbers next = p - scale.cwiseProduct(damped.ldlt().solve(scale.cwiseProduct(b)));
      const double next_cost = next.allFinite() ? cost(next) : now;
      if (next_cost < now) {
        converged = now - next_cost <= 1e-12 * now;
        p = next;
        now = next_cost;
        damping = std::max(1e-12, damping * 0.1);
        moved = true;
        break;
      }
      damping *= 10.0;
    }
    if (!moved || converged) break;
  }

  StandardCameraInfo out;
  double theta_max = 0.0;
  for (const Sample& s : samples) {
    out.worst_residual_px = std::max(out.worst_residual_px, residual(p, s).norm());
    theta_max = std::max(theta_max, s.theta);
  }
  for (int i = 1; i <= 200; ++i) {
    if (!(radius(p, theta_max * i / 200) > radius(p, theta_max * (i - 1) / 200))) {
      return std::nullopt;
    }
  }
  if (!(p[0] > 0.0) || !(p[1] > 0.0)) return std::nullopt;
  out.distortion_model = "equidistant";
  out.K << p[0], 0.0, p[2], 0.0, p[1], p[3], 0.0, 0.0, 1.0;
  out.D.assign(p.data() + 4, p.data() + 8);
  return out;
}

}  // namespace omnister::detail
