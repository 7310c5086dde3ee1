// SPDX-License-Identifier: Apache-2.0
/// @file Rigid poses. `T_a_b` maps coordinates of frame b into frame a; translations in metres.
#pragma once

#include <Eigen/Geometry>
#include <string>
#include <string_view>

namespace omnister {

using Pose = Eigen::Isometry3d;

/// Reads "tx ty tz qx qy qz qw" (metres; the quaternion is normalised).
/// @param source what the message names when it is refused, e.g. "--pose"
/// @throws InputError for anything but seven finite numbers or for a quaternion of length below
/// 1e-6
Pose parsePose(std::string_view text, std::string_view source);

/// The inverse of parsePose(), to 17 significant digits.
std::string formatPose(const Pose& pose);

}  // namespace omnister
