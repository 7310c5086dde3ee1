// SPDX-License-Identifier: Apache-2.0
#include "lens/foreign/foreign_models.h"

#include <algorithm>
#include <array>
#include <cmath>

namespace omnister::detail {
namespace {

Eigen::Vector2d toPixel(const Eigen::Matrix3d& K, const Eigen::Vector2d& m) {
  return K.topLeftCorner<2, 2>() * m + K.topRightCorner<2, 1>();
}

}  // namespace

PlaneBend openCvBend(Numbers k) {
  k.resize(12, 0.0);
  return [k](const Eigen::Vector2d& m) -> std::optional<Eigen::Vector2d> {
    const double x = m.x();
    const double y = m.y();
    const double r2 = m.squaredNorm();
    const double numerator = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]));
    const double denominator = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]));
    // Past a pole or a zero the image comes back mirrored.
    if (!(denominator > 1e-9) || !(numerator > 0.0)) return std::nullopt;
    const double radial = numerator / denominator;
    return Eigen::Vector2d(
        x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x) + r2 * (k[8] + r2 * k[9]),
        y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y + r2 * (k[10] + r2 * k[11]));
  };
}

PlaneBend fovBend(double w) {
  return [w](const Eigen::Vector2d& m) -> std::optional<Eigen::Vector2d> {
    const double r = m.norm();
    if (r < 1e-12) return Eigen::Vector2d(m * (2.0 * std::tan(0.5 * w) / w));
    return Eigen::Vector2d(m * (std::atan(2.0 * r * std::tan(0.5 * w)) / (w * r)));
  };
}

ForeignProject equidistantProject(const Eigen::Matrix3d& K, Numbers k) {
  k.resize(4, 0.0);
  return [K, k](const Eigen::Vector3d& n) -> std::optional<Eigen::Vector2d> {
    const double s = n.head<2>().norm();
    const double theta = std::atan2(s, n.z());
    const double t = theta * theta;
    const double r = theta * (1.0 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))));
    if (!(r >= 0.0)) return std::nullopt;
    return toPixel(K, s > 0.0 ? Eigen::Vector2d(n.head<2>() * (r / s)) : Eigen::Vector2d(0.0, 0.0));
  };
}

ForeignProject pinholeProject(const Eigen::Matrix3d& K, PlaneBend bend) {
  return [K, bend](const Eigen::Vector3d& n) -> std::optional<Eigen::Vector2d> {
    if (!(n.z() > 1e-6)) return std::nullopt;
    const auto m = bend(n.head<2>() / n.z());
    if (!m) return std::nullopt;
    return toPixel(K, *m);
  };
}

ForeignProject omniProject(const Eigen::Matrix3d& K, double xi, PlaneBend bend) {
  return [K, xi, bend](const Eigen::Vector3d& n) -> std::optional<Eigen::Vector2d> {
    const double depth = n.z() + xi;
    // For xi > 1 the radius turns back where cos(theta) = -1 / xi.
    if (!(depth > 1e-6) || (xi > 1.0 && !(n.z() > -1.0 / xi))) return std::nullopt;
    const auto m = bend(n.head<2>() / depth);
    if (!m) return std::nullopt;
    return toPixel(K, *m);
  };
}

ForeignProject doubleSphereProject(const Eigen::Matrix3d& K, double xi, double alpha) {
  return [K, xi, alpha](const Eigen::Vector3d& n) -> std::optional<Eigen::Vector2d> {
    const double z = xi + n.z();
    const double d2 = std::sqrt(n.head<2>().squaredNorm() + z * z);
    const double w1 = alpha > 0.5 ? (1.0 - alpha) / alpha : alpha / (1.0 - alpha);
    const double w2 = (w1 + xi) / std::sqrt(2.0 * w1 * xi + xi * xi + 1.0);
    const double depth = alpha * d2 + (1.0 - alpha) * z;
    if (!(n.z() > -w2) || !(depth > 1e-9)) return std::nullopt;
    return toPixel(K, n.head<2>() / depth);
  };
}

ForeignProject eucmProject(const Eigen::Matrix3d& K, double alpha, double beta) {
  return [K, alpha, beta](const Eigen::Vector3d& n) -> std::optional<Eigen::Vector2d> {
    const double d = std::sqrt(beta * n.head<2>().squaredNorm() + n.z() * n.z());
    const double depth = alpha * d + (1.0 - alpha) * n.z();
    if (!(depth > 1e-9)) return std::nullopt;
    return toPixel(K, n.head<2>() / depth);
  };
}

