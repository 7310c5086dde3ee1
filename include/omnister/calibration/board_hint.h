// SPDX-License-Identifier: Apache-2.0
/// @file Which board an image shows when it is not quite the one that was asked for.
#pragma once

#include <opencv2/core/mat.hpp>
#include <optional>
#include <string>

#include "omnister/calibration/target.h"

namespace omnister {

/// Looks for the mistakes that people make: two pictures side by side in one file, another
/// dictionary or family of tags, the other layout of ChArUco boards, the other border of an
/// AprilGrid, `asymmetric` forgotten or too much, another type of board.
/// @return what the image shows and which key of the target says otherwise, e.g. "shows the board
/// twice, ..."; nullopt where nothing of the kind fits
std::optional<std::string> boardHint(const cv::Mat& image, const Target& asked);

/// Whatever board an image shows, of any type; lengths are 1 where a picture does not tell them.
std::optional<Target> boardSeen(const cv::Mat& image);

}  // namespace omnister
