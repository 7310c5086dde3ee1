// SPDX-License-Identifier: Apache-2.0
#include "ros/stereo/message_frame.h"

#include <sensor_msgs/image_encodings.h>

#include "ros/message/image_input.h"

namespace omnister {

void MessageFrame::check(cv::Size expected, const std::string& name) const {
  checkFrame(*message_, expected, name);
}

std::int64_t MessageFrame::stampNs() const {
  return static_cast<std::int64_t>(message_->header.stamp.toNSec());
}

int MessageFrame::significantBits() const { return omnister::significantBits(*message_); }

bool MessageFrame::isGray() const {
  return sensor_msgs::image_encodings::isMono(message_->encoding);
}

cv::Mat MessageFrame::gray(int bits) const { return toGray(*message_, bits); }

cv::Mat MessageFrame::bgr(int bits) const { return toBgr(*message_, bits); }

const sensor_msgs::Image& messageOf(const StereoFrame& frame) {
  return dynamic_cast<const MessageFrame&>(frame).message();
}

}  // namespace omnister
