// SPDX-License-Identifier: Apache-2.0
#include <cmath>
#include <limits>

#include "omnister/ros/conversions.h"

namespace omnister {

sensor_msgs::CameraInfo toCameraInfo(const LensFile& file) {
  sensor_msgs::CameraInfo info =
      uncalibratedCameraInfo(file.image_size.width, file.image_size.height);
  const std::optional<StandardCameraInfo> standard =
      nearestStandardModel(*file.lens, file.image_size);
  if (!standard) return info;
  info.distortion_model = standard->distortion_model;
  info.D = standard->D;
  for (int row = 0; row < 3; ++row) {
    for (int col = 0; col < 3; ++col) {
      info.K[static_cast<std::size_t>(row * 3 + col)] = standard->K(row, col);
      info.P[static_cast<std::size_t>(row * 4 + col)] = standard->K(row, col);
    }
    info.R[static_cast<std::size_t>(row * 4)] = 1.0;
  }
  return info;
}

LensModelMessage toLensModelMessage(const LensFile& file, const std_msgs::Header& header) {
  LensModelMessage message;
  message.header = header;
  message.width = static_cast<std::uint32_t>(file.image_size.width);
  message.height = static_cast<std::uint32_t>(file.image_size.height);
  message.model = std::string(file.lens->model());
  const Eigen::Vector2d center = file.lens->center();
  message.center = {center.x(), center.y()};
  message.max_theta = file.lens->maxTheta();
  message.parameter_names = file.lens->parameterNames();
  const Eigen::VectorXd parameters = file.lens->parameters();
  message.parameters.assign(parameters.data(), parameters.data() + parameters.size());
  const double unknown = std::numeric_limits<double>::quiet_NaN();
  message.rms_px = file.calibration.rms_px.value_or(unknown);
  message.holdout_rms_px = file.calibration.holdout_rms_px.value_or(unknown);
  message.yaml = formatLensFile(file);
  return message;
}

LensFile fromLensModelMessage(const LensModelMessage& message, const std::string& source) {
  constexpr std::size_t kMaxBytes = 4u << 20;
  if (message.yaml.size() > kMaxBytes) {
    throw InputError(source, "yaml",
                     "has " + std::to_string(message.yaml.size()) + " bytes, expected at most " +
                         std::to_string(kMaxBytes));
  }
  LensFile file = parseLensFile(message.yaml, source);
  if (static_cast<std::uint32_t>(file.image_size.width) != message.width ||
      static_cast<std::uint32_t>(file.image_size.height) != message.height) {
    throw InputError(source, "width, height", "do not agree with the lens file in the message");
  }
  if (file.lens->model() != message.model) {
    throw InputError(source, "model",
                     "is \"" + printable(message.model) +
                         "\", but the lens file in the message says " +
                         std::string(file.lens->model()));
  }
  return file;
}

}  // namespace omnister
