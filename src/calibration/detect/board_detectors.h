// SPDX-License-Identifier: Apache-2.0
/// @file One detector a type of board. All give full-size pixels without half-pixel bias.
#pragma once

#include <cstddef>
#include <optional>
#include <vector>

#include "calibration/detect/corner_refinement.h"
#include "calibration/detect/point_refinement.h"
#include "omnister/calibration/target.h"

namespace omnister::detect {

/// The time that one image may take, checked between attempts because the detectors of OpenCV
/// cannot be interrupted. Counts the thread's own processor time, so that a busy machine finds the
/// same boards.
class Budget {
 public:
  explicit Budget(double seconds);
  bool spent() const { return left() <= 0.0; }
  double left() const;  ///< [s]

 private:
  double end_;
};

struct Corner {
  int id;  ///< index into targetPoints()
  Eigen::Vector2d pixel;
};

std::vector<Corner> detectCheckerboard(const GrayImage& image, const Target& target,
                                       const Budget& budget);
/// Columns and rows of inner corners of whatever checkerboard is seen, the larger first.
std::optional<cv::Size> checkerboardSize(const GrayImage& image);
std::vector<Corner> detectCircles(const GrayImage& image, const Target& target,
                                  const Budget& budget);
/// Columns and rows of whatever grid of dots is seen, symmetric or not as `like` is.
std::optional<cv::Size> circlesSize(const GrayImage& image, const Target& like,
                                    const Budget& budget);
std::vector<Corner> detectCharuco(const GrayImage& image, const Target& target,
                                  const Budget& budget);
std::vector<Corner> detectAprilGrid(const GrayImage& image, const Target& target,
                                    const Budget& budget);

/// Markers of a board's dictionary, wherever they are: `id` and `pixels` alone.
std::vector<Marker> decodeCharuco(const GrayImage& image, const Target& target,
                                  const Budget& budget);
std::vector<Marker> decodeAprilGrid(const GrayImage& image, const Target& target,
                                    const Budget& budget);
/// Their places on the board; those that it does not have are dropped.
std::vector<Marker> placeCharuco(const std::vector<Marker>& decoded, const Target& target);
std::vector<Marker> placeAprilGrid(const std::vector<Marker>& decoded, const Target& target);

/// A copy of the image with at most `max_pixels`, and how pixels of the copy map back.
struct ScaledImage {
  cv::Mat image;
  double scale_x = 1.0;  ///< pixels of the copy per pixel of the original
  double scale_y = 1.0;

  /// Pixel centres are whole numbers in both, hence the halves.
  cv::Point2f toOriginal(const cv::Point2f& pixel) const {
    return {static_cast<float>((pixel.x + 0.5) / scale_x - 0.5),
            static_cast<float>((pixel.y + 0.5) / scale_y - 0.5)};
  }
};
ScaledImage scaled(const cv::Mat& image, double scale);

/// Brings a full grid of points, found row by row in some order, into the order of targetPoints():
/// never mirrored, colours as the target says where they tell, else x to the right or down. Nothing
/// for a grid that folds over itself or (checkerboards) whose squares do not alternate.
/// @param fine image for the colours of the squares; null for dots
std::optional<std::vector<cv::Point2f>> orderGrid(const std::vector<cv::Point2f>& points,
                                                  const Target& target, const cv::Mat* fine);

/// Distance of every point of a full grid to its nearest neighbour [px].
std::vector<double> gridSpacing(const std::vector<cv::Point2f>& points, int cols, int rows);

}  // namespace omnister::detect
