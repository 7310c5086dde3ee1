// SPDX-License-Identifier: Apache-2.0
#include <pluginlib/class_list_macros.hpp>

#include "omnister/ros/view_server.h"
#include "server_nodelet.h"

namespace omnister {

class ViewNodelet : public ServerNodelet<ViewServer> {};

}  // namespace omnister

PLUGINLIB_EXPORT_CLASS(omnister::ViewNodelet, nodelet::Nodelet)
