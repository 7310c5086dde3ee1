// SPDX-License-Identifier: Apache-2.0
#include <nodelet/nodelet.h>

#include <memory>
#include <pluginlib/class_list_macros.hpp>

#include "omnister/ros/camera_driver.h"

namespace omnister {

class CameraNodelet : public nodelet::Nodelet {
 private:
  void onInit() override {
    driver_ = std::make_unique<CameraDriver>(getNodeHandle(), getPrivateNodeHandle(),
                                             loadCameraParameters(getPrivateNodeHandle()));
  }

  std::unique_ptr<CameraDriver> driver_;
};

}  // namespace omnister

PLUGINLIB_EXPORT_CLASS(omnister::CameraNodelet, nodelet::Nodelet)
