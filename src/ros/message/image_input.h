// SPDX-License-Identifier: Apache-2.0
/// @file Image messages from anyone to 8-bit images for matching and detecting.
#pragma once

#include <sensor_msgs/Image.h>

#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <string>

namespace omnister {

/// Refuses an image message that cannot be what it says, beyond checkImage(): no stamp, no
/// frame_id, no picture of 8 or 16 bits, or another size than expected.
/// @param expected [px]; empty: any size
/// @throws InputError naming the topic and what is wrong
void checkFrame(const sensor_msgs::Image& image, cv::Size expected, const std::string& topic);

/// How many bits the brightest sample needs: 8 for 8-bit images, 9 to 16 for 16-bit ones (cameras
/// leave the upper bits empty).
int significantBits(const sensor_msgs::Image& image);

/// CV_8UC1. Bayer is debayered, colour turned to grey; 16-bit samples are divided by 2^(bits - 8).
/// @param bits from significantBits(), the same for all images of a set
/// @throws InputError for an encoding that is no picture (32FC1, say)
cv::Mat toGray(const sensor_msgs::Image& image, int bits);

/// CV_8UC3, BGR; else as toGray().
cv::Mat toBgr(const sensor_msgs::Image& image, int bits);

/// Tells how many messages of a publisher did not reach us, by the numbers in their headers: queues
/// on the way drop without a word.
class MissingMessages {
 public:
  /// @return how many are missing between the message before and this one; 0 for the first, for
  /// numbers that begin anew, for publishers that give none, and for an older message: roscpp may
  /// deliver one from before the subscription late, with another number. Where older ones go on to
  /// come, the clock was set back, and they are counted from there
  std::uint32_t before(const std_msgs::Header& header);
  void reset() { *this = MissingMessages(); }

 private:
  std::uint32_t last_ = 0;
  ros::Time stamp_;
  int older_ = 0;  ///< in a row
};

}  // namespace omnister
