// SPDX-License-Identifier: Apache-2.0
#include "omnister/ros/stereo_pipeline.h"
#include "run_node.h"

int main(int argc, char** argv) {
  return omnister::runServer<omnister::StereoPipeline>(argc, argv, "stereo");
}
