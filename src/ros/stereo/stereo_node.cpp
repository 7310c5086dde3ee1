// SPDX-License-Identifier: Apache-2.0
#include "ros/node/run_node.h"
#include "ros/stereo/stereo_pipeline.h"

int main(int argc, char** argv) {
  return omnister::runServer<omnister::StereoPipeline>(argc, argv, "stereo");
}
