// SPDX-License-Identifier: Apache-2.0
/// @file A nodelet manager that is linked as the rest: nodelet's own cannot load what a sanitizer
/// needs to come first. `small_manager manager`, as nodelet's own is called.
#include <nodelet/loader.h>
#include <ros/ros.h>

int main(int argc, char** argv) {
  ros::init(argc, argv, "manager");
  const nodelet::Loader loader;
  ros::spin();
  return 0;
}
