// SPDX-License-Identifier: Apache-2.0
/// @file Joint least squares over a lens, the axis of a stage, the poses of whole scans, scene
/// points and boards: the problem behind calibration without a target.
#pragma once

#include <Eigen/Core>
#include <optional>
#include <vector>

#include "omnister/calibration/detections.h"
#include "omnister/calibration/known_angle.h"
#include "omnister/common/pose.h"
#include "omnister/lens/lens_model.h"

namespace omnister::calibration {

/// A scene point seen in one image.
struct ScanObservation {
  int point = 0;  ///< of ScanEstimate::points
  int scan = 0;
  double travel = 0.0;    ///< stage position [m]
  Eigen::Vector2d pixel;  ///< [px]
  double weight = 1.0;    ///< of the residual
};

/// All that is estimated. A scene point X lies at T_scan X - travel axis in the camera.
struct ScanEstimate {
  LensPtr lens;
  Eigen::Vector3d axis = Eigen::Vector3d::UnitX();
  std::vector<Pose> T_scan;  ///< [scan]
  std::vector<Eigen::Vector3d> points;
  std::vector<Pose> T_camera_board;  ///< [board view]
};

struct ScanData {
  std::vector<ScanObservation> observations;
  const Detections* boards = nullptr;
  std::optional<KnownAngle> known_angle;
  std::optional<double> pinned_slope;  ///< holds c where nothing else does [px/rad]
};

struct AdjustOptions {
  double loss_px = 1.0;
  bool scans = false;  ///< free the poses of all scans but the first
  int max_iterations = 50;
  int threads = 1;
};

/// Image radius [px] per radian on the axis. @param d_parameters [out] its gradient; skipped when
/// null
double axisSlope(const LensModel& lens, Eigen::RowVectorXd* d_parameters = nullptr);

/// @return robust cost per observation, or nothing when the adjustment failed; `estimate` is then
/// unchanged
std::optional<double> adjust(const ScanData& data, const AdjustOptions& options,
                             ScanEstimate& estimate);

/// Position of an observed point in its camera [m].
Eigen::Vector3d inCamera(const ScanObservation& o, const ScanEstimate& estimate);

/// 2-D error [px]; large where the point has no image.
double residualOf(const ScanObservation& o, const ScanEstimate& estimate);

/// Observations of every point.
std::vector<std::vector<const ScanObservation*>> byPoint(
    const std::vector<ScanObservation>& observations, std::size_t points);

/// Covariance of the lens parameters with points, axis and poses eliminated, for residuals of unit
/// variance. The pin is left out, so that a scale that only the pin holds shows as a huge variance.
Eigen::MatrixXd lensCovariance(const ScanData& data, const ScanEstimate& estimate, bool scans_free);

}  // namespace omnister::calibration
