// SPDX-License-Identifier: Apache-2.0
/// @file Reference and displaced image side by side, with what the matcher does for some pixels
/// drawn on them.
#pragma once

#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

#include "omnister/stereo/matcher.h"

namespace omnister {

/// Reads "u v; u v; …". @param source what the message names when it is refused
/// @throws InputError for anything but pairs of finite numbers, or more than 64 of them
std::vector<cv::Point2d> parsePixels(const std::string& text, const std::string& source);

/// The middle of the image and four pixels around it.
std::vector<cv::Point2d> defaultPixels(cv::Size size);

/// For each pixel, in a colour of its own. On the displaced image (right): its epipolar curve
/// between the search limits, a square at the near end and a ring at the far end, and a cross where
/// it was matched. On the reference image (left): the pixel, and the curve of its match the other
/// way. Beside the pixel: range, standard deviation and score, or why there is none.
/// @param reference, displaced CV_8UC3; the first displaced image of the geometry
/// @param result of the same pair
/// @return CV_8UC3, as wide as both images and as high as the higher one
/// @throws Error for images that do not belong to the geometry
cv::Mat drawEpipolarOverlay(const cv::Mat& reference, const cv::Mat& displaced,
                            const StereoGeometry& geometry, const MatcherOptions& options,
                            const MatchResult& result, const std::vector<cv::Point2d>& pixels);

}  // namespace omnister
