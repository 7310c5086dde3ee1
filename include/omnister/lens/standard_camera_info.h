// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <string>
#include <vector>

namespace omnister {

/// The nearest standard ROS model ("equidistant", Kannala and Brandt 2006) of a lens over its
/// image.
struct StandardCameraInfo {
  std::string distortion_model;
  Eigen::Matrix3d K = Eigen::Matrix3d::Zero();
  std::vector<double> D;
  double worst_residual_px = 0.0;  ///< over the image within the field [px]
};

}  // namespace omnister
