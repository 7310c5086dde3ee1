// SPDX-License-Identifier: Apache-2.0
#include "ros/message/transform_input.h"

#include <ros/console.h>

#include <cmath>

#include "omnister/common/error.h"
#include "ros/message/conversions.h"
#include "ros/node/parameters.h"

namespace omnister {
namespace {

constexpr std::size_t kMostFrames = 10000;

}  // namespace

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

void TransformInput::check(const geometry_msgs::TransformStamped& transform) {
  if (!canReckonWith(transform.header.stamp)) throw Error("its stamp is out of reach");
  const std::string &parent = transform.header.frame_id, &child = transform.child_frame_id;
  if (parent.empty() || child.empty()) throw Error("a frame has no name");
  if (parent == child) throw Error("a frame is its own parent");
  fromTransform(transform.transform, "tf");
  const geometry_msgs::Quaternion& q = transform.transform.rotation;
  constexpr double kUnit = 0.01;  // as tf2
  if (std::abs(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w - 1.0) > kUnit)
    throw Error("its rotation is no unit quaternion");
  for (const std::string& name : {parent, child}) {
    if (name.size() > kLongestFrame) throw Error("the name of a frame is too long");
    if (frames_.size() >= kMostFrames && frames_.count(name) == 0)
      throw Error("there are " + std::to_string(kMostFrames) + " frames already");
    frames_.insert(name);
  }
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
      check(transform);
      buffer_.setTransform(transform, event.getPublisherName(), is_static);
    } catch (const std::exception& error) {
      ROS_ERROR_STREAM_THROTTLE(5.0, "tf from " << printable(transform.child_frame_id, 60) << " to "
                                                << printable(transform.header.frame_id, 60)
                                                << " refused: " << printable(error.what()));
    }
  }
}

}  // namespace omnister
