// SPDX-License-Identifier: Apache-2.0
#include "ros/node/run_node.h"
#include "ros/snapshot/snapshot_server.h"

int main(int argc, char** argv) {
  return omnister::runServer<omnister::SnapshotServer>(argc, argv, "snapshot");
}
