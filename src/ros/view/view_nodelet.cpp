// SPDX-License-Identifier: Apache-2.0
#include <pluginlib/class_list_macros.hpp>

#include "ros/node/server_nodelet.h"
#include "ros/view/view_server.h"

namespace omnister {

class ViewNodelet : public ServerNodelet<ViewServer> {};

}  // namespace omnister

PLUGINLIB_EXPORT_CLASS(omnister::ViewNodelet, nodelet::Nodelet)
