// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/plane_fit.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <random>
#include <string>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"

namespace omnister {
namespace {

struct Plane {
  Eigen::Vector3d normal;
  double offset;  // normal . p = offset

  double residual(const Eigen::Vector3d& p) const { return normal.dot(p) - offset; }
};

bool agrees(const Plane& plane, const Eigen::Vector3d& p, double tolerance) {
  const double residual = plane.residual(p);
  return residual * residual <= tolerance * tolerance * p.squaredNorm();
}

// The mean of uniform draws is not needed, only the same ones on every machine: no
// std::distribution.
std::size_t draw(std::mt19937_64& random, std::size_t count) { return random() % count; }

Plane randomSearch(const std::vector<Eigen::Vector3d>& points, const PlaneFitOptions& options) {
  std::mt19937_64 random(options.seed);
  // Scored on a sample: shares of some thousand points are known to a percent.
  constexpr std::size_t kSample = 4000;
  std::vector<Eigen::Vector3d> sample;
  for (std::size_t i = 0; i < std::min(kSample, points.size()); ++i) {
    sample.push_back(points.size() <= kSample ? points[i] : points[draw(random, points.size())]);
  }
  Plane best{Eigen::Vector3d::UnitZ(), 0.0};
  std::size_t most = 0;
  for (int i = 0; i < options.iterations; ++i) {
    const Eigen::Vector3d a = sample[draw(random, sample.size())];
    const Eigen::Vector3d b = sample[draw(random, sample.size())];
    const Eigen::Vector3d c = sample[draw(random, sample.size())];
    const Eigen::Vector3d normal = (b - a).cross(c - a);
    // Nearly on one line.
    if (!(normal.norm() > 1e-6 * (b - a).norm() * (c - a).norm())) continue;
    const Plane plane{normal.normalized(), normal.normalized().dot(a)};
    const std::size_t votes = std::count_if(sample.begin(), sample.end(), [&](const auto& p) {
      return agrees(plane, p, options.tolerance);
    });
    if (votes > most) {
      most = votes;
      best = plane;
    }
  }
  if (10 * most < sample.size()) {
    throw Error("no plane agrees with a tenth of the " + std::to_string(points.size()) + " points");
  }
  return best;
}

Plane leastSquares(const std::vector<Eigen::Vector3d>& points, const Plane& start,
                   double tolerance) {
  double weights = 0.0;
  Eigen::Vector3d mean = Eigen::Vector3d::Zero();
  for (const auto& p : points) {
    if (!agrees(start, p, tolerance)) continue;
    mean += p / p.squaredNorm();
    weights += 1.0 / p.squaredNorm();
  }
  mean /= weights;
  Eigen::Matrix3d scatter = Eigen::Matrix3d::Zero();
  for (const auto& p : points) {
    if (!agrees(start, p, tolerance)) continue;
    scatter += (p - mean) * (p - mean).transpose() / p.squaredNorm();
  }
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(scatter);
  const Eigen::Vector3d normal = solver.eigenvectors().col(0);
  return {normal, normal.dot(mean)};
}

double median(std::vector<double>& values) {
  if (values.empty()) return 0.0;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

PlaneFitBand statistics(const std::vector<Eigen::Vector3d>& points, const Plane& plane,
                        double tolerance, double from_theta, double to_theta) {
  PlaneFitBand band;
  band.from_theta = from_theta;
  band.to_theta = to_theta;
  std::vector<double> residuals, range_errors;
  double squares = 0.0;
  for (const auto& p : points) {
    const double theta = std::atan2(p.head<2>().norm(), p.z());
    if (theta < from_theta || theta >= to_theta) continue;
    const double residual = plane.residual(p);
    residuals.push_back(std::abs(residual));
    // Along the ray p the plane lies at range |p| offset / (normal . p).
    range_errors.push_back(std::abs(residual / plane.offset));
    if (agrees(plane, p, tolerance)) {
      ++band.inliers;
      squares += residual * residual;
    }
  }
  band.points = residuals.size();
  band.rms = band.inliers > 0 ? std::sqrt(squares / band.inliers) : 0.0;
  band.median_residual = median(residuals);
  band.median_range_error = median(range_errors);
  return band;
}

}  // namespace

PlaneFit fitPlane(const cv::Mat& xyz, const PlaneFitOptions& options) {
  if (xyz.type() != CV_32FC3) throw Error("a cloud to fit a plane to is not of 32-bit x y z");
  if (!(options.tolerance > 0.0 && options.tolerance < 1.0)) {
    throw Error("tolerance of the plane fit is " + formatNumber(options.tolerance) +
                ", expected a share between 0 and 1");
  }
  if (options.iterations < 1 || options.iterations > 100000) {
    throw Error("iterations of the plane fit are " + std::to_string(options.iterations) +
                ", expected 1 to 100000");
  }
  std::vector<Eigen::Vector3d> points;
  for (int v = 0; v < xyz.rows; ++v) {
    for (int u = 0; u < xyz.cols; ++u) {
      const auto& p = xyz.at<cv::Vec3f>(v, u);
      const Eigen::Vector3d point(p[0], p[1], p[2]);
      if (point.allFinite() && point.squaredNorm() > 0.0) points.push_back(point);
    }
  }
  if (points.size() < 10) {
    throw Error("only " + std::to_string(points.size()) + " points to fit a plane to, expected 10");
  }
  Plane plane = randomSearch(points, options);
  for (int i = 0; i < 5; ++i) plane = leastSquares(points, plane, options.tolerance);
  // The normal looks back at the camera, which stands at the origin.
  if (plane.offset > 0.0) plane = {-plane.normal, -plane.offset};

  PlaneFit fit;
  fit.normal = plane.normal;
  fit.distance = -plane.offset;
  fit.all = statistics(points, plane, options.tolerance, 0.0, 2.0 * M_PI);
  fit.all.to_theta = M_PI;
  constexpr int kBands = 18;
  for (int i = 0; i < kBands; ++i) {
    const double to = i + 1 == kBands ? 2.0 * M_PI : (i + 1) * M_PI / kBands;
    PlaneFitBand band = statistics(points, plane, options.tolerance, i * M_PI / kBands, to);
    band.to_theta = (i + 1) * M_PI / kBands;
    if (band.points > 0) fit.bands.push_back(band);
  }
  return fit;
}

}  // namespace omnister
