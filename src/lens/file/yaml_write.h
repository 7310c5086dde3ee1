// SPDX-License-Identifier: Apache-2.0
/// @file YAML that every reader takes the same way: pieces of lens files and of exported ones.
#pragma once

#include <Eigen/Core>
#include <opencv2/core/types.hpp>
#include <string>
#include <vector>

#include "omnister/lens/standard_camera_info.h"

namespace omnister::detail {

/// The shortest text that reads back as the same double, by YAML 1.1 readers too.
std::string yamlNumber(double value);

/// A sequence on one line: [1, 2, 3].
std::string yamlFlow(const std::vector<double>& numbers);
std::string yamlRowMajor(const Eigen::MatrixXd& matrix);

/// Plain where no YAML reader could take it for anything but a word, else quoted and escaped.
std::string yamlText(const std::string& text);

/// A ROS camera_info file without binning or region of interest. An empty model stands for an
/// uncalibrated camera: K and P all zeros, D empty.
std::string cameraInfoText(cv::Size image_size, const std::string& camera_name,
                           const StandardCameraInfo& info);

}  // namespace omnister::detail
