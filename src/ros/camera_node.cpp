// SPDX-License-Identifier: Apache-2.0
#include <ros/ros.h>

#include "omnister/ros/camera_driver.h"

int main(int argc, char** argv) {
  ros::init(argc, argv, "camera");
  try {
    const ros::NodeHandle private_node("~");
    omnister::CameraDriver driver(ros::NodeHandle(), private_node,
                                  omnister::loadCameraParameters(private_node));
    ros::spin();
  } catch (const std::exception& e) {
    ROS_FATAL_STREAM(omnister::printable(e.what(), 1000));
    return 1;
  }
  return 0;
}
