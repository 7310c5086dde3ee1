// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <gtest/gtest.h>
#include <ros/ros.h>

#include <functional>
#include <mutex>
#include <string>
#include <vector>

namespace omnister::test {

/// Waits for something to come true. The limit is no measure of speed: only what never happens
/// reaches it.
inline bool eventually(const std::function<bool()>& condition, double seconds = 20.0) {
  const ros::WallTime end = ros::WallTime::now() + ros::WallDuration(seconds);
  while (ros::ok() && ros::WallTime::now() < end) {
    if (condition()) return true;
    ros::WallDuration(0.005).sleep();
  }
  return condition();
}

/// All messages that came on a topic, from any thread.
template <typename Message>
class Collector {
 public:
  Collector(ros::NodeHandle node, const std::string& topic, std::uint32_t queue = 1000) {
    subscriber_ =
        node.subscribe<Message>(topic, queue, [this](const typename Message::ConstPtr& message) {
          const std::lock_guard<std::mutex> lock(mutex_);
          messages_.push_back(message);
        });
  }
  std::size_t size() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return messages_.size();
  }
  std::vector<typename Message::ConstPtr> messages() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return messages_;
  }
  typename Message::ConstPtr last() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return messages_.empty() ? nullptr : messages_.back();
  }
  void clear() {
    const std::lock_guard<std::mutex> lock(mutex_);
    messages_.clear();
  }
  bool connected() const { return subscriber_.getNumPublishers() > 0; }
  void shutdown() { subscriber_.shutdown(); }

 private:
  mutable std::mutex mutex_;
  std::vector<typename Message::ConstPtr> messages_;
  ros::Subscriber subscriber_;
};

/// main() of a rostest in which callbacks run beside the tests.
inline int runTests(int argc, char** argv, const std::string& name) {
  testing::InitGoogleTest(&argc, argv);
  ros::init(argc, argv, name);
  const ros::NodeHandle keep;
  ros::AsyncSpinner spinner(3);
  spinner.start();
  return RUN_ALL_TESTS();
}

}  // namespace omnister::test
