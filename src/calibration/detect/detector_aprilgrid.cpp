// SPDX-License-Identifier: Apache-2.0
// AprilGrids. libapriltag finds quads, and the black squares that join Kalibr's tags at their
// corners merge them into one; widening the white by a pixel or two cuts them apart again.
#include <apriltag/apriltag.h>
#include <apriltag/common/zarray.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <opencv2/aruco.hpp>
#include <opencv2/imgproc.hpp>
#include <utility>

#include "calibration/detect/board_detectors.h"
#include "calibration/detect/point_refinement.h"
#include "calibration/detect/tag_alignment.h"
#include "calibration/target/tag_families.h"

namespace omnister::detect {
namespace {

std::vector<int> bordersOf(const Target& target) {
  return target.border_bits > 0 ? std::vector<int>{target.border_bits} : std::vector<int>{1, 2};
}

cv::Mat widened(const cv::Mat& image, int widen) {
  if (widen == 0) return image;
  const int size = 2 * widen + 1;
  cv::Mat wide;
  cv::dilate(image, wide, cv::getStructuringElement(cv::MORPH_RECT, {size, size}));
  return wide;
}

/// Undoes what widened() took from a dark quadrilateral. @param by [px]
void widenCorners(double by, std::vector<Eigen::Vector2d>& corners) {
  const Eigen::Vector2d middle = 0.25 * (corners[0] + corners[1] + corners[2] + corners[3]);
  for (Eigen::Vector2d& corner : corners) {
    corner += (corner - middle).normalized() * (std::sqrt(2.0) * by);
  }
}

/// Numbers and corners of the tags; where they belong is for placeAprilGrid().
std::vector<Marker> findTags(const cv::Mat& image, const Target& target, double scale, int widen) {
  const ScaledImage copy = scaled(image, scale);
  const cv::Mat searched = widened(copy.image, widen);
  std::vector<std::pair<int, tags::AprilFamily>> families;
  const std::unique_ptr<apriltag_detector_t, void (*)(apriltag_detector_t*)> detector(
      apriltag_detector_create(), apriltag_detector_destroy);
  for (const int border : bordersOf(target)) {
    families.emplace_back(border, tags::aprilFamily(target.dictionary, border));
    apriltag_detector_add_family_bits(detector.get(), families.back().second.get(), 1);
  }
  detector->nthreads = 1;
  detector->quad_decimate = 1.0f;
  image_u8_t view{searched.cols, searched.rows, static_cast<int32_t>(searched.step), searched.data};
  const std::unique_ptr<zarray_t, void (*)(zarray_t*)> detections(
      apriltag_detector_detect(detector.get(), &view), apriltag_detections_destroy);
  std::vector<Marker> markers;
  for (int i = 0; i < zarray_size(detections.get()); ++i) {
    apriltag_detection_t* detection = nullptr;
    zarray_get(detections.get(), i, &detection);
    if (detection->decision_margin < 15.0f) continue;
    Marker marker;
    marker.id = detection->id;
    for (const auto& [border, family] : families) {
      if (family.get() == detection->family) marker.border_bits = border;
    }
    // The library goes round from the bottom left and counts pixels from their edges.
    for (const int k : {3, 2, 1, 0}) {
      const cv::Point2f pixel = copy.toOriginal({static_cast<float>(detection->p[k][0] - 0.5),
                                                 static_cast<float>(detection->p[k][1] - 0.5)});
      marker.pixels.emplace_back(pixel.x, pixel.y);
    }
    if (widen > 0) widenCorners(widen / scale, marker.pixels);
    markers.push_back(marker);
  }
  return markers;
}

/// Dark quadrilaterals, whatever is in them.
std::vector<std::vector<Eigen::Vector2d>> findQuads(const cv::Mat& image, double scale, int widen) {
  const ScaledImage copy = scaled(image, scale);
  const cv::Mat searched = widened(copy.image, widen);
  auto parameters = cv::aruco::DetectorParameters::create();
  parameters->adaptiveThreshWinSizeMin = 7;
  parameters->adaptiveThreshWinSizeMax = 47;
  parameters->adaptiveThreshWinSizeStep = 20;
  parameters->minMarkerPerimeterRate =
      std::min(0.03, 24.0 * scale / std::max(copy.image.cols, copy.image.rows));
  parameters->polygonalApproxAccuracyRate = 0.08;
  parameters->minDistanceToBorder = 1;
  parameters->cornerRefinementMethod = cv::aruco::CORNER_REFINE_NONE;
  std::vector<std::vector<cv::Point2f>> accepted, rejected;
  std::vector<int> ids;
  try {
    cv::aruco::detectMarkers(searched, tags::arucoDictionary("DICT_APRILTAG_36h11"), accepted, ids,
                             parameters, rejected);
  } catch (const cv::Exception&) {
    return {};  // asserts on images too small for its filters
  }
  accepted.insert(accepted.end(), rejected.begin(), rejected.end());
  std::vector<std::vector<Eigen::Vector2d>> quads;
  for (const auto& corners : accepted) {
    auto& quad = quads.emplace_back();
    for (const cv::Point2f& corner : corners) {
      const cv::Point2f pixel = copy.toOriginal(corner);
      quad.emplace_back(pixel.x, pixel.y);
    }
    widenCorners(widen / scale, quad);
  }
  return quads;
}

/// One board has tags of one kind: those whose border most of them have, and its width.
int keepOneBorder(std::vector<Marker>& markers) {
  int balance = 0;
  for (const Marker& marker : markers) balance += marker.border_bits == 2 ? 1 : -1;
  const int border = balance > 0 ? 2 : 1;
  markers.erase(std::remove_if(markers.begin(), markers.end(),
                               [&](const Marker& marker) { return marker.border_bits != border; }),
                markers.end());
  return border;
}

/// Every tag of the board that can be told, in its place, and what kind of tags they are.
std::vector<Marker> tagsOfBoard(const GrayImage& image, Target& target, const Budget& budget) {
  const std::size_t all = static_cast<std::size_t>(target.cols) * target.rows;
  std::vector<Marker> decoded = decodeAprilGrid(image, target, budget);
  Target known = target;
  std::vector<Marker> markers;
  const auto complete = [&] {
    std::vector<Marker> one_kind = decoded;
    known.border_bits = target.border_bits > 0 ? target.border_bits : keepOneBorder(one_kind);
    markers = consistentMarkers(placeAprilGrid(one_kind, known));
    markers = growAprilGrid(image.fine, known, markers, budget);
  };
  complete();
  // What the library does not see as a quadrilateral, or cannot read.
  const double pixels = static_cast<double>(image.eight_bit.total());
  const double fitting = std::min(1.0, std::sqrt(4e6 / pixels));
  const double enlarged = pixels < 1.2e6 ? 2.0 : fitting;
  for (const auto& [scale, widen] : {std::pair{enlarged, 2}, {fitting, 1}, {enlarged, 1}}) {
    if (markers.size() >= all || budget.spent()) break;
    const std::size_t before = decoded.size();
    addNew(tellTags(image.fine, known, findQuads(image.eight_bit, scale, widen), bordersOf(target)),
           decoded);
    if (decoded.size() > before) complete();
  }
  target.border_bits = known.border_bits;
  return markers;
}

}  // namespace

std::vector<Marker> decodeAprilGrid(const GrayImage& image, const Target& target,
                                    const Budget& budget) {
  const double pixels = static_cast<double>(image.eight_bit.total());
  const double fitting = std::min(1.0, std::sqrt(4e6 / pixels));
  struct Attempt {
    double scale;
    int widen;
  };
  std::vector<Attempt> attempts{{fitting, 0}, {fitting, 1}, {fitting, 2}};
  if (target.joining_squares) attempts = {{fitting, 1}, {fitting, 2}, {fitting, 0}};
  if (pixels < 2e6) {
    attempts.push_back({2.0, 0});
    attempts.push_back({2.0, 2});
  }
  std::vector<Marker> markers;
  const std::size_t all = static_cast<std::size_t>(target.cols) * target.rows;
  for (const Attempt& attempt : attempts) {
    if (budget.spent() || markers.size() >= all) break;
    addNew(findTags(image.eight_bit, target, attempt.scale, attempt.widen), markers);
  }
  return markers;
}

std::vector<Marker> placeAprilGrid(const std::vector<Marker>& decoded, const Target& target) {
  const double pitch = target.square_m * (1.0 + target.spacing);
  std::vector<Marker> markers;
  for (Marker marker : decoded) {
    if (marker.id < 0 || marker.id >= target.cols * target.rows) continue;
    marker.cell = {marker.id % target.cols, target.rows - 1 - marker.id / target.cols};
    const Eigen::Vector2d corner(marker.cell.x() * pitch, marker.cell.y() * pitch);
    marker.board.clear();
    for (const auto& [right, down] : {std::pair{0, 0}, {1, 0}, {1, 1}, {0, 1}}) {
      marker.board.push_back(corner + target.square_m * Eigen::Vector2d(right, down));
    }
    markers.push_back(std::move(marker));
  }
  return markers;
}

std::vector<Corner> detectAprilGrid(const GrayImage& image, const Target& asked,
                                    const Budget& budget) {
  Target target = asked;
  const std::vector<Marker> markers = tagsOfBoard(image, target, budget);
  const int points_a_row = 2 * target.cols;
  Expected expected(4 * static_cast<std::size_t>(target.cols) * target.rows);
  for (const Marker& marker : markers) {
    const int first = 2 * marker.cell.y() * points_a_row + 2 * marker.cell.x();
    const int ids[4] = {first, first + 1, first + points_a_row + 1, first + points_a_row};
    for (int i = 0; i < 4; ++i) expected[ids[i]] = frameFromMarker(marker, marker.board[i]);
  }
  const Measured measured = measurePoints(image.fine, target, expected);
  std::vector<Corner> corners;
  for (std::size_t id = 0; id < measured.size(); ++id) {
    if (measured[id]) corners.push_back({static_cast<int>(id), *measured[id]});
  }
  return corners;
}

}  // namespace omnister::detect
