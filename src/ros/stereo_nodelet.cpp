// SPDX-License-Identifier: Apache-2.0
#include <nodelet/nodelet.h>

#include <memory>
#include <pluginlib/class_list_macros.hpp>

#include "omnister/ros/stereo_pipeline.h"

namespace omnister {

class StereoNodelet : public nodelet::Nodelet {
 private:
  void onInit() override {
    try {
      stereo_ = std::make_unique<StereoPipeline>(getMTNodeHandle(), getMTPrivateNodeHandle());
    } catch (const std::exception& error) {
      NODELET_FATAL("%s", error.what());
      throw;
    }
  }

  std::unique_ptr<StereoPipeline> stereo_;
};

}  // namespace omnister

PLUGINLIB_EXPORT_CLASS(omnister::StereoNodelet, nodelet::Nodelet)
