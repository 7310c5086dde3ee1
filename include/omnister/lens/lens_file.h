// SPDX-License-Identifier: Apache-2.0
/// @file The lens file: a ROS camera_info YAML with one more block, `lens_surface` (see the
/// README).
#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <map>
#include <opencv2/core/types.hpp>
#include <optional>
#include <string>
#include <string_view>

#include "omnister/lens/lens_model.h"
#include "omnister/lens/standard_camera_info.h"

namespace omnister {

/// How a lens came to be; written as `lens_surface.calibration`. Unset figures are left out.
struct CalibrationRecord {
  std::optional<double> rms_px;          ///< training RMS of the 2-D error per corner [px]
  std::optional<double> holdout_rms_px;  ///< RMS over unseen views [px]
  std::optional<double>
      equidistant_residual_px;  ///< worst residual of the written camera_info [px]
  std::optional<int> views;
  std::optional<int> points;
  std::string date;  ///< ISO 8601, UTC
  /// Further figures and remarks by name (import residuals, chosen structure, stage axis, …).
  std::map<std::string, std::string> notes;
};

/// Everything a lens file holds.
struct LensFile {
  cv::Size image_size;  ///< [px]
  std::string camera_name = "camera";
  LensPtr lens;
  std::optional<Eigen::MatrixXd> covariance;  ///< of LensModel::parameters(), symmetric
  /// Unit vector of stage travel in the optical frame, where a stage calibration found it.
  std::optional<Eigen::Vector3d> stage_axis;
  CalibrationRecord calibration;
};

/// @return nullopt when no standard model comes within 1 px everywhere: then K is to be all zeros
std::optional<StandardCameraInfo> nearestStandardModel(const LensModel& lens, cv::Size image_size);

/// Parses the text of a lens file. Sizes, shapes, finiteness and the one-to-one surface are checked
/// here.
/// @param source for messages, usually the path
/// @throws InputError naming file, key, value and what was expected
LensFile parseLensFile(std::string_view text, std::string_view source);

/// @throws IoError or InputError
LensFile readLensFile(const std::filesystem::path& path);

/// The literal layout of the format: block mappings, flow sequences on one line.
std::string formatLensFile(const LensFile& file);

/// Atomic; keeps the previous version beside it as `path` + "~". @throws IoError
void writeLensFile(const std::filesystem::path& path, const LensFile& file);

}  // namespace omnister
