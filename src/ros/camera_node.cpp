// SPDX-License-Identifier: Apache-2.0
#include <ros/callback_queue.h>
#include <ros/ros.h>

#include "omnister/ros/camera_driver.h"

int main(int argc, char** argv) {
  ros::init(argc, argv, "camera");
  // Without any handle ROS ends, and with it its log: the reason why would not be told.
  const ros::NodeHandle keep;
  try {
    const ros::NodeHandle private_node("~");
    const omnister::CameraDriver driver(ros::NodeHandle(), private_node,
                                        omnister::loadCameraParameters(private_node));
    while (ros::ok() && !driver.failed()) {
      ros::getGlobalCallbackQueue()->callAvailable(ros::WallDuration(0.1));
    }
    if (driver.failed()) return 1;
  } catch (const std::exception& e) {
    ROS_FATAL_STREAM(omnister::printable(e.what(), 1000));
    return 1;
  }
  return 0;
}
