// SPDX-License-Identifier: Apache-2.0
/// @file Organized clouds on the reference image's grid, and their files.
#pragma once

#include <filesystem>
#include <opencv2/core/mat.hpp>

#include "omnister/lens/lens_model.h"
#include "omnister/stereo/matcher.h"

namespace omnister {

/// Row-major, one point per pixel of the reference image, in its optical frame.
struct Cloud {
  cv::Mat xyz;      ///< CV_32FC3 [m]; NaN where invalid
  cv::Mat bgr;      ///< CV_8UC3, of the reference image
  cv::Mat sigma;    ///< CV_32FC1 [m]
  cv::Mat score;    ///< CV_32FC1, 0 to 1
};

/// @param image the reference image, CV_8UC1 or CV_8UC3
Cloud makeCloud(const MatchResult& match, const LensModel& lens, const cv::Mat& image);

/// Binary little-endian PLY: `comment width W`, `comment height H`, one vertex a pixel with x y z
/// (float), red green blue (uchar), sigma score (float). Or PCD v0.7, organized, by the extension.
/// Atomic. @throws IoError, or InputError for another extension
void writeCloud(const std::filesystem::path& path, const Cloud& cloud);

/// Reads what writeCloud() wrote as PLY. @throws InputError
Cloud readCloud(const std::filesystem::path& path);

/// 32-bit float TIFF, atomic. @throws IoError
void writeRange(const std::filesystem::path& path, const cv::Mat& range);

}  // namespace omnister
