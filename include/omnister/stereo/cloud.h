// SPDX-License-Identifier: Apache-2.0
/// @file Organized clouds on the reference image's grid, and their files.
#pragma once

#include <filesystem>
#include <memory>
#include <opencv2/core/mat.hpp>
#include <string>
#include <string_view>
#include <vector>

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

/// Makes clouds of one lens, frame after frame, without a ray for every pixel in memory: rays are
/// kept at every eighth pixel and interpolated between, to 1e-6 rad; where that would
/// not do, and where the field ends, every pixel's is kept.
class PointMaker {
 public:
  /// @param threads 0: every core
  PointMaker(const LensModel& lens, cv::Size size, int threads = 0);

  /// The same as makeCloud().
  Cloud make(const MatchResult& match, const cv::Mat& image, int threads = 0) const;

  /// Pixels inside the field of the lens and, if it is not empty, not 0 in the mask.
  /// @param mask CV_8UC1 of the size given before
  std::size_t countField(const cv::Mat& mask = {}) const;

  /// Rays of a row, NaN outside the field. @param nodes scratch
  void row(int v, std::vector<cv::Vec3f>& nodes, cv::Vec3f* rays) const;

 private:
  cv::Size size_;
  cv::Size cells_;                 // of 8 x 8 pixels
  cv::Mat nodes_;                  // CV_32FC3, one node before and two after the cells
  std::vector<int> exact_offset_;  // by cell: where its 64 rays are in exact_, -1 if interpolated
  std::vector<cv::Vec3f> exact_;
};

/// Binary little-endian PLY: `comment width W`, `comment height H`, one vertex a pixel with x y z
/// (float), red green blue (uchar), sigma score (float). Or PCD v0.7, organized, by the extension.
/// Atomic. @throws IoError, or InputError for another extension
void writeCloud(const std::filesystem::path& path, const Cloud& cloud);

/// Reads what writeCloud() wrote as PLY; every byte is accounted for.
/// @throws InputError naming the line or point, or IoError
Cloud readCloud(const std::filesystem::path& path);

/// The same for bytes in memory. @param source for messages
Cloud parseCloud(std::string_view bytes, const std::string& source);

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
