// SPDX-License-Identifier: Apache-2.0
/// @file From a corner found coarsely to its place in the full-size image.
#pragma once

#include <Eigen/Core>
#include <opencv2/core/mat.hpp>
#include <opencv2/core/types.hpp>
#include <optional>
#include <vector>

namespace omnister::detect {

/// Grey image to detect in and to refine in, made from an image of any depth and channel count.
struct GrayImage {
  cv::Mat eight_bit;  ///< CV_8UC1, stretched to the full range where the source is deeper
  cv::Mat fine;       ///< CV_8UC1 or CV_32FC1: the source's own steps
};

/// An empty GrayImage for an empty image.
GrayImage toGray(const cv::Mat& image);

/// Moves corners to where the edges around them meet (Foerstner's criterion, cv::cornerSubPix). A
/// window that takes in other edges, or a long stretch of bent ones, costs pixels at the rim of a
/// wide-angle image, so each corner has its own.
/// @param half_windows half side of each corner's window [px]; see halfWindow()
/// @return whether each corner stayed within its window; those that did not are where they were
std::vector<bool> refineCorners(const cv::Mat& fine, const std::vector<double>& half_windows,
                                std::vector<cv::Point2f>& corners);

/// @param clear distance from the corner to the nearest structure that is not its own [px]: for a
/// checkerboard the distance to the nearest other corner
double halfWindow(double clear);

/// A place in the picture and what the board's axes look like there.
struct LocalFrame {
  Eigen::Vector2d pixel;
  Eigen::Matrix2d jacobian;  ///< d(pixel)/d(board x, y) [px per unit of board]
};

/// Which of the four quadrants around a corner are dark, in the board's axes.
enum Quadrant : unsigned {
  kPlusPlus = 1,  ///< x > 0, y > 0
  kMinusPlus = 2,
  kMinusMinus = 4,
  kPlusMinus = 8,
};

/// Difference in grey between the quadrants that should be light and those that should be dark,
/// over the spread within them: about 0 where there is no such corner, below 0 with colours
/// swapped.
/// @param dark set of Quadrant   @param reach how far from the corner to look [units of board]
/// @return 0 when a sample lies outside the image
double cornerContrast(const cv::Mat& fine, const LocalFrame& frame, unsigned dark, double reach);

/// Grey at a place between pixels; nullopt outside the image.
std::optional<double> grayAt(const cv::Mat& fine, const Eigen::Vector2d& pixel);

}  // namespace omnister::detect
