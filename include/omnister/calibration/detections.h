// SPDX-License-Identifier: Apache-2.0
/// @file Corners found in images of a calibration target, and their CSV file
/// (header `view,u_px,v_px,x_m,y_m,z_m`, one row per corner).
#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <opencv2/core/types.hpp>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace omnister {

/// Where a stage held the camera while it saw a view.
struct StagePosition {
  double position_m = 0.0;  ///< along the stage's axis, in the board's unit of length
  std::string board{};      ///< views of one name share one pose of the board
};

/// One image's corners.
struct ViewDetections {
  std::string name{};                     ///< image file or CSV view id, for reports
  std::vector<Eigen::Vector2d> pixels{};  ///< [px]
  std::vector<Eigen::Vector3d>
      points{};  ///< on the board, in the board's unit of length, same order
  std::optional<StagePosition> stage{};  ///< empty: the board may be anywhere
};

/// All views of one camera, in order of first appearance.
struct Detections {
  cv::Size image_size;  ///< [px]
  std::vector<ViewDetections> views;
};

/// @param image_size from `--size`; corners outside it (by more than half a pixel) are refused
/// @throws InputError naming line and column
Detections parseDetections(std::string_view text, std::string_view source, cv::Size image_size);
Detections readDetections(const std::filesystem::path& path, cv::Size image_size);
std::string formatDetections(const Detections& detections);

}  // namespace omnister
