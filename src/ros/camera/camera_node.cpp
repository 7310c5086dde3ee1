// SPDX-License-Identifier: Apache-2.0
#include "ros/camera/camera_driver.h"
#include "ros/node/run_node.h"

int main(int argc, char** argv) {
  using namespace omnister;
  return runNode(argc, argv, "camera", [](const ros::NodeHandle& node, const ros::NodeHandle& own) {
    const CameraDriver driver(node, own, loadCameraParameters(own));
    return spinWhile([&driver] { return !driver.failed(); });
  });
}
