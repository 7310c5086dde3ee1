// SPDX-License-Identifier: Apache-2.0
#include "ros/node/static_frames.h"

namespace omnister {

std::shared_ptr<StaticFrames> StaticFrames::shared() {
  static std::mutex mutex;
  static std::weak_ptr<StaticFrames> instance;
  const std::lock_guard<std::mutex> lock(mutex);
  std::shared_ptr<StaticFrames> frames = instance.lock();
  if (!frames) {
    frames = std::make_shared<StaticFrames>();
    instance = frames;
  }
  return frames;
}

void StaticFrames::add(const geometry_msgs::TransformStamped& transform) {
  const std::lock_guard<std::mutex> lock(mutex_);
  broadcaster_.sendTransform(transform);
}

}  // namespace omnister
