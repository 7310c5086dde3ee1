// SPDX-License-Identifier: Apache-2.0
/// @file An image message as the stereo session takes it.
#pragma once

#include <sensor_msgs/Image.h>

#include <memory>
#include <utility>

#include "stereo/session/stereo_frame.h"

namespace omnister {

class MessageFrame : public StereoFrame {
 public:
  explicit MessageFrame(sensor_msgs::ImageConstPtr message) : message_(std::move(message)) {}

  void check(cv::Size expected, const std::string& name) const override;
  std::int64_t stampNs() const override;
  int significantBits() const override;
  bool isGray() const override;
  cv::Mat gray(int bits) const override;
  cv::Mat bgr(int bits) const override;

  const sensor_msgs::Image& message() const { return *message_; }

 private:
  sensor_msgs::ImageConstPtr message_;
};

inline StereoFramePtr toStereoFrame(const sensor_msgs::ImageConstPtr& message) {
  return std::make_shared<MessageFrame>(message);
}

/// The message that a frame was made of. @param frame from toStereoFrame()
const sensor_msgs::Image& messageOf(const StereoFrame& frame);

}  // namespace omnister
