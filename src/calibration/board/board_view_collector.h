// SPDX-License-Identifier: Apache-2.0
/// @file Which views of a calibration target are worth keeping, and where the next one is wanted.
/// Knows no ROS.
#pragma once

#include <opencv2/core/mat.hpp>
#include <optional>
#include <string>
#include <vector>

#include "omnister/calibration/detections.h"

namespace omnister {

struct CollectorOptions {
  double min_move = 0.02;  ///< corners of a new view lie this far from those of every other, on
                           ///< average, as a share of the image's diagonal
  double still_px = 2.0;   ///< corners moved less than this since the image before, on average [px]
  int rings = 4;           ///< of the coverage, by radius from the image's centre to its corner
  int sectors = 12;        ///< of the coverage, by angle
};

/// Looks at detections one by one. Not thread-safe.
class ViewCollector {
 public:
  enum class Verdict { kTaken, kNotFound, kMoving, kAlike };

  ViewCollector(cv::Size image_size, const CollectorOptions& options);

  /// @param found corners of this image; none: the target is not in it
  Verdict add(const cv::Mat& gray, const std::optional<ViewDetections>& found);

  const Detections& detections() const { return detections_; }
  int images() const { return images_; }

  /// Share of the cells in the image circle that hold a corner, 0 to 1. Cells that stay black in
  /// every image are outside the circle.
  double coverage() const;

  /// Where to hold the target next, for a person, e.g. "lower left, at the edge".
  std::string hint() const;

  /// The last image dimmed, covered cells tinted green, gaps red, the cell of hint() outlined, all
  /// corners kept as dots, those of the last image as circles. CV_8UC3.
  /// @param lines written into the upper left corner
  cv::Mat draw(const std::vector<std::string>& lines = {}) const;

 private:
  int cellOf(double u, double v) const;
  /// The emptiest cell; -1 while the image is black.
  int wanted() const;
  bool bright(int cell) const { return brightness_[static_cast<std::size_t>(cell)] > 12.0; }

  CollectorOptions options_;
  cv::Mat cells_;                   ///< CV_32SC1: cell of every pixel
  std::vector<double> brightness_;  ///< largest mean grey level of each cell so far
  std::vector<int> corners_;        ///< kept, by cell
  Detections detections_;
  std::optional<ViewDetections> previous_;
  cv::Mat last_image_;
  int images_ = 0;
};

/// How far the fit is from each corner that was seen: lines of `magnification` times the residual,
/// green below half a pixel, yellow below one, else red.
/// @param residuals observed less predicted [px], of each corner of each view; views without any
/// are crossed out in grey
cv::Mat drawResiduals(const Detections& detections,
                      const std::vector<std::vector<Eigen::Vector2d>>& residuals,
                      double magnification, const std::vector<std::string>& lines = {});

}  // namespace omnister
