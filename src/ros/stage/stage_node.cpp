// SPDX-License-Identifier: Apache-2.0
#include "ros/node/run_node.h"
#include "ros/stage/stage_driver.h"

int main(int argc, char** argv) {
  using namespace omnister;
  return runNode(argc, argv, "stage", [](const ros::NodeHandle& node, const ros::NodeHandle& own) {
    const StageParameters parameters = loadStageParameters(own);
    const StageDriver driver(node, own, parameters, stageOpener(node, parameters));
    return spinWhile([&driver] { return !driver.failed(); });
  });
}
