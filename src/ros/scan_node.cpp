// SPDX-License-Identifier: Apache-2.0
#include <ros/ros.h>

#include "omnister/common/error.h"
#include "omnister/ros/scan_server.h"

int main(int argc, char** argv) {
  ros::init(argc, argv, "scan");
  // Without any handle ROS ends, and with it its log: the reason why would not be told.
  const ros::NodeHandle keep;
  try {
    const ros::NodeHandle private_node("~");
    const omnister::ScanServer scan(ros::NodeHandle(), omnister::loadScanParameters(private_node));
    ros::AsyncSpinner spinner(2);
    spinner.start();
    ros::waitForShutdown();
  } catch (const std::exception& e) {
    ROS_FATAL_STREAM(omnister::printable(e.what(), 1000));
    return 1;
  }
  return 0;
}
