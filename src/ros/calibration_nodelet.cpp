// SPDX-License-Identifier: Apache-2.0
#include <nodelet/nodelet.h>

#include <memory>
#include <pluginlib/class_list_macros.hpp>

#include "omnister/ros/calibration_server.h"

namespace omnister {

class CalibrationNodelet : public nodelet::Nodelet {
 private:
  void onInit() override {
    try {
      calibration_ =
          std::make_unique<CalibrationServer>(getMTNodeHandle(), getMTPrivateNodeHandle());
    } catch (const std::exception& error) {
      NODELET_FATAL("%s", error.what());
      throw;
    }
  }

  std::unique_ptr<CalibrationServer> calibration_;
};

}  // namespace omnister

PLUGINLIB_EXPORT_CLASS(omnister::CalibrationNodelet, nodelet::Nodelet)
