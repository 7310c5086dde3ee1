// SPDX-License-Identifier: Apache-2.0
/// @file The bright disc that a wide-angle lens leaves on a sensor larger than its image.
#pragma once

#include <Eigen/Core>
#include <opencv2/core/mat.hpp>
#include <optional>
#include <vector>

namespace omnister {

struct ImageCircle {
  Eigen::Vector2d center = Eigen::Vector2d::Zero();  ///< [px]
  double radius = 0.0;                               ///< [px], where the picture has faded half way
};

/// Looks for a disc beyond which all pictures are black: the corners of the image must be dark
/// (those that the disc does not reach; at least two), and the edge of what is bright must lie on
/// one circle. The brightest of all pictures counts at each pixel, so that a dark scene is not
/// taken for the surround; one picture of a well-lit scene does.
/// @param images of one size, any depth and channel count
/// @return nullopt where the picture fills the image, or what is dark is not round
std::optional<ImageCircle> findImageCircle(const std::vector<cv::Mat>& images);

/// 255 inside the circle less a rim of `rim` pixels, 0 outside. CV_8UC1.
cv::Mat circleMask(const ImageCircle& circle, cv::Size size, double rim);

}  // namespace omnister
