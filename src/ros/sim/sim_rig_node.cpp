// SPDX-License-Identifier: Apache-2.0
#include "ros/node/run_node.h"
#include "ros/sim/sim_rig.h"

int main(int argc, char** argv) {
  using namespace omnister;
  return runNode(argc, argv, "sim_rig", [](const ros::NodeHandle&, const ros::NodeHandle& own) {
    const SimRig rig(own, loadSimRigParameters(own));
    return spinWhile([] { return true; });
  });
}
