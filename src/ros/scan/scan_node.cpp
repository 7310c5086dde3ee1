// SPDX-License-Identifier: Apache-2.0
#include "ros/node/run_node.h"
#include "ros/scan/scan_server.h"

int main(int argc, char** argv) {
  using namespace omnister;
  return runNode(argc, argv, "scan", [](const ros::NodeHandle& node, const ros::NodeHandle& own) {
    const ScanServer scan(node, loadScanParameters(own));
    return spinWhile([] { return true; });
  });
}
