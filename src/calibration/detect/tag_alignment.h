// SPDX-License-Identifier: Apache-2.0
/// @file Tags laid over their picture: with the code known, a tag is told and placed where its bits
/// are too small to be read one by one.
#pragma once

#include <optional>
#include <vector>

#include "calibration/detect/board_detectors.h"

namespace omnister::detect {

/// A tag laid over the picture.
struct AlignedTag {
  std::vector<Eigen::Vector2d> pixels;  ///< corners, from the top left clockwise as printed [px]
  double likeness = 0.0;                ///< correlation of drawing and picture, at most 1
  double code_likeness = 0.0;           ///< the same over the bits inside the border alone
};

/// Moves the corners of a tag to where its drawing fits the picture best (Lucas and Kanade 1981, on
/// the four corners; once on a blurred copy, then on the picture itself).
/// @param bits the tag with its border of `border_bits`, a cell a pixel (tags::aprilBits())
/// @param start corners [px]
/// @return nullopt where it leaves the picture or the start
std::optional<AlignedTag> alignTag(const cv::Mat& fine, const cv::Mat& bits, int border_bits,
                                   const std::vector<Eigen::Vector2d>& start);

/// The tags of a grid that `known` does not have yet, looked for where their neighbours say they
/// are, round by round, and kept where the picture shows their code.
/// @param known consistent markers with their places; @param target border_bits must be 1 or 2
std::vector<Marker> growAprilGrid(const cv::Mat& fine, const Target& target,
                                  const std::vector<Marker>& known, const Budget& budget);

/// Quadrilaterals that could be tags, told by their codes: the corners of each, from anywhere and
/// in either sense. @param border_bits widths of border to try
/// @return those told, with border_bits set; most, not all, are right
std::vector<Marker> tellTags(const cv::Mat& fine, const Target& target,
                             const std::vector<std::vector<Eigen::Vector2d>>& quads,
                             const std::vector<int>& border_bits);

}  // namespace omnister::detect
