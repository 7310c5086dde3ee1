// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ros/callback_queue.h>
#include <ros/init.h>
#include <ros/node_handle.h>

#include <atomic>
#include <boost/make_shared.hpp>
#include <cstddef>
#include <functional>
#include <thread>
#include <utility>
#include <vector>

namespace omnister {

/// A queue of callbacks with threads of its own. Once stop() is back, none runs any more, and what
/// they use may go: roscpp itself no longer waits for a running callback of a timer, a service or a
/// publisher's connections when those are shut down (github.com/ros/ros_comm issue 2283).
///
/// ros::AsyncSpinner would do, but looks around ten times a second, in each thread of each node.
///
/// It is declared before all that gets callbacks by its handles, so that it goes after them.
class CallbackThreads {
 public:
  /// With one thread callbacks come one at a time, in their order.
  explicit CallbackThreads(std::size_t threads = 1) : threads_(threads) {}
  ~CallbackThreads() { stop(); }
  CallbackThreads(const CallbackThreads&) = delete;
  CallbackThreads& operator=(const CallbackThreads&) = delete;

  /// @return the handle, with its callbacks called here
  ros::NodeHandle on(ros::NodeHandle node) {
    node.setCallbackQueue(&queue_);
    return node;
  }

  /// To be called when all that callbacks use is there.
  void start() {
    for (std::thread& thread : threads_) thread = std::thread([this] { run(); });
  }

  /// Has that called here, once.
  void post(std::function<void()> call) {
    queue_.addCallback(boost::make_shared<Posted>(std::move(call)));
  }

  /// Waits for the callbacks that run; there are no further ones. Not from a callback of its own.
  void stop() {
    stop_ = true;
    queue_.disable();
    for (std::thread& thread : threads_) {
      if (thread.joinable()) thread.join();
    }
  }

 private:
  class Posted : public ros::CallbackInterface {
   public:
    explicit Posted(std::function<void()> call) : call_(std::move(call)) {}
    CallResult call() override {
      call_();
      return Success;
    }

   private:
    const std::function<void()> call_;
  };

  void run() {
    // A callback or the end wakes it; in between it looks whether ROS has ended.
    const ros::WallDuration look(1.0);
    while (!stop_ && ros::ok()) {
      if (threads_.size() == 1) {
        queue_.callAvailable(look);
      } else {
        queue_.callOne(look);
      }
    }
  }

  ros::CallbackQueue queue_;
  std::vector<std::thread> threads_;
  std::atomic<bool> stop_{false};
};

}  // namespace omnister
