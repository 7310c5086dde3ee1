// SPDX-License-Identifier: Apache-2.0
#include <cmath>
#include <limits>
#include <set>

#include "omnister/common/numbers.h"
#include "ros/message/camera_info_reading.h"
#include "ros/message/conversions.h"

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

ForeignCamera readCameraInfo(const sensor_msgs::CameraInfo& info, const std::string& source) {
  // The importers know how to check these numbers, once they stand in the file that they read.
  const std::set<std::string> known = {"plumb_bob", "rational_polynomial", "equidistant"};
  if (known.count(info.distortion_model) == 0) {
    throw InputError(source, "distortion_model",
                     "is \"" + printable(info.distortion_model) +
                         "\", expected plumb_bob, rational_polynomial or equidistant");
  }
  constexpr std::size_t kMostCoefficients = 14;
  if (info.D.size() > kMostCoefficients) {
    throw InputError(source, "D",
                     "has " + std::to_string(info.D.size()) + " coefficients, expected at most " +
                         std::to_string(kMostCoefficients));
  }
  const auto matrix = [](int rows, std::size_t cols, const auto& data) {
    std::string text;
    for (const double x : data) text += (text.empty() ? "" : ", ") + formatNumber(x);
    return "{rows: " + std::to_string(rows) + ", cols: " + std::to_string(cols) + ", data: [" +
           text + "]}\n";
  };
  const std::string text = "image_width: " + std::to_string(info.width) +
                           "\nimage_height: " + std::to_string(info.height) +
                           "\ncamera_name: camera\ncamera_matrix: " + matrix(3, 3, info.K) +
                           "distortion_model: " + info.distortion_model +
                           "\ndistortion_coefficients: " + matrix(1, info.D.size(), info.D);
  return readForeignCamera(text, source, "camera_info");
}

LensFile fromCameraInfo(const sensor_msgs::CameraInfo& info, const std::string& source) {
  const ForeignCamera camera = readCameraInfo(info, source);
  const ForeignFit fit = fitForeignCamera(camera, "spline");
  constexpr double kMaxResidual = 0.5;  // [px]
  if (!(fit.fit.rms_px <= kMaxResidual)) {
    throw InputError(source, "",
                     "a lens surface misses it by " + formatNumber(fit.fit.rms_px) +
                         " px RMS, more than " + formatNumber(kMaxResidual) + " px");
  }
  LensFile file;
  file.image_size = camera.image_size;
  file.lens = fit.fit.lens;
  file.calibration.notes["imported_from"] = camera.format + " " + camera.model;
  file.calibration.notes["import_residual_rms_px"] = formatNumber(fit.fit.rms_px);
  file.calibration.notes["import_residual_max_px"] = formatNumber(fit.fit.max_px);
  return file;
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
