// SPDX-License-Identifier: Apache-2.0
#include "calibration/fit/start.h"

#include <Eigen/Eigenvalues>
#include <Eigen/SVD>
#include <algorithm>
#include <cmath>

#include "omnister/common/parallel.h"

namespace omnister::calibration {

namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr int kShapes = 4;
constexpr std::size_t kViewsTried = 24;

double median(std::vector<double> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// Residual of one view after its pose was refined on bearings: median over corners of the angle
/// between observed and predicted bearing, in pixels by the profile's own scale.
double viewResidual(const Profile& profile, const Eigen::Vector2d& center,
                    const std::vector<Corner>& corners) {
  const auto bearings = bearingsOf(profile, center, corners);
  const auto pose = poseFromBearings(bearings, corners);
  if (!pose) return HUGE_VAL;
  // Two rounds of Gauss-Newton on the chord between unit bearings: the linear solution minimises
  // nothing geometric.
  Pose refined = *pose;
  for (int round = 0; round < 3; ++round) {
    Eigen::Matrix<double, 6, 6> hessian = Eigen::Matrix<double, 6, 6>::Zero();
    Eigen::Matrix<double, 6, 1> gradient = Eigen::Matrix<double, 6, 1>::Zero();
    for (std::size_t i = 0; i < corners.size(); ++i) {
      const Eigen::Vector3d rotated = refined.linear() * corners[i].point;
      const Eigen::Vector3d X = rotated + refined.translation();
      const double length = X.norm();
      const Eigen::Vector3d unit = X / length;
      const Eigen::Matrix3d d_unit =
          (Eigen::Matrix3d::Identity() - unit * unit.transpose()) / length;
      Eigen::Matrix<double, 3, 6> jacobian;
      Eigen::Matrix3d cross;
      cross << 0, -rotated.z(), rotated.y(), rotated.z(), 0, -rotated.x(), -rotated.y(),
          rotated.x(), 0;
      jacobian.leftCols<3>() = -d_unit * cross;
      jacobian.rightCols<3>() = d_unit;
      const Eigen::Vector3d residual = unit - bearings[i];
      const double weight = 1.0 / (1.0 + residual.squaredNorm() / (0.01 * 0.01));
      hessian += weight * jacobian.transpose() * jacobian;
      gradient += weight * jacobian.transpose() * residual;
    }
    hessian.diagonal() *= 1.0 + 1e-6;
    const Eigen::Matrix<double, 6, 1> step = hessian.ldlt().solve(-gradient);
    if (!step.allFinite()) break;
    const double angle = step.head<3>().norm();
    if (angle > 0.0) {
      refined.linear() =
          Eigen::AngleAxisd(angle, Eigen::Vector3d(step.head<3>() / angle)) * refined.linear();
    }
    refined.translation() += step.tail<3>();
  }
  std::vector<double> errors;
  errors.reserve(corners.size());
  for (const Corner& corner : corners) {
    const Eigen::Vector3d X = refined * corner.point;
    const double rho = X.head<2>().norm();
    const double theta = std::atan2(rho, X.z());
    const double radius = profile.radius(theta);
    if (!std::isfinite(radius)) {
      errors.push_back(1e3);
      continue;
    }
    Eigen::Vector2d pixel = center;
    if (rho > 0.0) pixel += radius / rho * X.head<2>();
    errors.push_back((pixel - corner.pixel).norm());
  }
  return median(std::move(errors));
}

}  // namespace

double Profile::theta(double radius) const {
  const double x = radius / focal_px;
  switch (shape) {
    case 0:
      return std::atan(x);
    case 1:
      return 2.0 * std::atan(0.5 * x);
    case 2:
      return x < kPi ? x : std::nan("");
    default:
      return x < 2.0 ? 2.0 * std::asin(0.5 * x) : std::nan("");
  }
}

double Profile::radius(double theta) const {
  if (!(theta < maxTheta())) return std::nan("");
  switch (shape) {
    case 0:
      return focal_px * std::tan(theta);
    case 1:
      return focal_px * 2.0 * std::tan(0.5 * theta);
    case 2:
      return focal_px * theta;
    default:
      return focal_px * 2.0 * std::sin(0.5 * theta);
  }
}

double Profile::maxTheta() const { return shape == 0 ? 0.5 * kPi : kPi; }

std::vector<Eigen::Vector3d> bearingsOf(const Profile& profile, const Eigen::Vector2d& center,
                                        const std::vector<Corner>& corners) {
  std::vector<Eigen::Vector3d> bearings;
  bearings.reserve(corners.size());
  for (const Corner& corner : corners) {
    const Eigen::Vector2d offset = corner.pixel - center;
    const double radius = offset.norm();
    const double theta = profile.theta(radius);
    Eigen::Vector3d bearing(0.0, 0.0, 1.0);
    if (radius > 0.0) bearing << std::sin(theta) / radius * offset, std::cos(theta);
    bearings.push_back(bearing);
  }
  return bearings;
}

std::optional<Pose> poseFromBearings(const std::vector<Eigen::Vector3d>& bearings,
                                     const std::vector<Corner>& corners) {
  if (corners.size() < 4) return std::nullopt;
  // Board coordinates about their own middle and of unit size keep the system well scaled.
  Eigen::Vector2d mean = Eigen::Vector2d::Zero();
  for (const Corner& corner : corners) mean += corner.point.head<2>();
  mean /= static_cast<double>(corners.size());
  double scale = 0.0;
  for (const Corner& corner : corners) scale += (corner.point.head<2>() - mean).squaredNorm();
  scale = std::sqrt(scale / static_cast<double>(corners.size()));
  if (!(scale > 0.0)) return std::nullopt;

  Eigen::Matrix<double, 9, 9> normal = Eigen::Matrix<double, 9, 9>::Zero();
  for (std::size_t i = 0; i < corners.size(); ++i) {
    const Eigen::Vector3d& b = bearings[i];
    if (!b.allFinite()) return std::nullopt;
    const Eigen::Vector2d xy = (corners[i].point.head<2>() - mean) / scale;
    const Eigen::Vector3d p(xy.x(), xy.y(), 1.0);
    const Eigen::Matrix3d projector = Eigen::Matrix3d::Identity() - b * b.transpose();
    // |b x H p|^2 with H by columns: kron(p, I)^T (I - b b^T) kron(p, I)
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c) normal.block<3, 3>(3 * r, 3 * c) += p[r] * p[c] * projector;
    }
  }
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix<double, 9, 9>> solver(normal);
  if (solver.info() != Eigen::Success) return std::nullopt;
  if (solver.eigenvalues()[1] < 1e-12 * solver.eigenvalues()[8]) return std::nullopt;
  const Eigen::Matrix<double, 9, 1> h = solver.eigenvectors().col(0);
  Eigen::Matrix3d H = Eigen::Map<const Eigen::Matrix3d>(h.data());
  double along = 0.0;
  for (std::size_t i = 0; i < corners.size(); ++i) {
    const Eigen::Vector2d xy = (corners[i].point.head<2>() - mean) / scale;
    along += bearings[i].dot(H * Eigen::Vector3d(xy.x(), xy.y(), 1.0)) > 0.0 ? 1.0 : -1.0;
  }
  if (along < 0.0) H = -H;
  const Eigen::JacobiSVD<Eigen::Matrix<double, 3, 2>> svd(
      H.leftCols<2>(), Eigen::ComputeFullU | Eigen::ComputeFullV);
  const double length = svd.singularValues().mean();
  if (!(svd.singularValues()[1] > 1e-9 * svd.singularValues()[0])) return std::nullopt;
  const Eigen::Matrix<double, 3, 2> r12 = svd.matrixU().leftCols<2>() * svd.matrixV().transpose();
  Pose pose = Pose::Identity();
  pose.linear() << r12, r12.col(0).cross(r12.col(1));
  pose.translation() = H.col(2) * (scale / length) - r12 * mean;
  if (!pose.matrix().allFinite()) return std::nullopt;
  return pose;
}

