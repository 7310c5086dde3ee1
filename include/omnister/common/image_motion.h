// SPDX-License-Identifier: Apache-2.0
/// @file How far the picture moved between two images.
#pragma once

#include <opencv2/core/mat.hpp>
#include <optional>

namespace omnister {

/// Median distance that features moved from one image to the other [px]. For motions of a few
/// pixels: what moves far is not found again, and what is left says only that it was far.
/// @param before, after CV_8UC1 of the same size
/// @return nullopt where there are too few features to tell (a blank wall), or the sizes differ
std::optional<double> imageMotion(const cv::Mat& before, const cv::Mat& after);

}  // namespace omnister
