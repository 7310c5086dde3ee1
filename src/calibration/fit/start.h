// SPDX-License-Identifier: Apache-2.0
/// @file A first lens and first board poses from corners alone: no focal length is asked for, and
/// any field of view is possible, since everything is done on bearings.
#pragma once

#include <opencv2/core/types.hpp>
#include <optional>
#include <vector>

#include "calibration/fit/board.h"
#include "omnister/lens/lens_model.h"

namespace omnister::calibration {

/// A radial profile r(theta) of one parameter beside the focal length, wide enough to start from:
/// shape 0: perspective f tan(theta); 1: stereographic 2 f tan(theta / 2); 2: equidistant f theta;
/// 3: equisolid 2 f sin(theta / 2).
struct Profile {
  int shape = 2;
  double focal_px = 0.0;
  double theta(double radius) const;  ///< [rad]; NaN beyond the profile's range
  double radius(double theta) const;  ///< [px]
  double maxTheta() const;            ///< where the profile itself ends [rad]
};

/// One way to begin, with how well it explains the corners.
struct Start {
  Profile profile;
  double score_px = 0.0;   ///< typical residual over the views [px]
  double max_theta = 0.0;  ///< angle of the outermost corner [rad]
};

/// The pose of a planar board from bearings of its corners, by direct linear transform: the 3x3
/// matrix H with b x H (x, y, 1) = 0 is (r1 r2 t) up to scale. Bearings may point behind the
/// camera.
/// @return nullopt when the corners do not determine a pose
std::optional<Pose> poseFromBearings(const std::vector<Eigen::Vector3d>& bearings,
                                     const std::vector<Corner>& corners);

/// Tries profiles over all fields of view from 6 to 300 degrees about the image centre.
/// @return the starts worth adjusting from, best first, different in kind; empty when none explains
/// anything
std::vector<Start> findStarts(const std::vector<std::vector<Corner>>& views, cv::Size image_size,
                              int threads);

/// Bearings of pixels through a profile about `center`; NaN where outside.
std::vector<Eigen::Vector3d> bearingsOf(const Profile& profile, const Eigen::Vector2d& center,
                                        const std::vector<Corner>& corners);

}  // namespace omnister::calibration
