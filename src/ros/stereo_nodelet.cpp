// SPDX-License-Identifier: Apache-2.0
#include <pluginlib/class_list_macros.hpp>

#include "omnister/ros/stereo_pipeline.h"
#include "server_nodelet.h"

namespace omnister {

class StereoNodelet : public ServerNodelet<StereoPipeline> {};

}  // namespace omnister

PLUGINLIB_EXPORT_CLASS(omnister::StereoNodelet, nodelet::Nodelet)
