// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <tf2_msgs/TFMessage.h>
#include <tf2_ros/buffer.h>

namespace omnister {

/// Fills a buffer from /tf and /tf_static in a thread of its own, as tf2_ros::TransformListener
/// does; but a stamp that ROS cannot reckon with ends no process, whoever sends it.
class TransformInput {
 public:
  /// @param buffer lives longer
  explicit TransformInput(tf2_ros::Buffer& buffer);
  ~TransformInput();
  TransformInput(const TransformInput&) = delete;
  TransformInput& operator=(const TransformInput&) = delete;

 private:
  void take(const ros::MessageEvent<const tf2_msgs::TFMessage>& event, bool is_static);

  tf2_ros::Buffer& buffer_;
  ros::Time newest_;  ///< time of the message before
  ros::CallbackQueue queue_;
  ros::NodeHandle node_;
  ros::Subscriber moving_, fixed_;
  ros::AsyncSpinner spinner_{1, &queue_};
};

}  // namespace omnister
