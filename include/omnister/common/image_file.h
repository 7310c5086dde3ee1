// SPDX-License-Identifier: Apache-2.0
/// @file Images from files of unknown quality, and images written whole or not at all.
#pragma once

#include <cstddef>
#include <filesystem>
#include <memory>
#include <opencv2/core/mat.hpp>

#include "omnister/common/file_io.h"

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

/// From now on nothing gets to standard error while readImage() decodes, one image at a time: image
/// libraries print there what its error says too. A JPEG that they say ends too soon is refused.
/// For a program whose standard error is for a person alone; what other threads write there
/// meanwhile is lost.
void silenceDecoders();

/// Writes by the extension: PNG, JPEG, TIFF, BMP, PGM or PPM. Atomic.
/// @throws IoError; InputError for another extension or a depth that the format cannot hold
void writeImage(const std::filesystem::path& path, const cv::Mat& image);

/// The same up to commit(), for several outputs that appear together or not at all.
std::unique_ptr<AtomicFile> stageImage(const std::filesystem::path& path, const cv::Mat& image);

/// @throws InputError unless the extension is one that writeImage() takes
void checkImagePath(const std::filesystem::path& path);

}  // namespace omnister
