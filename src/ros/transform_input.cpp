// SPDX-License-Identifier: Apache-2.0
#include "omnister/ros/transform_input.h"

#include <ros/console.h>

#include "omnister/common/error.h"
#include "omnister/ros/conversions.h"

namespace omnister {

TransformInput::TransformInput(tf2_ros::Buffer& buffer) : buffer_(buffer) {
  ros::NodeHandle node = callbacks_.on(ros::NodeHandle());
  using Event = ros::MessageEvent<const tf2_msgs::TFMessage>;
  const auto subscribe = [this, &node](const char* topic, bool is_static) {
    const boost::function<void(const Event&)> callback = [this, is_static](const Event& event) {
      take(event, is_static);
    };
    return node.subscribe<tf2_msgs::TFMessage>(topic, 100, callback);
  };
  moving_ = subscribe("/tf", false);
  fixed_ = subscribe("/tf_static", true);
  buffer_.setUsingDedicatedThread(true);
  callbacks_.start();
}

TransformInput::~TransformInput() {
  callbacks_.stop();
  buffer_.setUsingDedicatedThread(false);
}

void TransformInput::take(const ros::MessageEvent<const tf2_msgs::TFMessage>& event,
                          bool is_static) {
  const ros::Time now = ros::Time::now();
  if (now < newest_) {
    ROS_WARN("time jumped back by %.3f s: what was known from tf is forgotten",
             (newest_ - now).toSec());
    buffer_.clear();
  }
  newest_ = now;
  for (const geometry_msgs::TransformStamped& transform : event.getConstMessage()->transforms) {
    try {
      if (!canReckonWith(transform.header.stamp)) throw Error("its stamp is out of reach");
      buffer_.setTransform(transform, event.getPublisherName(), is_static);
    } catch (const std::exception& error) {
      ROS_ERROR_STREAM_THROTTLE(5.0, "tf from " << printable(transform.child_frame_id, 60) << " to "
                                                << printable(transform.header.frame_id, 60)
                                                << " refused: " << printable(error.what()));
    }
  }
}

}  // namespace omnister
