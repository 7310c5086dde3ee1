// SPDX-License-Identifier: Apache-2.0
#include <pluginlib/class_list_macros.hpp>

#include "omnister/ros/calibration_server.h"
#include "server_nodelet.h"

namespace omnister {

class CalibrationNodelet : public ServerNodelet<CalibrationServer> {};

}  // namespace omnister

PLUGINLIB_EXPORT_CLASS(omnister::CalibrationNodelet, nodelet::Nodelet)