std::vector<Start> findStarts(const std::vector<std::vector<Corner>>& views, cv::Size image_size,
                              int threads) {
  const Eigen::Vector2d center(0.5 * (image_size.width - 1), 0.5 * (image_size.height - 1));
  double largest_radius = 0.0;
  for (const auto& corners : views) {
    for (const Corner& corner : corners) {
      largest_radius = std::max(largest_radius, (corner.pixel - center).norm());
    }
  }
  // Views spread over the recording: neighbours in a sequence look alike.
  std::vector<const std::vector<Corner>*> tried;
  const std::size_t count = std::min(views.size(), kViewsTried);
  for (std::size_t i = 0; i < count; ++i) tried.push_back(&views[i * views.size() / count]);

  std::vector<Start> starts;
  for (int shape = 0; shape < kShapes; ++shape) {
    for (double degrees = 3.0; degrees < 150.0; degrees *= 1.09) {
      const double theta = degrees * kPi / 180.0;
      if (shape == 0 && degrees > 75.0) break;
      // Below, all profiles are one.
      if (shape > 0 && degrees < 12.0) continue;
      Profile profile{shape, 1.0};
      profile.focal_px = largest_radius / profile.radius(theta);
      starts.push_back({profile, 0.0, theta});
    }
  }
  parallelFor(0, starts.size(), threads, [&](std::size_t i) {
    // Views that fit badly say that the profile is wrong, views that do not fit at all that they
    // are bad: the lower three quarters count.
    std::vector<double> errors;
    for (const auto* corners : tried) {
      errors.push_back(std::min(viewResidual(starts[i].profile, center, *corners), 1e3));
    }
    std::sort(errors.begin(), errors.end());
    const std::size_t kept = std::max<std::size_t>(1, (3 * errors.size() + 3) / 4);
    double sum = 0.0;
    for (std::size_t k = 0; k < kept; ++k) sum += errors[k] * errors[k];
    starts[i].score_px = std::sqrt(sum / static_cast<double>(kept));
  });
  std::stable_sort(starts.begin(), starts.end(),
                   [](const Start& a, const Start& b) { return a.score_px < b.score_px; });
  // The best of each shape, then of clearly different fields: neighbours lead to the same optimum.
  std::vector<Start> chosen;
  for (const Start& start : starts) {
    if (start.score_px >= 1e3) break;
    const bool fresh = std::none_of(chosen.begin(), chosen.end(), [&](const Start& other) {
      return std::abs(std::log(other.max_theta / start.max_theta)) < 0.3;
    });
    if (fresh) chosen.push_back(start);
    if (chosen.size() == 4) break;
  }
  return chosen;
}

}  // namespace omnister::calibration
