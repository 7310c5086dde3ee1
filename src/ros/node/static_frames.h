// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <geometry_msgs/TransformStamped.h>
#include <tf2_ros/static_transform_broadcaster.h>

#include <memory>
#include <mutex>

namespace omnister {

/// The static transforms of this process. Two broadcasters in one process share one latched topic,
/// where the last message hides the others from late subscribers; so nodelets share this one.
class StaticFrames {
 public:
  static std::shared_ptr<StaticFrames> shared();
  void add(const geometry_msgs::TransformStamped& transform);

 private:
  std::mutex mutex_;
  tf2_ros::StaticTransformBroadcaster broadcaster_;
};

}  // namespace omnister
