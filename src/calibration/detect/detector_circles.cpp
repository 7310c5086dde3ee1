// SPDX-License-Identifier: Apache-2.0
// Grids of dots, by OpenCV's blob detector and grid finder; centres are measured again at full
// size.
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <opencv2/calib3d.hpp>
#include <opencv2/features2d.hpp>

#include "calibration/detect/board_detectors.h"
#include "calibration/detect/point_refinement.h"

namespace omnister::detect {
namespace {

std::vector<cv::Point2f> findDots(const cv::Mat& image) {
  cv::SimpleBlobDetector::Params parameters;
  parameters.minThreshold = 20;
  parameters.maxThreshold = 235;
  parameters.thresholdStep = 12;
  parameters.minArea = 12;
  parameters.maxArea = 0.01f * static_cast<float>(image.total());
  parameters.minDistBetweenBlobs = 4;
  parameters.filterByConvexity = true;
  parameters.minConvexity = 0.85f;
  parameters.filterByInertia = true;
  parameters.minInertiaRatio = 0.05f;
  parameters.filterByCircularity = false;
  std::vector<cv::KeyPoint> blobs;
  cv::SimpleBlobDetector::create(parameters)->detect(image, blobs);
  std::vector<cv::Point2f> dots;
  for (const cv::KeyPoint& blob : blobs) dots.push_back(blob.pt);
  return dots;
}

// Dots of a row are in order along it, and so are the rows; brings them into the order of the
// target.
std::optional<std::vector<cv::Point2f>> orderDots(std::vector<cv::Point2f> dots,
                                                  const Target& target) {
  if (!target.asymmetric) return orderGrid(dots, target, nullptr);
  const int cols = target.cols;
  const int rows = target.rows;
  const auto handed = [&](double sign) {
    for (int row = 0; row + 2 < rows; ++row) {
      for (int col = 0; col + 1 < cols; ++col) {
        const int id = row * cols + col;
        const cv::Point2f right = dots[id + 1] - dots[id];
        const cv::Point2f down = dots[id + 2 * cols] - dots[id];
        if (!(sign * (double{right.x} * down.y - double{right.y} * down.x) > 0.0)) return false;
      }
    }
    return rows > 2;
  };
  if (handed(-1.0) && rows % 2 == 1) {
    // Mirrored top to bottom an odd number of rows keeps its shifts.
    for (int row = 0; row < rows / 2; ++row) {
      std::swap_ranges(dots.begin() + row * cols, dots.begin() + (row + 1) * cols,
                       dots.begin() + (rows - 1 - row) * cols);
    }
  }
  if (!handed(1.0)) return std::nullopt;
  if (rows % 2 == 0) {
    const cv::Point2f along = dots[cols - 1] - dots[0];
    if (0.9 * along.x + 0.436 * along.y < 0.0) std::reverse(dots.begin(), dots.end());
  }
  return dots;
}

// The dots as a pinhole camera turned towards them would see them, through an equidistant fisheye
// of the given half field over the longer side. Rough as that is, it straightens rows enough for
// the finder, which follows only those that a homography can make straight.
std::optional<std::vector<cv::Point2f>> flattened(const std::vector<cv::Point2f>& dots,
                                                  const cv::Size& size, double half_field) {
  const double focal = 0.5 * std::max(size.width, size.height) / half_field;
  const Eigen::Vector2d middle(0.5 * size.width, 0.5 * size.height);
  std::vector<Eigen::Vector3d> rays;
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (const cv::Point2f& dot : dots) {
    const Eigen::Vector2d off = Eigen::Vector2d(dot.x, dot.y) - middle;
    const double angle = off.norm() / focal;
    const Eigen::Vector2d side = off.normalized() * std::sin(angle);
    rays.emplace_back(side.x(), side.y(), std::cos(angle));
    sum += rays.back();
  }
  const Eigen::Quaterniond turn = Eigen::Quaterniond::FromTwoVectors(sum, Eigen::Vector3d::UnitZ());
  std::vector<cv::Point2f> flat;
  for (const Eigen::Vector3d& ray : rays) {
    const Eigen::Vector3d seen = turn * ray;
    if (seen.z() < 0.1) return std::nullopt;
    flat.emplace_back(static_cast<float>(focal * seen.x() / seen.z()),
                      static_cast<float>(focal * seen.y() / seen.z()));
  }
  return flat;
}

// Indices of the dots of the grid, row by row.
std::vector<std::size_t> findGrid(const std::vector<cv::Point2f>& dots, const Target& target,
                                  int flags) {
  const cv::Size pattern(target.cols, target.rows);
  std::vector<cv::Point2f> centres;
  try {
    if (!cv::findCirclesGrid(dots, pattern, centres, flags, cv::Ptr<cv::FeatureDetector>()) ||
        centres.size() != static_cast<std::size_t>(pattern.area())) {
      return {};
    }
  } catch (const cv::Exception&) {
    return {};  // it asserts where it finds no homography
  }
  std::vector<std::size_t> indices;
  for (const cv::Point2f& centre : centres) {
    const auto nearest =
        std::min_element(dots.begin(), dots.end(), [&](const cv::Point2f& a, const cv::Point2f& b) {
          return cv::norm(a - centre) < cv::norm(b - centre);
        });
    indices.push_back(nearest - dots.begin());
  }
  std::vector<std::size_t> sorted = indices;
  std::sort(sorted.begin(), sorted.end());
  if (std::adjacent_find(sorted.begin(), sorted.end()) != sorted.end()) return {};
  return indices;
}

// The dots of the grid, row by row in the order of the target, in pixels of the whole image;
// nothing where they are not there.
std::optional<std::vector<cv::Point2f>> gridOfDots(const ScaledImage& copy,
                                                   const std::vector<cv::Point2f>& dots,
                                                   const Target& target, const Budget& budget,
                                                   const std::vector<double>& half_fields,
                                                   std::size_t* next) {
  const int grid = target.asymmetric ? cv::CALIB_CB_ASYMMETRIC_GRID : cv::CALIB_CB_SYMMETRIC_GRID;
  constexpr int kMethods[] = {0, static_cast<int>(cv::CALIB_CB_CLUSTERING)};
  while (*next < 2 * half_fields.size() && !budget.spent()) {
    const double half_field = half_fields[*next / 2];
    const int method = kMethods[*next % 2];
    ++*next;
    const auto seen =
        half_field > 0.0 ? flattened(dots, copy.image.size(), half_field) : std::optional(dots);
    if (!seen) continue;
    std::vector<cv::Point2f> centres;
    for (const std::size_t index : findGrid(*seen, target, grid | method)) {
      centres.push_back(copy.toOriginal(dots[index]));
    }
    if (centres.empty()) continue;
    if (auto ordered = orderDots(centres, target)) return ordered;
  }
  return std::nullopt;
}

// Whether the rows or columns go on beside the grid: then it is part of a larger board, and which
// part nothing tells.
bool goesOn(const std::vector<cv::Point2f>& grid, const Target& target,
            const std::vector<cv::Point2f>& dots) {
  const int cols = target.cols;
  const int rows = target.rows;
  const auto at = [&](int col, int row) { return grid[row * cols + col]; };
  // A dot near where the step from `inner` to `edge`, taken from `from`, leads.
  const auto follows = [&](cv::Point2f from, cv::Point2f edge, cv::Point2f inner) {
    const cv::Point2f next = from + (edge - inner);
    const double near = 0.3 * cv::norm(next - edge);
    return std::any_of(dots.begin(), dots.end(),
                       [&](const cv::Point2f& dot) { return cv::norm(dot - next) < near; });
  };
  // Rows of an asymmetric grid repeat every other.
  const int shift = target.asymmetric ? 1 : 0;
  int counts[4] = {0, 0, 0, 0};
  for (int col = 0; col < cols; ++col) {
    counts[0] += follows(at(col, shift), at(col, 0), at(col, 1 + shift));
    counts[1] += follows(at(col, rows - 1 - shift), at(col, rows - 1), at(col, rows - 2 - shift));
  }
  for (int row = 0; row < rows; ++row) {
    counts[2] += follows(at(0, row), at(0, row), at(1, row));
    counts[3] += follows(at(cols - 1, row), at(cols - 1, row), at(cols - 2, row));
  }
  return 3 * std::max(counts[0], counts[1]) >= 2 * cols ||
         3 * std::max(counts[2], counts[3]) >= 2 * rows;
}

// Half fields over the longer side to undo, 0 for the dots as they are.
const std::vector<double> kHalfFields = {0.0, 1.6, 1.2, 0.8};

std::vector<double> searchScales(const cv::Mat& image) {
  std::vector<double> scales;
  for (const double pixels : {0.5e6, 1.6e6, 0.2e6, 4e6}) {
    const double scale = std::min(1.0, std::sqrt(pixels / static_cast<double>(image.total())));
    if (std::find(scales.begin(), scales.end(), scale) == scales.end()) scales.push_back(scale);
  }
  return scales;
}

}  // namespace

std::vector<Corner> detectCircles(const GrayImage& image, const Target& target,
                                  const Budget& budget) {
  const std::size_t expected_dots = static_cast<std::size_t>(target.cols) * target.rows;
  for (const double scale : searchScales(image.eight_bit)) {
    if (budget.spent()) break;
    const ScaledImage copy = scaled(image.eight_bit, scale);
    const std::vector<cv::Point2f> dots = findDots(copy.image);
    // The finder's time grows with a high power of the number of dots.
    if (dots.size() < expected_dots || dots.size() > 4 * expected_dots + 100) continue;
    std::vector<cv::Point2f> seen;
    for (const cv::Point2f& dot : dots) seen.push_back(copy.toOriginal(dot));
    std::size_t next = 0;
    while (const auto ordered = gridOfDots(copy, dots, target, budget, kHalfFields, &next)) {
      if (goesOn(*ordered, target, seen)) return {};
      Measured coarse;
      for (const cv::Point2f& c : *ordered) coarse.emplace_back(Eigen::Vector2d(c.x, c.y));
      const Measured measured = measurePoints(image.fine, target, framesFromGrid(coarse, target));
      std::vector<Corner> corners;
      for (std::size_t id = 0; id < measured.size(); ++id) {
        if (measured[id]) corners.push_back({static_cast<int>(id), *measured[id]});
      }
      if (10 * corners.size() >= 9 * expected_dots) return corners;
    }
  }
  return {};
}

std::optional<cv::Size> circlesSize(const GrayImage& image, const Target& like,
                                    const Budget& budget) {
  constexpr int kLeast = 3;
  constexpr int kStray = 3;  // dots beside the board
  for (const double scale : searchScales(image.eight_bit)) {
    const ScaledImage copy = scaled(image.eight_bit, scale);
    const std::vector<cv::Point2f> dots = findDots(copy.image);
    const int count = static_cast<int>(dots.size());
    if (count > 1000) continue;
    for (int total = count; total >= std::max(count - kStray, kLeast * kLeast); --total) {
      // From the squarest on: a symmetric grid is the same either way.
      for (int rows = static_cast<int>(std::sqrt(total)); rows >= kLeast; --rows) {
        if (total % rows != 0) continue;
        for (const cv::Size size : {cv::Size(total / rows, rows), cv::Size(rows, total / rows)}) {
          if (budget.spent()) return std::nullopt;
          Target candidate = like;
          candidate.cols = size.width;
          candidate.rows = size.height;
          std::size_t next = 0;
          if (gridOfDots(copy, dots, candidate, budget, kHalfFields, &next)) return size;
          if (!like.asymmetric) break;
        }
      }
    }
  }
  return std::nullopt;
}

}  // namespace omnister::detect
