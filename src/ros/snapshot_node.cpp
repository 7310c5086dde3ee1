// SPDX-License-Identifier: Apache-2.0
#include "omnister/ros/snapshot_server.h"
#include "run_node.h"

int main(int argc, char** argv) {
  return omnister::runServer<omnister::SnapshotServer>(argc, argv, "snapshot");
}
