// SPDX-License-Identifier: Apache-2.0
#include <nodelet/nodelet.h>

#include <memory>
#include <pluginlib/class_list_macros.hpp>

#include "omnister/ros/view_server.h"

namespace omnister {

class ViewNodelet : public nodelet::Nodelet {
 private:
  void onInit() override {
    try {
      view_ = std::make_unique<ViewServer>(getMTNodeHandle(), getMTPrivateNodeHandle());
    } catch (const std::exception& error) {
      NODELET_FATAL("%s", error.what());
      throw;
    }
  }

  std::unique_ptr<ViewServer> view_;
};

}  // namespace omnister

PLUGINLIB_EXPORT_CLASS(omnister::ViewNodelet, nodelet::Nodelet)
