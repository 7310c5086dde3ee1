// SPDX-License-Identifier: Apache-2.0
#include <Eigen/Dense>
#include <algorithm>
#include <cmath>

#include "omnister/calibration/detector.h"
#include "omnister/common/error.h"
#include "omnister/common/pose.h"
#include "point_refinement.h"

namespace omnister {
namespace {

struct Sight {
  Eigen::Vector3d board;
  Eigen::Vector2d pixel;
  Eigen::Vector3d bearing;
};

// Direct linear transform on bearings: every bearing is along H (x, y, 1), at any angle off the
// axis.
std::optional<Pose> poseFromBearings(const std::vector<Sight>& sights) {
  Eigen::Vector2d middle = Eigen::Vector2d::Zero();
  for (const Sight& sight : sights) middle += sight.board.head<2>() / sights.size();
  double size = 0.0;
  for (const Sight& sight : sights) size = std::max(size, (sight.board.head<2>() - middle).norm());
  if (!(size > 0.0)) return std::nullopt;
  Eigen::Matrix<double, 9, 9> normal = Eigen::Matrix<double, 9, 9>::Zero();
  for (const Sight& sight : sights) {
    const Eigen::Vector2d place = (sight.board.head<2>() - middle) / size;
    const Eigen::Vector3d homogeneous(place.x(), place.y(), 1.0);
    Eigen::Matrix3d cross;
    cross << 0, -sight.bearing.z(), sight.bearing.y(), sight.bearing.z(), 0, -sight.bearing.x(),
        -sight.bearing.y(), sight.bearing.x(), 0;
    Eigen::Matrix<double, 3, 9> rows;
    for (int k = 0; k < 3; ++k) rows.block<3, 3>(0, 3 * k) = cross * homogeneous(k);
    normal += rows.transpose() * rows;
  }
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix<double, 9, 9>> solver(normal);
  // Corners on one line leave a second solution.
  if (!(solver.eigenvalues()(1) > 1e-9 * solver.eigenvalues()(8))) return std::nullopt;
  const Eigen::Matrix<double, 9, 1> h = solver.eigenvectors().col(0);
  Eigen::Matrix3d homography = Eigen::Map<const Eigen::Matrix3d>(h.data());
  double side = 0.0;
  for (const Sight& sight : sights) {
    const Eigen::Vector2d place = (sight.board.head<2>() - middle) / size;
    side += sight.bearing.dot(homography * Eigen::Vector3d(place.x(), place.y(), 1.0));
  }
  if (side < 0.0) homography = -homography;
  const double scale = std::sqrt(homography.col(0).norm() * homography.col(1).norm());
  if (!(scale > 1e-12)) return std::nullopt;
  homography /= scale;
  Eigen::Matrix3d rotation;
  rotation.col(0) = homography.col(0).normalized();
  rotation.col(1) =
      (homography.col(1) - homography.col(1).dot(rotation.col(0)) * rotation.col(0)).normalized();
  rotation.col(2) = rotation.col(0).cross(rotation.col(1));
  if (!rotation.allFinite()) return std::nullopt;
  Pose pose = Pose::Identity();
  pose.linear() = rotation;
  pose.translation() =
      size * homography.col(2) - rotation * Eigen::Vector3d(middle.x(), middle.y(), 0.0);
  return pose;
}

// Reprojection error with a robust loss; returns its mean.
double poseCost(const std::vector<Sight>& sights, const LensModel& lens, const Pose& pose,
                Eigen::Matrix<double, 6, 6>* normal, Eigen::Matrix<double, 6, 1>* right) {
  constexpr double kHuber = 1.0;
  constexpr double kLost = 50.0;  // a corner that does not project at all counts as far off
  if (normal != nullptr) {
    normal->setZero();
    right->setZero();
  }
  double cost = 0.0;
  for (const Sight& sight : sights) {
    const Eigen::Vector3d point = pose * sight.board;
    Jacobian23 slope;
    const auto pixel = lens.project(point, &slope);
    if (!pixel) {
      cost += kHuber * (2.0 * kLost - kHuber);
      continue;
    }
    const Eigen::Vector2d off = *pixel - sight.pixel;
    const double length = off.norm();
    cost += length <= kHuber ? length * length : kHuber * (2.0 * length - kHuber);
    if (normal == nullptr) continue;
    const double weight = length <= kHuber ? 1.0 : kHuber / length;
    const Eigen::Vector3d arm = point - pose.translation();
    Eigen::Matrix<double, 3, 6> motion;
    motion << 0, arm.z(), -arm.y(), 1, 0, 0, -arm.z(), 0, arm.x(), 0, 1, 0, arm.y(), -arm.x(), 0, 0,
        0, 1;
    const Eigen::Matrix<double, 2, 6> jacobian = slope * motion;
    *normal += weight * jacobian.transpose() * jacobian;
    *right += weight * jacobian.transpose() * off;
  }
  return cost / static_cast<double>(sights.size());
}

Pose refinePose(const std::vector<Sight>& sights, const LensModel& lens, Pose pose) {
  Eigen::Matrix<double, 6, 6> normal;
  Eigen::Matrix<double, 6, 1> right;
  double damping = 1e-4;
  double cost = poseCost(sights, lens, pose, &normal, &right);
  for (int round = 0; round < 50 && damping < 1e8; ++round) {
    Eigen::Matrix<double, 6, 6> damped = normal;
    damped.diagonal() *= 1.0 + damping;
    const Eigen::Matrix<double, 6, 1> step = -damped.ldlt().solve(right);
    if (!step.allFinite()) break;
    const double angle = step.head<3>().norm();
    Pose next = pose;
    if (angle > 0.0) {
      next.linear() =
          Eigen::AngleAxisd(angle, step.head<3>() / angle).toRotationMatrix() * pose.linear();
    }
    next.translation() += step.tail<3>();
    const double next_cost = poseCost(sights, lens, next, nullptr, nullptr);
    if (!(next_cost < cost)) {
      damping *= 10.0;
      continue;
    }
    const bool settled = cost - next_cost < 1e-9 * cost;
    pose = next;
    cost = poseCost(sights, lens, pose, &normal, &right);
    damping *= 0.1;
    if (settled) break;
  }
  return pose;
}

// A dot's image is no ellipse about the image of its centre: where its centroid lies instead.
Eigen::Vector2d centroidShift(const LensModel& lens, const Pose& pose,
                              const Eigen::Vector3d& centre, const Eigen::Vector2d& pixel,
                              double radius) {
  constexpr int kSides = 24;
  std::vector<Eigen::Vector2d> rim;
  for (int k = 0; k < kSides; ++k) {
    const double angle = 2.0 * M_PI * k / kSides;
    const auto place = lens.project(
        pose * (centre + radius * Eigen::Vector3d(std::cos(angle), std::sin(angle), 0)));
    if (!place) return Eigen::Vector2d::Zero();
    rim.push_back(*place - pixel);
  }
  double area = 0.0;
  Eigen::Vector2d moment = Eigen::Vector2d::Zero();
  for (int k = 0; k < kSides; ++k) {
    const Eigen::Vector2d& a = rim[k];
    const Eigen::Vector2d& b = rim[(k + 1) % kSides];
    const double cross = a.x() * b.y() - a.y() * b.x();
    area += cross / 2.0;
    moment += (a + b) * cross / 6.0;
  }
  return std::abs(area) > 1e-9 ? Eigen::Vector2d(moment / area) : Eigen::Vector2d::Zero();
}

}  // namespace

ViewDetections refineGuided(const cv::Mat& image, const Target& target, const LensModel& lens,
                            const ViewDetections& first) {
  checkTarget(target, "target");
  if (first.pixels.size() != first.points.size() || first.pixels.size() < 4) {
    throw Error("refining needs at least 4 corners of the first pass, got " +
                std::to_string(first.pixels.size()));
  }
  const detect::GrayImage gray = detect::toGray(image);
  if (gray.fine.empty()) throw Error("refining needs an image");
  std::vector<Sight> sights;
  for (std::size_t i = 0; i < first.pixels.size(); ++i) {
    if (const auto bearing = lens.unproject(first.pixels[i])) {
      sights.push_back({first.points[i], first.pixels[i], *bearing});
    }
  }
  const auto start = sights.size() >= 4 ? poseFromBearings(sights) : std::nullopt;
  if (!start) return first;  // outside the lens' field or on one line: nothing to predict from
  const Pose pose = refinePose(sights, lens, *start);

  const std::vector<Eigen::Vector3d> board = targetPoints(target);
  std::vector<int> first_of(board.size(), -1);
  for (std::size_t i = 0; i < first.points.size(); ++i) {
    for (std::size_t id = 0; id < board.size(); ++id) {
      if ((board[id] - first.points[i]).norm() < 0.01 * target.square_m) {
        first_of[id] = static_cast<int>(i);
      }
    }
  }
  detect::Expected expected(board.size());
  std::vector<Eigen::Vector2d> shift(board.size(), Eigen::Vector2d::Zero());
  for (std::size_t id = 0; id < board.size(); ++id) {
    Jacobian23 slope;
    const auto pixel = lens.project(pose * board[id], &slope);
    if (!pixel || !(pixel->x() >= 1 && pixel->y() >= 1 && pixel->x() <= gray.fine.cols - 2 &&
                    pixel->y() <= gray.fine.rows - 2)) {
      continue;
    }
    const Eigen::Matrix2d jacobian = slope * pose.linear().leftCols<2>();
    if (target.type == TargetType::kCircles) {
      const double nearest = target.square_m * (target.asymmetric ? std::sqrt(2.0) : 1.0);
      const double radius = 0.5 * (target.dot_m > 0.0 ? target.dot_m : 0.5 * nearest);
      shift[id] = centroidShift(lens, pose, board[id], *pixel, radius);
    }
    expected[id] = detect::LocalFrame{*pixel + shift[id], jacobian};
  }
  bool first_square_dark = true;
  if (target.type == TargetType::kCheckerboard) {
    detect::Expected seen = expected;
    for (std::size_t id = 0; id < seen.size(); ++id) {
      if (first_of[id] < 0) seen[id].reset();
    }
    first_square_dark = detect::firstSquareContrast(gray.fine, target, seen) >= 0.0;
  }
  const detect::Measured measured =
      detect::measurePoints(gray.fine, target, expected, first_square_dark);

  ViewDetections view;
  view.name = first.name;
  for (std::size_t id = 0; id < board.size(); ++id) {
    if (measured[id]) {
      view.pixels.push_back(*measured[id] - shift[id]);
      view.points.push_back(board[id]);
    }
  }
  // A lens that fits this view so badly that it loses more than it adds must not spoil it.
  return 2 * view.pixels.size() >= first.pixels.size() ? view : first;
}

}  // namespace omnister
