// SPDX-License-Identifier: Apache-2.0
#include <pluginlib/class_list_macros.hpp>

#include "ros/calibration/calibration_server.h"
#include "ros/node/server_nodelet.h"

namespace omnister {

class CalibrationNodelet : public ServerNodelet<CalibrationServer> {};

}  // namespace omnister

PLUGINLIB_EXPORT_CLASS(omnister::CalibrationNodelet, nodelet::Nodelet)
