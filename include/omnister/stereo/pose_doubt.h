// SPDX-License-Identifier: Apache-2.0
/// @file Why a pair gives next to nothing: what people mix up about poses, images and lenses,
/// tried.
#pragma once

#include <opencv2/core/mat.hpp>
#include <optional>
#include <string>

#include "omnister/stereo/matcher.h"

namespace omnister {

/// Below this share of the field with a range a pair is doubtful.
inline constexpr double kDoubtfulShare = 0.35;

/// Matches the pair small, as it is given and with the pose inverted, the images exchanged, the
/// lenses exchanged, one lens for both, and the quaternion's numbers in the other order.
/// @param geometry with one displaced camera   @param reference, displaced CV_8UC1
/// @param options limits of range, mask and threads are used; costs a second or two
/// @return the likely cause and its remedy, for a person, where one of these gives several times as
/// many ranges; nullopt where none does
std::optional<std::string> poseDoubt(const StereoGeometry& geometry, const MatcherOptions& options,
                                     const cv::Mat& reference, const cv::Mat& displaced);

}  // namespace omnister
