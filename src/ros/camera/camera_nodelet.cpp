// SPDX-License-Identifier: Apache-2.0
#include <pluginlib/class_list_macros.hpp>

#include "ros/camera/camera_driver.h"
#include "ros/node/server_nodelet.h"

namespace omnister {
namespace {

/// Its callbacks have a queue of their own.
struct Camera {
  Camera(const ros::NodeHandle& node, const ros::NodeHandle& private_node)
      : driver(node, private_node, loadCameraParameters(private_node)) {}
  CameraDriver driver;
};

}  // namespace

class CameraNodelet : public ServerNodelet<Camera> {};

}  // namespace omnister

PLUGINLIB_EXPORT_CLASS(omnister::CameraNodelet, nodelet::Nodelet)
