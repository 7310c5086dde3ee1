// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ros/message_event.h>
#include <ros/node_handle.h>
#include <tf2_msgs/TFMessage.h>
#include <tf2_ros/buffer.h>

#include <set>
#include <string>

#include "ros/node/callback_threads.h"

namespace omnister {

/// Fills a buffer from /tf and /tf_static in a thread of its own, as tf2_ros::TransformListener
/// does; but a stamp that ROS cannot reckon with ends no process, whoever sends it, and what is no
/// transform is refused here, where that is told now and then only. Of frames it takes a bounded
/// number.
class TransformInput {
 public:
  /// @param buffer lives longer
  explicit TransformInput(tf2_ros::Buffer& buffer);
  ~TransformInput();
  TransformInput(const TransformInput&) = delete;
  TransformInput& operator=(const TransformInput&) = delete;

 private:
  void take(const ros::MessageEvent<const tf2_msgs::TFMessage>& event, bool is_static);
  /// @throws Error saying why a transform is none
  void check(const geometry_msgs::TransformStamped& transform);

  CallbackThreads callbacks_;  // before all that uses it
  tf2_ros::Buffer& buffer_;
  ros::Time newest_;              ///< time of the message before
  std::set<std::string> frames_;  ///< that were taken: tf2 keeps their names for ever
  ros::Subscriber moving_, fixed_;
};

}  // namespace omnister
