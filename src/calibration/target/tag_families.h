// SPDX-License-Identifier: Apache-2.0
/// @file Dictionaries of coded markers, from OpenCV's aruco module and from libapriltag.
#pragma once

#include <apriltag/apriltag.h>

#include <Eigen/Core>
#include <memory>
#include <opencv2/aruco/dictionary.hpp>
#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

#include "omnister/calibration/target.h"

namespace omnister::tags {

/// Null for an unknown name.
cv::Ptr<cv::aruco::Dictionary> arucoDictionary(const std::string& name);
std::string arucoDictionaryNames();
/// A marker with its black border, one cell a pixel: CV_8UC1, 0 black, 255 white.
cv::Mat arucoBits(const std::string& dictionary, int id);

using AprilFamily = std::shared_ptr<apriltag_family_t>;
/// A new instance (a family holds the decoder's tables, which detectors on several threads must not
/// share). Null for an unknown name.
/// @param border_bits width of the black border, 1 (as its inventors draw it) or 2 (Kalibr's)
AprilFamily aprilFamily(const std::string& name, int border_bits = 1);
std::string aprilFamilyNames();
/// As arucoBits().
cv::Mat aprilBits(const std::string& family, int id, int border_bits = 1);

/// Whether a square of a ChArUco board is black.
bool charucoBlack(const Target& target, int col, int row);
/// Square (column, row) of every marker, by id.
std::vector<Eigen::Vector2i> charucoMarkers(const Target& target);

}  // namespace omnister::tags
