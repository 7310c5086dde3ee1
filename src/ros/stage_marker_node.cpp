// SPDX-License-Identifier: Apache-2.0
#include "omnister/ros/stage_marker.h"
#include "run_node.h"

int main(int argc, char** argv) {
  return omnister::runServer<omnister::StageMarker>(argc, argv, "stage_marker");
}
