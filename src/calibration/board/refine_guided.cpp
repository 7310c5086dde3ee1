// SPDX-License-Identifier: Apache-2.0
#include <Eigen/Dense>
#include <algorithm>
#include <cmath>

#include "calibration/detect/point_refinement.h"
#include "calibration/fit/board_pose.h"
#include "omnister/calibration/detector.h"
#include "omnister/common/error.h"
#include "omnister/common/pose.h"

namespace omnister {
namespace {

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
  const auto found = calibration::boardPose(first, lens);
  if (!found) return first;  // outside the lens' field or on one line: nothing to predict from
  const Pose& pose = *found;

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
