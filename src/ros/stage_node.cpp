// SPDX-License-Identifier: Apache-2.0
#include <ros/ros.h>

#include "omnister/ros/stage_driver.h"

int main(int argc, char** argv) {
  ros::init(argc, argv, "stage");
  // Without any handle ROS ends, and with it its log: the reason why would not be told.
  const ros::NodeHandle keep;
  try {
    const ros::NodeHandle node, private_node("~");
    const omnister::StageParameters parameters = omnister::loadStageParameters(private_node);
    const omnister::StageDriver driver(node, private_node, parameters,
                                       omnister::stageOpener(node, parameters));
    // Callbacks wait for the device now and then; joint states of others must not.
    ros::AsyncSpinner spinner(2);
    spinner.start();
    while (ros::ok() && !driver.failed()) ros::WallDuration(0.05).sleep();
    if (driver.failed()) return 1;
  } catch (const std::exception& e) {
    ROS_FATAL_STREAM(omnister::printable(e.what(), 1000));
    return 1;
  }
  return 0;
}
