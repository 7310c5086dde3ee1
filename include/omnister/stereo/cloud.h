// SPDX-License-Identifier: Apache-2.0
/// @file Organized clouds on the reference image's grid, and their files.
#pragma once

#include <filesystem>
#include <memory>
#include <opencv2/core/mat.hpp>

#include "omnister/common/file_io.h"
#include "omnister/lens/lens_model.h"
#include "omnister/stereo/matcher.h"

namespace omnister {

/// Row-major, one point per pixel of the reference image, in its optical frame.
struct Cloud {
  cv::Mat xyz;    ///< CV_32FC3 [m]; NaN where invalid
  cv::Mat bgr;    ///< CV_8UC3, of the reference image
  cv::Mat sigma;  ///< CV_32FC1 [m]; NaN where invalid
  cv::Mat score;  ///< CV_32FC1, 0 to 1; NaN where invalid
};

/// The unit viewing ray of every pixel, CV_32FC3; NaN outside the field. Worth keeping from frame
/// to frame. @param threads 0: every core
cv::Mat viewingRays(const LensModel& lens, cv::Size size, int threads = 0);

/// @param rays of the reference lens, as viewingRays() makes them
/// @param image the reference image, CV_8UC1 or CV_8UC3
/// @throws Error for images of different size or another type
Cloud makeCloud(const MatchResult& match, const cv::Mat& rays, const cv::Mat& image,
                int threads = 0);
Cloud makeCloud(const MatchResult& match, const LensModel& lens, const cv::Mat& image);

/// Binary little-endian PLY: `comment width W`, `comment height H`, one vertex a pixel with x y z
/// (float), red green blue (uchar), sigma score (float). Or PCD v0.7, organized, by the extension.
/// Atomic. @throws IoError, or InputError for another extension
void writeCloud(const std::filesystem::path& path, const Cloud& cloud);

/// Reads what writeCloud() wrote as PLY; every byte is accounted for.
/// @throws InputError naming the line or point, or IoError
Cloud readCloud(const std::filesystem::path& path);

/// 32-bit float TIFF, atomic. @throws IoError, or InputError for an extension other than .tif or
/// .tiff
void writeRange(const std::filesystem::path& path, const cv::Mat& range);

/// The same in two steps, for several outputs that appear together or not at all: everything is
/// written to temporary files first, then each is committed.
std::unique_ptr<AtomicFile> stageCloud(const std::filesystem::path& path, const Cloud& cloud);
std::unique_ptr<AtomicFile> stageRange(const std::filesystem::path& path, const cv::Mat& range);

/// @throws InputError unless the extension is one that writeCloud() (writeRange()) takes
void checkCloudPath(const std::filesystem::path& path);
void checkRangePath(const std::filesystem::path& path);

}  // namespace omnister
