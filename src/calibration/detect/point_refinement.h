// SPDX-License-Identifier: Apache-2.0
/// @file Measuring the points of a board where they are expected.
#pragma once

#include <optional>
#include <vector>

#include "calibration/detect/corner_refinement.h"
#include "omnister/calibration/target.h"

namespace omnister::detect {

/// Where each point of targetPoints() should be, and how the board lies there [px per metre of
/// board]; nullopt for those that are not expected in the picture.
using Expected = std::vector<std::optional<LocalFrame>>;
using Measured = std::vector<std::optional<Eigen::Vector2d>>;

/// Looks for every expected point near its place: corners of squares by the meeting of edges,
/// corners of tags by the crossing of the tag's fitted sides, dots by their centroid. What does not
/// look like the point that belongs there, or lies further off than a quarter of the spacing, is
/// left out.
/// @param first_square_dark checkerboards whose pattern looks the same turned by a half may have
/// been printed with the colours swapped
Measured measurePoints(const cv::Mat& fine, const Target& target, const Expected& expected,
                       bool first_square_dark = true);

/// How the board lies around the points of a grid found without a lens: differences to neighbours.
/// Points without a neighbour in both directions get no frame.
Expected framesFromGrid(const Measured& points, const Target& target);

/// Positive when the square between the first four corners is dark, negative when it is light: the
/// mean of cornerContrast() over all points.
double firstSquareContrast(const cv::Mat& fine, const Target& target, const Expected& points);

/// One coded marker: its place on the board and its corners, from the top left clockwise as
/// printed.
struct Marker {
  int id = 0;
  int border_bits = 1;                             ///< AprilGrids: as Target::border_bits
  Eigen::Vector2i cell = Eigen::Vector2i::Zero();  ///< column and row
  std::vector<Eigen::Vector2d> board;              ///< corners on the board [m]
  std::vector<Eigen::Vector2d> pixels;             ///< and in the picture [px]
};

/// Appends those whose numbers are not there yet.
void addNew(const std::vector<Marker>& found, std::vector<Marker>& markers);

/// Without the markers that lie where their neighbours say they cannot: false decodings.
std::vector<Marker> consistentMarkers(const std::vector<Marker>& markers);

/// Board to picture near one marker, exact at its four corners.
std::optional<LocalFrame> frameFromMarker(const Marker& marker, const Eigen::Vector2d& board);

}  // namespace omnister::detect
