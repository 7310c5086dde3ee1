// SPDX-License-Identifier: Apache-2.0
/// @file Joint least squares over lenses, board poses, board warp, the pose between two cameras,
/// and the direction of a stage: the one problem behind every kind of calibration here.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "calibration/fit/board.h"
#include "omnister/lens/lens_model.h"

namespace omnister::calibration {

/// One camera's sight of one board.
struct BundleView {
  const std::vector<Corner>* corners = nullptr;
  int camera = 0;       ///< 0: the reference; 1: the displaced camera, joined by T_right_left
  int pose = 0;         ///< which of BundleState::poses
  double travel = 0.0;  ///< stage position along BundleState::axis, board units
};

/// All that is estimated. A board point p lies at X = R p + t - travel axis in the reference
/// camera, and at T_right_left X in the displaced one.
struct BundleState {
  std::vector<LensPtr> lenses;
  std::vector<Pose> poses;  ///< T_camera_plane
  Eigen::Vector2d warp = Eigen::Vector2d::Zero();
  Pose T_right_left = Pose::Identity();
  /// Way of the camera for one unit of travel, camera frame: a unit vector where stage and board
  /// share their unit of length.
  Eigen::Vector3d axis = Eigen::Vector3d::UnitX();
};

struct BundleOptions {
  bool lens = true;
  bool warp = true;
  bool rig = false;
  bool axis = false;
  bool axis_length = false;  ///< with `axis`: its length too, the stage's unit against the board's
  double loss_px = 0.0;      ///< scale of the Cauchy loss [px]; 0: plain least squares
  int max_iterations = 60;
  double tolerance = 1e-10;  ///< relative change of cost at which to stop
};

/// A correction grid of a lens (LensStructure::grid) is held towards zero, a milliradian costing as
/// much as a tenth of a pixel: that settles what it shares with the asphere below it and with the
/// poses, and where no corner is.
/// @return false when the adjustment failed (no finite cost, no usable step); `state` is then
/// unchanged
bool adjust(const std::vector<BundleView>& views, const BundleOptions& options, BundleState& state);

/// Projection continued along the radius beyond the field of the lens, so that a corner that
/// wanders over its edge during a fit keeps pulling the right way.
/// @return nullopt only for a zero or non-finite bearing or one along -z
std::optional<Eigen::Vector2d> projectContinued(const LensModel& lens,
                                                const Eigen::Vector3d& bearing,
                                                Jacobian23* d_bearing = nullptr,
                                                JacobianParams* d_parameters = nullptr);

/// Position of a corner in the camera of the view.
Eigen::Vector3d cornerInCamera(const BundleView& view, const BundleState& state,
                               const Corner& corner);

/// Observed - predicted [px] of every corner.
std::vector<Eigen::Vector2d> residualsOf(const BundleView& view, const BundleState& state);

/// Refits the pose of one board by plain (loss_px = 0) or robust least squares with everything else
/// fixed. All views must share pose `views[0].pose`. @return root mean square residual [px]
double refinePose(const std::vector<BundleView>& views, double loss_px, BundleState& state,
                  int max_iterations = 30);

/// Two unit vectors square to `axis`: the directions in which an axis of fixed length can turn.
Eigen::Matrix<double, 3, 2> axisTangents(const Eigen::Vector3d& axis);

/// The information about lens parameters, warp, rig and axis (in that order, those that are free)
/// with the poses eliminated: J^T J - J^T Jp (Jp^T Jp)^-1 Jp^T J in 1/px^2 per unit of parameter.
/// An axis of fixed length has two columns, steps along its axisTangents(); else three.
Eigen::MatrixXd reducedInformation(const std::vector<BundleView>& views,
                                   const BundleOptions& options, const BundleState& state);

/// Cauchy loss c^2 log(1 + s / c^2) of squared residual s: weight rho'(s).
inline double cauchyWeight(double squared, double loss_px) {
  return loss_px > 0.0 ? 1.0 / (1.0 + squared / (loss_px * loss_px)) : 1.0;
}

}  // namespace omnister::calibration
