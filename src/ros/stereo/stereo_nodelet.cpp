// SPDX-License-Identifier: Apache-2.0
#include <pluginlib/class_list_macros.hpp>

#include "ros/node/server_nodelet.h"
#include "ros/stereo/stereo_pipeline.h"

namespace omnister {

class StereoNodelet : public ServerNodelet<StereoPipeline> {};

}  // namespace omnister

PLUGINLIB_EXPORT_CLASS(omnister::StereoNodelet, nodelet::Nodelet)
