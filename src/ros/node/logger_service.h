// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ros/service_server.h>

#include <memory>

#include "ros/node/callback_threads.h"

namespace omnister {

/// `~get_loggers` of this process, in place of roscpp's: rosconsole 1.14 on log4cxx 0.12 and later
/// destroys the log's repository as it answers, and the next new line of the log ends the process
/// (rqt_logger_level asks every node).
class LoggerService {
 public:
  /// The one of this process, while anybody holds it. ROS has been started.
  static std::shared_ptr<LoggerService> shared();
  LoggerService();

 private:
  CallbackThreads callbacks_;
  ros::ServiceServer server_;
};

}  // namespace omnister
