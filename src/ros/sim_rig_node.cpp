// SPDX-License-Identifier: Apache-2.0
#include <ros/ros.h>

#include "omnister/ros/sim_rig.h"

int main(int argc, char** argv) {
  ros::init(argc, argv, "sim_rig");
  // Without any handle ROS ends, and with it its log: the reason why would not be told.
  const ros::NodeHandle keep;
  try {
    const ros::NodeHandle private_node("~");
    const omnister::SimRig rig(private_node,
                               omnister::loadSimRigParameters(private_node));
    ros::spin();
  } catch (const std::exception& e) {
    ROS_FATAL_STREAM(omnister::printable(e.what(), 1000));
    return 1;
  }
  return 0;
}
