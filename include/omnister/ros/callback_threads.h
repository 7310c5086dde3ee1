// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ros/callback_queue.h>
#include <ros/node_handle.h>
#include <ros/spinner.h>

#include <cstdint>

namespace omnister {

/// A queue of callbacks with threads of its own. Once stop() is back, none runs any more, and what
/// they use may go: roscpp itself no longer waits for a running callback of a timer, a service or a
/// publisher's connections when those are shut down (github.com/ros/ros_comm issue 2283).
///
/// It is declared before all that gets callbacks by its handles, so that it goes after them.
class CallbackThreads {
 public:
  /// With one thread callbacks come one at a time, in their order.
  explicit CallbackThreads(std::uint32_t threads = 1) : spinner_(threads, &queue_) {}
  ~CallbackThreads() { stop(); }
  CallbackThreads(const CallbackThreads&) = delete;
  CallbackThreads& operator=(const CallbackThreads&) = delete;

  /// @return the handle, with its callbacks called here
  ros::NodeHandle on(ros::NodeHandle node) {
    node.setCallbackQueue(&queue_);
    return node;
  }

  /// To be called when all that callbacks use is there.
  void start() { spinner_.start(); }

  /// Waits for the callbacks that run; there are no further ones. Not from a callback of its own.
  void stop() {
    queue_.disable();
    spinner_.stop();
  }

 private:
  ros::CallbackQueue queue_;
  ros::AsyncSpinner spinner_;
};

}  // namespace omnister
