// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ros/callback_queue.h>
#include <ros/network.h>
#include <ros/ros.h>

#include <csignal>
#include <cstdint>
#include <cstdlib>
#include <initializer_list>
#include <iostream>
#include <memory>
#include <string>

#include "omnister/common/error.h"
#include "ros/node/logger_service.h"

namespace omnister {

/// Serves callbacks until ROS goes down. @return false when `well` no longer holds
template <typename Condition>
bool spinWhile(const Condition& well) {
  while (ros::ok() && well()) {
    ros::getGlobalCallbackQueue()->callAvailable(ros::WallDuration(0.1));
  }
  return well();
}

/// A node that is terminated, or whose terminal is closed, ends as after Ctrl-C: with the stage
/// stopped. A signal that whoever started it has switched off (nohup) stays off.
inline void endBySignals() {
  for (const int number : {SIGTERM, SIGHUP}) {
    if (std::signal(number, [](int) { ros::requestShutdown(); }) == SIG_IGN)
      std::signal(number, SIG_IGN);
  }
}

/// ros::init(). @return false where ROS refuses what it is given, a namespace with a blank say, or
/// would end at a trap, with a master's address that is none. It has been told then, on standard
/// error, as there is no log yet.
inline bool initNode(int& argc, char** argv, const std::string& name, std::uint32_t options = 0) {
  try {
    const char* master = std::getenv("ROS_MASTER_URI");
    std::string host;
    std::uint32_t port = 0;
    if (master && !ros::network::splitURI(master, host, port)) {
      throw InputError("ROS_MASTER_URI", "",
                       "is \"" + printable(master) + "\", expected http://HOST:PORT/");
    }
    ros::init(argc, argv, name, options);
    return true;
  } catch (const std::exception& error) {
    std::cerr << name << ": " << printable(error.what(), 1000) << '\n';
    return false;
  }
}

/// main() of a node. `body` gets the handle of the node's namespace and the private one, and says
/// whether all went well. @return the exit code: 1 also for what it throws, which the log tells
template <typename Body>
int runNode(int argc, char** argv, const std::string& name, const Body& body) {
  if (!initNode(argc, argv, name)) return 1;
  endBySignals();
  // Without any handle ROS ends, and with it its log: the reason why would not be told.
  const ros::NodeHandle keep;
  // It was told to end while it waited for the master.
  if (!ros::ok()) return 0;
  const std::shared_ptr<LoggerService> loggers = LoggerService::shared();
  try {
    return body(ros::NodeHandle(), ros::NodeHandle("~")) ? 0 : 1;
  } catch (const std::exception& error) {
    ROS_FATAL_STREAM(printable(error.what(), 1000));
    return 1;
  }
}

/// The same for what is made of the two handles, and then serves until ROS goes down.
template <typename Server>
int runServer(int argc, char** argv, const std::string& name) {
  return runNode(argc, argv, name, [](const ros::NodeHandle& node, const ros::NodeHandle& own) {
    const Server server(node, own);
    return spinWhile([] { return true; });
  });
}

}  // namespace omnister
