// SPDX-License-Identifier: Apache-2.0
// AprilGrids. libapriltag finds quads, and the black squares that join Kalibr's tags at their
// corners merge them into one; widening the white by a pixel or two cuts them apart again.
#include <apriltag/apriltag.h>
#include <apriltag/common/zarray.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <opencv2/imgproc.hpp>

#include "calibration/detect/board_detectors.h"
#include "calibration/detect/point_refinement.h"
#include "calibration/target/tag_families.h"

namespace omnister::detect {
namespace {

/// Numbers and corners of the tags; where they belong is for placeAprilGrid().
std::vector<Marker> findTags(const cv::Mat& image, const Target& target, double scale, int widen) {
  const ScaledImage copy = scaled(image, scale);
  cv::Mat searched;
  if (widen == 0) {
    searched = copy.image;
  } else {
    const int size = 2 * widen + 1;
    cv::dilate(copy.image, searched, cv::getStructuringElement(cv::MORPH_RECT, {size, size}));
  }
  const tags::AprilFamily family = tags::aprilFamily(target.dictionary);
  const std::unique_ptr<apriltag_detector_t, void (*)(apriltag_detector_t*)> detector(
      apriltag_detector_create(), apriltag_detector_destroy);
  apriltag_detector_add_family_bits(detector.get(), family.get(), 1);
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
    // The library goes round from the bottom left and counts pixels from their edges.
    for (const int k : {3, 2, 1, 0}) {
      const cv::Point2f pixel = copy.toOriginal({static_cast<float>(detection->p[k][0] - 0.5),
                                                 static_cast<float>(detection->p[k][1] - 0.5)});
      marker.pixels.emplace_back(pixel.x, pixel.y);
    }
    if (widen > 0) {
      const Eigen::Vector2d middle =
          0.25 * (marker.pixels[0] + marker.pixels[1] + marker.pixels[2] + marker.pixels[3]);
      for (Eigen::Vector2d& pixel : marker.pixels) {
        pixel += (pixel - middle).normalized() * (std::sqrt(2.0) * widen / scale);
      }
    }
    markers.push_back(marker);
  }
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

std::vector<Corner> detectAprilGrid(const GrayImage& image, const Target& target,
                                    const Budget& budget) {
  const std::vector<Marker> markers =
      consistentMarkers(placeAprilGrid(decodeAprilGrid(image, target, budget), target));

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
