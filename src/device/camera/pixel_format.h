// SPDX-License-Identifier: Apache-2.0
/// @file Pixel formats by their GenICam names (PFNC), and what becomes of them in a frame.
#pragma once

#include <cstddef>
#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

namespace omnister::device {

enum class Packing {
  kPlain,   ///< one sample after the other, 8 or 16 bit, little-endian
  kLsb10,   ///< PFNC "10p": 4 samples in 5 bytes, lowest bits first
  kLsb12,   ///< PFNC "12p": 2 samples in 3 bytes, lowest bits first
  kGige10,  ///< GigE Vision "10Packed": 2 samples in 3 bytes, high bits in the outer bytes
  kGige12,  ///< GigE Vision "12Packed"
  kYuyv,    ///< 4:2:2, Y U Y V
  kUyvy,    ///< 4:2:2, U Y V Y
  kUyv,     ///< 4:4:4, U Y V
};

struct PixelFormat {
  std::uint32_t code;    ///< PFNC value
  const char* name;      ///< PFNC name
  const char* encoding;  ///< what frames say: mono8, mono16, bayer_rggb8, rgb8, bgr8, …
  int type;              ///< of the frame's cv::Mat
  Packing packing;
  int bits;  ///< significant bits of a sample; 10 to 14 become 16 by a shift to the left

  /// A frame is the device's own bytes.
  bool direct() const { return packing == Packing::kPlain && (bits == 8 || bits == 16); }
  int bitsPerPixel() const { return static_cast<int>((code >> 16) & 0xff); }
};

/// @return nullptr for a format that is not known
const PixelFormat* findPixelFormat(std::uint32_t code);
const PixelFormat* findPixelFormat(const std::string& name);

/// A frame's pixels from the device's bytes.
/// @param step bytes from row to row
cv::Mat unpack(const PixelFormat& format, const std::uint8_t* data, cv::Size size,
               std::size_t step);

}  // namespace omnister::device
