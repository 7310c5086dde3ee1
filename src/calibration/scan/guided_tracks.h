// SPDX-License-Identifier: Apache-2.0
/// @file Features measured again once a lens is known: windows that bend as the lens bends them.
#pragma once

#include <Eigen/Core>
#include <optional>
#include <vector>

#include "omnister/calibration/feature_tracks.h"
#include "omnister/common/pose.h"
#include "omnister/lens/lens_model.h"

namespace omnister::calibration {

constexpr int kGuidedHalf = 8;  ///< windows reach this far from their middle [px]

/// What a first calibration says about the scans and the scene.
struct KnownScene {
  LensPtr lens;
  Eigen::Vector3d axis = Eigen::Vector3d::UnitX();  ///< direction of travel, camera frame
  std::vector<Pose> T_scan;  ///< [scan] scene into that scan's camera at position 0
  std::vector<bool> joined;  ///< [scan] T_scan is known
  /// [track] place in the scene [m]; none for tracks that were dropped
  std::vector<std::optional<Eigen::Vector3d>> points;
};

/// Aligns a window around every known point, taken from the middle image of the scan that its track
/// belongs to, with all images of that scan and with the outer and middle images of every other
/// joined scan. Each pixel of the window goes by its own ray to a plane through the point, and from
/// there into the other image, so that what the lens does to the window costs nothing; the slant of
/// the plane is found along with the place in every image (Gauss and Newton on grey values, gain
/// and offset free). Results hold the position of the window's middle, which is a whole pixel of
/// the first image. A linear map of all rays and of the scene changes nothing here, so a scale that
/// is still free does no harm.
/// @return one track for each of `tracks`, whose first observation is that of the window itself;
/// empty where there is no point or fewer than three images show it. No matches.
FeatureTracks measureGuided(const std::vector<StageScan>& scans, const FeatureTracks& tracks,
                            const KnownScene& scene, int threads);

}  // namespace omnister::calibration
