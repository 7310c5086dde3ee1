// SPDX-License-Identifier: Apache-2.0
/// @file What of an image is matched, and in which size.
#pragma once

#include <opencv2/core/mat.hpp>
#include <string>
#include <string_view>

namespace omnister {

/// "x,y,width,height" of whole pixels inside an image; empty text is an empty rectangle.
/// @param source what a message names, e.g. "--roi"  @throws Error for anything else
cv::Rect parseRegion(std::string_view text, cv::Size size, const std::string& source);

/// Means over squares of pixels, the image that reducedLens() is for; what is left over at the
/// right and below is cut off. @param factor 1: the image itself
cv::Mat reducedImage(const cv::Mat& image, int factor);

/// A mask as matchers take it: 0 where `mask` is 0, outside the region, and where any part of a
/// reduced pixel is. Empty where everything is matched.
/// @param mask CV_8UC1 of the full size, may be empty  @param region empty: all
/// @param size of the full image
cv::Mat matchingMask(const cv::Mat& mask, const cv::Rect& region, cv::Size size, int factor);

}  // namespace omnister
