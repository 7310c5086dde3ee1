// SPDX-License-Identifier: Apache-2.0
/// @file Calibration targets and their TARGET.yaml.
#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <string>
#include <string_view>
#include <vector>

namespace omnister {

enum class TargetType { kCheckerboard, kCircles, kCharuco, kAprilGrid };

/// A planar board; its frame has x along a row, y along a column, z into the board, origin at the first
/// point.
struct Target {
  TargetType type = TargetType::kCheckerboard;
  int cols = 0;                  ///< checkerboard: inner corners a row; circles: dots a row; charuco and
                                 ///< aprilgrid: squares or tags a row
  int rows = 0;
  double square_m = 0.0;         ///< side of a square, or spacing of dots, or side of a tag [m]
  double marker_m = 0.0;         ///< charuco: side of a marker [m]
  double spacing = 0.0;          ///< aprilgrid: gap between tags as a share of the tag
  bool asymmetric = false;       ///< circles
  std::string dictionary;        ///< charuco: e.g. DICT_4X4_50; aprilgrid: tag36h11
};

/// `{type: checkerboard, cols: 8, rows: 6, square_m: 0.0244}`; unknown keys are refused.
/// @throws InputError naming key, value and what was expected
Target parseTarget(std::string_view text, std::string_view source);
Target readTarget(const std::filesystem::path& path);
std::string formatTarget(const Target& target);

/// Every point of the board in the order of its ids [m], z = 0.
std::vector<Eigen::Vector3d> targetPoints(const Target& target);

}  // namespace omnister
