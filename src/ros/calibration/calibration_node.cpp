// SPDX-License-Identifier: Apache-2.0
#include "ros/calibration/calibration_server.h"
#include "ros/node/run_node.h"

int main(int argc, char** argv) {
  return omnister::runServer<omnister::CalibrationServer>(argc, argv, "calibration");
}
