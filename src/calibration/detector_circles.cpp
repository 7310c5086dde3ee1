// SPDX-License-Identifier: Apache-2.0
// Grids of dots, by OpenCV's blob detector and grid finder; centres are measured again at full
// size.
#include <algorithm>
#include <cmath>
#include <opencv2/calib3d.hpp>
#include <opencv2/features2d.hpp>

#include "board_detectors.h"
#include "point_refinement.h"

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

}  // namespace

std::vector<Corner> detectCircles(const GrayImage& image, const Target& target,
                                  const Budget& budget) {
  const cv::Size pattern(target.cols, target.rows);
  const auto expected_dots = static_cast<std::size_t>(pattern.area());
  std::vector<double> scales;
  for (const double pixels : {0.5e6, 1.6e6, 0.2e6, 4e6}) {
    const double scale =
        std::min(1.0, std::sqrt(pixels / static_cast<double>(image.eight_bit.total())));
    if (std::find(scales.begin(), scales.end(), scale) == scales.end()) scales.push_back(scale);
  }
  for (const double scale : scales) {
    if (budget.spent()) break;
    const ScaledImage copy = scaled(image.eight_bit, scale);
    const std::vector<cv::Point2f> dots = findDots(copy.image);
    // The finder's time grows with a high power of the number of dots.
    if (dots.size() < expected_dots || dots.size() > 4 * expected_dots + 100) continue;
    for (const int method : {0, static_cast<int>(cv::CALIB_CB_CLUSTERING)}) {
      if (budget.spent()) break;
      const int flags =
          method | (target.asymmetric ? cv::CALIB_CB_ASYMMETRIC_GRID : cv::CALIB_CB_SYMMETRIC_GRID);
      std::vector<cv::Point2f> centres;
      try {
        if (!cv::findCirclesGrid(dots, pattern, centres, flags, cv::Ptr<cv::FeatureDetector>()) ||
            centres.size() != expected_dots) {
          continue;
        }
      } catch (const cv::Exception&) {
        continue;  // it asserts where it finds no homography
      }
      for (cv::Point2f& centre : centres) centre = copy.toOriginal(centre);
      const auto ordered = orderDots(centres, target);
      if (!ordered) continue;
      Measured coarse;
      for (const cv::Point2f& centre : *ordered)
        coarse.emplace_back(Eigen::Vector2d(centre.x, centre.y));
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

}  // namespace omnister::detect
