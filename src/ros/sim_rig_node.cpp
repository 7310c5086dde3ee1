// SPDX-License-Identifier: Apache-2.0
#include "omnister/ros/sim_rig.h"
#include "run_node.h"

int main(int argc, char** argv) {
  using namespace omnister;
  return runNode(argc, argv, "sim_rig", [](const ros::NodeHandle&, const ros::NodeHandle& own) {
    const SimRig rig(own, loadSimRigParameters(own));
    return spinWhile([] { return true; });
  });
}
