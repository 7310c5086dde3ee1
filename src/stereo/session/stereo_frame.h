// SPDX-License-Identifier: Apache-2.0
/// @file An image as it came, in whatever form it came.
#pragma once

#include <cstdint>
#include <memory>
#include <opencv2/core/mat.hpp>
#include <string>

namespace omnister {

/// One image of a set. The session takes 8-bit pictures of it; who made it can take the rest.
class StereoFrame {
 public:
  virtual ~StereoFrame() = default;

  /// @param expected [px]  @param name of the image stream, for messages
  /// @throws InputError for an image of another size, or no picture
  virtual void check(cv::Size expected, const std::string& name) const = 0;
  virtual std::int64_t stampNs() const = 0;  ///< since the epoch [ns]
  /// Bits that the brightest sample needs: 8 for 8-bit images, 9 to 16 for 16-bit ones.
  virtual int significantBits() const = 0;
  virtual bool isGray() const = 0;  ///< has no colors
  /// CV_8UC1; 16-bit samples are divided by 2^(bits - 8).
  /// @param bits the same for all images of a set  @throws InputError
  virtual cv::Mat gray(int bits) const = 0;
  virtual cv::Mat bgr(int bits) const = 0;  ///< CV_8UC3; else as gray()
};
using StereoFramePtr = std::shared_ptr<const StereoFrame>;

}  // namespace omnister
