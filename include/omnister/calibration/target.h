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

/// "checkerboard", "circles", "charuco" or "aprilgrid".
std::string_view targetTypeName(TargetType type);

/// A planar board; its frame has x along a row, y along a column, z into the board, origin at the
/// first point.
///
/// - checkerboard: the square between the first four corners is dark.
/// - circles: dark dots on white. Asymmetric as OpenCV has it: rows are `square_m` apart, the dots
/// of a row
///   twice that, and every second row is shifted by `square_m`.
/// - charuco: markers number the white squares row by row from the top left. The square at the top
/// left
///   is black, as in OpenCV 4.6.0 and later; with `legacy` the one at the bottom left is (OpenCV
///   before 4.6.0, which differs for an even number of rows only).
/// - aprilgrid: Kalibr's layout, tags number the rows from the bottom left. Kalibr's tags have a
/// black
///   border of two bits and black squares at their corners (`border_bits: 2`, `joining_squares`);
///   tags as their inventors draw them have a border of one bit.
struct Target {
  TargetType type = TargetType::kCheckerboard;
  int cols = 0;  ///< checkerboard: inner corners a row; circles: dots a row; charuco and
                 ///< aprilgrid: squares or tags a row
  int rows = 0;
  double square_m = 0.0;         ///< side of a square, or spacing of dots, or side of a tag [m]
  double marker_m = 0.0;         ///< charuco: side of a marker [m]
  double spacing = 0.0;          ///< aprilgrid: gap between tags as a share of the tag
  bool asymmetric = false;       ///< circles
  std::string dictionary{};      ///< charuco: e.g. DICT_4X4_50; aprilgrid: tag36h11
  double dot_m = 0.0;            ///< circles: diameter of a dot [m]; 0: half the spacing
  bool legacy = false;           ///< charuco: see above
  bool joining_squares = false;  ///< aprilgrid: see above; detectors look for themselves
  /// aprilgrid: width of a tag's black border, 1 or 2 bits. 0: not known, detectors try both and
  /// drawings have 1.
  int border_bits = 0;
};

/// `{type: checkerboard, cols: 8, rows: 6, square_m: 0.0244}`, or Kalibr's own target file
/// (`target_type`, `tagCols`, ...: its aprilgrid, checkerboard and circlegrid); unknown keys are
/// refused.
/// @throws InputError naming key, value and what was expected
Target parseTarget(std::string_view text, std::string_view source);
Target readTarget(const std::filesystem::path& path);
/// The inverse of parseTarget(): one line of YAML and a line feed.
std::string formatTarget(const Target& target);

/// What parseTarget() would refuse in a target made by hand.
/// @param source what the message names, e.g. "--square-mm" or a file
/// @throws InputError
void checkTarget(const Target& target, std::string_view source);

/// Every point of the board in the order of its ids [m], z = 0. Row by row from the top left;
/// aprilgrid: the corners of all tags as one grid of 2 cols x 2 rows points.
std::vector<Eigen::Vector3d> targetPoints(const Target& target);

/// Size of the grid of targetPoints(): points a row, and rows.
Eigen::Vector2i targetGrid(const Target& target);

/// Ways to number the points that an image cannot tell apart: `order[k][i]` is the id that point i
/// has in the k-th of them. The first is the identity; more than one only for checkerboards and
/// dots whose pattern looks the same when turned by a half or a quarter. An oracle for tests.
std::vector<std::vector<int>> targetSymmetries(const Target& target);

/// What is printed in black on the board's white, in the board's frame [m]; for drawing.
struct TargetArtwork {
  struct Rectangle {
    double x, y, width, height;  ///< top left corner and size
  };
  struct Dot {
    double x, y, radius;
  };
  std::vector<Rectangle> rectangles;
  std::vector<Dot> dots;
  Eigen::Vector2d min;  ///< extent of the pattern without the white margin
  Eigen::Vector2d max;
  double margin = 0.0;  ///< white that detectors want around it
};
/// @throws InputError as checkTarget()
TargetArtwork targetArtwork(const Target& target);

}  // namespace omnister
