// SPDX-License-Identifier: Apache-2.0
// ChArUco boards. OpenCV's own interpolation of the corners takes the board for a plane seen by a
// pinhole and loses a quarter of them through a wide-angle lens, so each corner is predicted from
// the markers right beside it, where any lens is nearly flat, and then refined on its own.
#include <algorithm>
#include <opencv2/aruco.hpp>
#include <opencv2/core.hpp>

#include "calibration/detect/board_detectors.h"
#include "calibration/detect/point_refinement.h"
#include "calibration/target/tag_families.h"

namespace omnister::detect {
namespace {

/// Numbers and corners of the markers; where they belong is for placeCharuco().
std::vector<Marker> findMarkers(const cv::Mat& image, const Target& target, double scale) {
  const ScaledImage copy = scaled(image, scale);
  auto parameters = cv::aruco::DetectorParameters::create();
  parameters->adaptiveThreshWinSizeMin = 5;
  parameters->adaptiveThreshWinSizeMax = 45;
  parameters->adaptiveThreshWinSizeStep = 10;
  // Markers at the rim are small and their sides bent.
  parameters->minMarkerPerimeterRate =
      std::min(0.03, 28.0 / std::max(copy.image.cols, copy.image.rows));
  parameters->polygonalApproxAccuracyRate = 0.05;
  parameters->minDistanceToBorder = 1;
  parameters->cornerRefinementMethod = cv::aruco::CORNER_REFINE_NONE;
  std::vector<std::vector<cv::Point2f>> quads;
  std::vector<int> ids;
  try {
    cv::aruco::detectMarkers(copy.image, tags::arucoDictionary(target.dictionary), quads, ids,
                             parameters);
  } catch (const cv::Exception&) {
    return {};  // asserts on images too small for its filters
  }
  std::vector<Marker> markers;
  for (std::size_t i = 0; i < ids.size(); ++i) {
    Marker marker;
    marker.id = ids[i];
    for (const cv::Point2f& quad : quads[i]) {
      const cv::Point2f pixel = copy.toOriginal(quad);
      marker.pixels.emplace_back(pixel.x, pixel.y);
    }
    markers.push_back(marker);
  }
  return markers;
}

// Corners that touch no decoded marker, from the refined ones beside them.
void extrapolate(const Measured& measured, const Target& target, Expected& expected) {
  const Expected frames = framesFromGrid(measured, target);
  const Eigen::Vector2i grid = targetGrid(target);
  const std::vector<Eigen::Vector3d> board = targetPoints(target);
  for (int id = 0; id < grid.prod(); ++id) {
    expected[id].reset();
    if (measured[id]) continue;
    LocalFrame sum{Eigen::Vector2d::Zero(), Eigen::Matrix2d::Zero()};
    int count = 0;
    for (const auto& [right, down] : {std::pair{1, 0}, {-1, 0}, {0, 1}, {0, -1}}) {
      const int col = id % grid.x() + right;
      const int row = id / grid.x() + down;
      if (col < 0 || row < 0 || col >= grid.x() || row >= grid.y()) continue;
      const auto& frame = frames[row * grid.x() + col];
      if (!frame) continue;
      const Eigen::Vector2d step = (board[id] - board[row * grid.x() + col]).head<2>();
      sum.pixel += frame->pixel + frame->jacobian * step;
      sum.jacobian += frame->jacobian;
      ++count;
    }
    if (count > 0) expected[id] = LocalFrame{sum.pixel / count, sum.jacobian / count};
  }
}

}  // namespace

std::vector<Marker> decodeCharuco(const GrayImage& image, const Target& target,
                                  const Budget& budget) {
  const double pixels = static_cast<double>(image.eight_bit.total());
  std::vector<Marker> markers;
  // Full size for the small markers; the larger ones of big images are found in a copy; enlarged
  // when little was found.
  const double fitting = std::min(1.0, std::sqrt(4e6 / pixels));
  for (const double scale : {fitting, 0.5 * fitting, 2.0}) {
    const bool enlarged = scale > 1.0;
    const std::size_t all = tags::charucoMarkers(target).size();
    if (budget.spent() || markers.size() >= all || (enlarged && pixels > 2e6)) break;
    addNew(findMarkers(image.eight_bit, target, scale), markers);
  }
  return markers;
}

std::vector<Marker> placeCharuco(const std::vector<Marker>& decoded, const Target& target) {
  const auto cells = tags::charucoMarkers(target);
  const double side = target.square_m;
  const double inset = 0.5 * (side - target.marker_m);
  std::vector<Marker> markers;
  for (Marker marker : decoded) {
    if (marker.id < 0 || marker.id >= static_cast<int>(cells.size())) continue;
    marker.cell = cells[static_cast<std::size_t>(marker.id)];
    const Eigen::Vector2d corner(marker.cell.x() * side - side + inset,
                                 marker.cell.y() * side - side + inset);
    marker.board.clear();
    for (const auto& [right, down] : {std::pair{0, 0}, {1, 0}, {1, 1}, {0, 1}}) {
      marker.board.push_back(corner + target.marker_m * Eigen::Vector2d(right, down));
    }
    markers.push_back(std::move(marker));
  }
  return markers;
}

std::vector<Corner> detectCharuco(const GrayImage& image, const Target& target,
                                  const Budget& budget) {
  const std::vector<Marker> markers =
      consistentMarkers(placeCharuco(decodeCharuco(image, target, budget), target));

  const std::vector<Eigen::Vector3d> board = targetPoints(target);
  Expected expected(board.size());
  const Eigen::Vector2i grid = targetGrid(target);
  for (std::size_t id = 0; id < board.size(); ++id) {
    LocalFrame sum{Eigen::Vector2d::Zero(), Eigen::Matrix2d::Zero()};
    int count = 0;
    for (const Marker& marker : markers) {
      const Eigen::Vector2i corner(static_cast<int>(id) % grid.x(),
                                   static_cast<int>(id) / grid.x());
      const Eigen::Vector2i off =
          corner - marker.cell;  // -1 or 0 for the squares around the corner
      if (off.minCoeff() < -1 || off.maxCoeff() > 0) continue;
      if (const auto frame = frameFromMarker(marker, board[id].head<2>())) {
        sum.pixel += frame->pixel;
        sum.jacobian += frame->jacobian;
        ++count;
      }
    }
    if (count > 0) expected[id] = LocalFrame{sum.pixel / count, sum.jacobian / count};
  }
  Measured measured = measurePoints(image.fine, target, expected);
  for (int round = 0; round < 2; ++round) {
    extrapolate(measured, target, expected);
    const Measured more = measurePoints(image.fine, target, expected);
    for (std::size_t id = 0; id < more.size(); ++id) {
      if (more[id]) measured[id] = more[id];
    }
  }
  std::vector<Corner> corners;
  for (std::size_t id = 0; id < measured.size(); ++id) {
    if (measured[id]) corners.push_back({static_cast<int>(id), *measured[id]});
  }
  return corners;
}

}  // namespace omnister::detect
