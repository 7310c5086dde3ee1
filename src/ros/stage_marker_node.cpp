// SPDX-License-Identifier: Apache-2.0
#include <ros/ros.h>

#include "omnister/ros/stage_marker.h"

int main(int argc, char** argv) {
  ros::init(argc, argv, "stage_marker");
  // Without any handle ROS ends, and with it its log: the reason why would not be told.
  const ros::NodeHandle keep;
  try {
    const omnister::StageMarker marker{ros::NodeHandle(), ros::NodeHandle("~")};
    ros::spin();
  } catch (const std::exception& error) {
    ROS_FATAL("%s", error.what());
    return 1;
  }
  return 0;
}
