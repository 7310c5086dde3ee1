// SPDX-License-Identifier: Apache-2.0
#include "ros/node/run_node.h"
#include "ros/stage/stage_marker.h"

int main(int argc, char** argv) {
  return omnister::runServer<omnister::StageMarker>(argc, argv, "stage_marker");
}
