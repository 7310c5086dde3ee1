// SPDX-License-Identifier: Apache-2.0
#include "omnister/ros/calibration_server.h"
#include "run_node.h"

int main(int argc, char** argv) {
  return omnister::runServer<omnister::CalibrationServer>(argc, argv, "calibration");
}
