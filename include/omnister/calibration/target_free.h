// SPDX-License-Identifier: Apache-2.0
/// @file A lens surface and the axis of the stage from images of an ordinary scene at known stage
/// positions: no target.
///
/// What can be seen. Under pure translation every linear map of the rays (and of the scene)
/// explains the images as well. Of these, a surface that is radial about the axis allows exactly
/// one: `h -> c h`. So one straight scan gives the surface and the axis up to that scale c. It is
/// fixed by
///  - two or more scans of the same scene between which the whole rig was turned by unknown
///  amounts,
///    not about the optical axis (15 degrees or more);
///  - a view of a calibration board tilted by 20 degrees or more;
///  - one known angle between two pixels.
/// Which of these hold is found out from the data: the standard deviation of log c is reported.
#pragma once

#include <Eigen/Core>
#include <optional>
#include <string>
#include <vector>

#include "omnister/calibration/detections.h"
#include "omnister/calibration/feature_tracks.h"
#include "omnister/calibration/known_angle.h"
#include "omnister/common/pose.h"
#include "omnister/common/progress.h"
#include "omnister/lens/lens_file.h"
#include "omnister/lens/lens_models.h"

namespace omnister {

struct TargetFreeOptions {
  LensStructure structure;  ///< radial; default set by the constructor: asphere to r^6
  std::optional<KnownAngle> known_angle;
  Detections boards;  ///< views of a board by the same camera; may be empty
  /// From images: let the lens carry a further even term or a radial spline, affinity and
  /// decentring where the observations ask for it and can tell.
  bool grow = true;
  int threads = 0;  ///< 0: every core
  Progress progress;

  TargetFreeOptions() {
    structure.model = "asphere";
    structure.even_terms = 2;
  }
};

/// What fixed the scale c of the surface.
enum class SurfaceScale { kFree, kRotatedScans, kBoard, kKnownAngle };

struct TargetFreeResult {
  LensFile file;  ///< lens, stage axis and record
  SurfaceScale scale = SurfaceScale::kFree;
  double scale_sigma = 0.0;  ///< standard deviation of log c from all data; infinite when free
  std::vector<Pose> T_first_scan;  ///< maps scan k's camera at position 0 into scan 0's; identity
                                   ///< where the scan could not be joined
  std::vector<bool> joined;        ///< scan k shares points with scan 0
  double rms_px = 0.0;             ///< 2-D error per observation that was kept
  int points = 0;                  ///< scene points kept
  int observations = 0;
  std::vector<std::string> warnings;
  std::vector<std::string> scan_warnings;  ///< those of `warnings` that are about joining scans
  /// [track] its place in scan 0's camera at position 0 (its own scan's where that is not joined)
  /// [m]; none for tracks that were dropped
  std::vector<std::optional<Eigen::Vector3d>> track_points;
};

/// @throws Error with the reason where the data cannot carry it (too few tracks, no parallax, …)
TargetFreeResult calibrateTargetFree(const FeatureTracks& tracks, const TargetFreeOptions& options);

/// From the images themselves: features are followed, and when a lens is known measured again
/// through it, twice, with windows that bend as the lens bends them, across scans too. Several
/// times more exact than the paths alone.
/// @throws Error as above and as trackFeatures()
TargetFreeResult calibrateTargetFree(const std::vector<StageScan>& scans,
                                     const TrackingOptions& tracking,
                                     const TargetFreeOptions& options);

/// The lens whose rays are (x, y, c h) where those of `lens` are (x, y, h), in the same structure.
/// @return null where the structure cannot say it to 0.05 px RMS or the surface is no longer
/// one-to-one
LensPtr scaleSurface(const LensModel& lens, double c);

}  // namespace omnister
