// SPDX-License-Identifier: Apache-2.0
/// @file Images from files of unknown quality.
#pragma once

#include <cstddef>
#include <filesystem>
#include <opencv2/core/mat.hpp>

namespace omnister {

enum class ImageColor { kGray, kColor, kAsIs };

/// Reads PNG, JPEG, TIFF, BMP or PGM/PPM at the file's own depth, its pixels as the sensor gave
/// them (an EXIF orientation is not applied). The size stands in the header and is checked before
/// anything is decoded.
/// @param max_pixels larger images are refused
/// @throws IoError; InputError naming the file for another format, a damaged or cut-off file, or an
/// image that is too large
cv::Mat readImage(const std::filesystem::path& path, ImageColor color = ImageColor::kAsIs,
                  std::size_t max_pixels = 100'000'000);

}  // namespace omnister