ForeignProject ocamProject(OcamNumbers ocam, double max_rho) {
  // theta(rho) = atan2(rho, -f(rho)) rises at first; beyond its first turn there is nothing to
  // find.
  const auto theta = [polynomial = ocam.polynomial](double rho) {
    double f = 0.0;
    for (auto k = polynomial.rbegin(); k != polynomial.rend(); ++k) f = f * rho + *k;
    return std::atan2(rho, -f);
  };
  constexpr int kSteps = 4000;
  double last = 0.0;
  double rho_end = 0.0;
  for (int i = 1; i <= kSteps; ++i) {
    const double rho = max_rho * i / kSteps;
    const double now = theta(rho);
    if (!(now > last)) break;
    last = now;
    rho_end = rho;
  }
  const double theta_end = last;
  return [ocam, theta, rho_end,
          theta_end](const Eigen::Vector3d& n) -> std::optional<Eigen::Vector2d> {
    const double s = n.head<2>().norm();
    const double wanted = std::atan2(s, n.z());
    if (!(wanted <= theta_end)) return std::nullopt;
    double low = 0.0;
    double high = rho_end;
    for (int i = 0; i < 60; ++i) {
      const double middle = 0.5 * (low + high);
      (theta(middle) < wanted ? low : high) = middle;
    }
    const double rho = 0.5 * (low + high);
    const double down = s > 0.0 ? rho * n.y() / s : 0.0;
    const double right = s > 0.0 ? rho * n.x() / s : 0.0;
    return Eigen::Vector2d(ocam.e * down + right + ocam.center_col,
                           ocam.c * down + ocam.d * right + ocam.center_row);
  };
}

ForeignProject cahvorProject(const Eigen::Matrix3d& K, const Numbers& k) {
  const Eigen::Vector3d o(std::sin(k[0]) * std::cos(k[1]), std::sin(k[1]),
                          std::cos(k[0]) * std::cos(k[1]));
  const std::array<double, 3> r{k[2], k[3], k[4]};
  return [K, o, r](const Eigen::Vector3d& n) -> std::optional<Eigen::Vector2d> {
    const double omega = n.dot(o);
    if (!(omega > 1e-6) || !(n.z() > 1e-6)) return std::nullopt;
    const double tau = 1.0 / (omega * omega) - 1.0;
    const double mu = r[0] + tau * (r[1] + tau * r[2]);
    const Eigen::Vector3d bent = n + mu * (n - omega * o);
    if (!(bent.z() > 1e-6)) return std::nullopt;
    return toPixel(K, bent.head<2>() / bent.z());
  };
}

ForeignProject splinedStereographicProject(const Eigen::Matrix3d& K, SplinedStereographic spline) {
  // The outermost control points lie beyond the edge of the field: one interval less for each order
  // above the first.
  const double edge = 2.0 * std::tan(spline.fov_x / 4.0);
  const double per_u = (spline.nx - spline.order) / (2.0 * edge);
  return [K, spline, per_u](const Eigen::Vector3d& n) -> std::optional<Eigen::Vector2d> {
    if (!(1.0 + n.z() > 1e-6)) return std::nullopt;
    const Eigen::Vector2d u = 2.0 * n.head<2>() / (1.0 + n.z());
    const double x = u.x() * per_u + 0.5 * (spline.nx - 1);
    const double y = u.y() * per_u + 0.5 * (spline.ny - 1);
    // Weights of the uniform B-spline, and the first control point.
    const auto weights = [&](double place, int count, std::array<double, 4>& w) {
      if (spline.order == 3) {
        const int i = std::clamp(static_cast<int>(std::floor(place)), 1, count - 3);
        const double t = place - i;
        const double v = 1.0 - t;
        w = {v * v * v / 6.0, (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0,
             (3.0 * v * v * v - 6.0 * v * v + 4.0) / 6.0, t * t * t / 6.0};
        return i - 1;
      }
      const int i = std::clamp(static_cast<int>(std::floor(place + 0.5)), 1, count - 2);
      const double t = place - i;
      w = {(4.0 * t * t - 4.0 * t + 1.0) / 8.0, (3.0 - 4.0 * t * t) / 4.0,
           (4.0 * t * t + 4.0 * t + 1.0) / 8.0, 0.0};
      return i - 1;
    };
    std::array<double, 4> wx;
    std::array<double, 4> wy;
    const int ix = weights(x, spline.nx, wx);
    const int iy = weights(y, spline.ny, wy);
    // Beyond the control points the formula says nothing.
    if (x < 0.0 || y < 0.0 || x > spline.nx - 1 || y > spline.ny - 1) return std::nullopt;
    Eigen::Vector2d shift = Eigen::Vector2d::Zero();
    for (int j = 0; j <= spline.order; ++j) {
      for (int i = 0; i <= spline.order; ++i) {
        const double* c = spline.control_points.data() +
                          2 * (static_cast<std::size_t>(iy + j) * spline.nx + ix + i);
        shift += wx[i] * wy[j] * Eigen::Vector2d(c[0], c[1]);
      }
    }
    return toPixel(K, u + shift);
  };
}

}  // namespace omnister::detail
