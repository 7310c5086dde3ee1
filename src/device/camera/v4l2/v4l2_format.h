// SPDX-License-Identifier: Apache-2.0
/// @file Pixel formats by their V4L2 codes, and what becomes of a buffer of them.
#pragma once

#include <cstddef>
#include <cstdint>

#include "omnister/device/camera.h"

namespace omnister::device {

enum class V4l2Coding { kPlain, kYuyv, kUyvy, kNv12, kJpeg };

struct V4l2Format {
  std::uint32_t fourcc;
  const char* encoding;  ///< what frames say
  int type;              ///< of the frame's cv::Mat
  V4l2Coding coding;
};

/// @return nullptr for a format that is not known
const V4l2Format* findV4l2Format(std::uint32_t fourcc);

/// The image and memory of a frame from a buffer of the driver's.
/// @param step bytes from row to row  @param pool gives the memory of what is only copied
/// @return false for what is no whole image of that size
bool decodeV4l2(const V4l2Format& format, const std::uint8_t* data, std::size_t bytes,
                const cv::Size& size, std::size_t step, FramePool* pool, Frame* frame);

}  // namespace omnister::device
