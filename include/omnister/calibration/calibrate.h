// SPDX-License-Identifier: Apache-2.0
/// @file Fitting lens surfaces to corners of a board.
#pragma once

#include <Eigen/Core>
#include <optional>
#include <string>
#include <vector>

#include "omnister/calibration/detections.h"
#include "omnister/common/error.h"
#include "omnister/common/pose.h"
#include "omnister/common/progress.h"
#include "omnister/lens/lens_file.h"
#include "omnister/lens/lens_models.h"

namespace omnister {

/// What to do with views that contradict each other: images turned or mirrored, of another camera,
/// at another focus.
enum class Contradictions {
  kRefuse,    ///< ContradictionError names them
  kLeaveOut,  ///< the largest set of views that agree, the others named
  kKeep,      ///< all together, as if they agreed
};

/// Views fall into sets that each have a lens of their own.
class ContradictionError : public Error {
 public:
  using Error::Error;
};

struct CalibrationOptions {
  std::string model = "auto";  ///< "auto" or a name of lensModelNames()
  /// Exactly this structure instead of a choice within `model`.
  std::optional<LensStructure> structure;
  int folds = 0;           ///< interleaved folds; 0: only what "auto" needs (5)
  bool board_warp = true;  ///< fit two parameters of board curvature
  Contradictions contradictions = Contradictions::kRefuse;
  int threads = 0;  ///< 0: every core
  Progress progress;
};

/// One view after the fit.
struct ViewResult {
  std::string name;
  Pose T_camera_board;  ///< board to camera, board units
  double rms_px = 0.0;
  std::vector<Eigen::Vector2d> residuals;  ///< observed - predicted [px]
  bool used = true;                        ///< false: rejected as a whole
  std::string reason;                      ///< why it was not used
};

/// One candidate of the choice among structures.
struct CandidateResult {
  LensStructure structure;
  double rms_px = 0.0;
  std::optional<double> holdout_rms_px;
  bool chosen = false;
};

/// What views at known stage positions say of the stage.
struct StageResult {
  Eigen::Vector3d axis = Eigen::Vector3d::UnitX();  ///< way of the camera for growing positions,
                                                    ///< unit vector in the optical frame
  double axis_sigma_rad = 0.0;                      ///< standard deviation of its direction [rad]
  /// Length of the stage's metre by the board's, were it free: 1 where both are right.
  double scale = 1.0;
  double scale_sigma = 0.0;
  int boards = 0;  ///< placements of the board seen from more than one position
  int views = 0;   ///< views of these
};

/// Projection uncertainty of points at a distance, see projectionUncertaintyAt().
struct DepthUncertainty {
  double distance = 0.0;  ///< board units; may be infinite
  double rms_px = 0.0;
  double max_px = 0.0;
};

struct CalibrationResult {
  LensFile file;  ///< lens, covariance and record, ready to write
  Eigen::Vector2d board_warp = Eigen::Vector2d::Zero();  ///< see calibrate()
  std::vector<ViewResult> views;
  std::vector<CandidateResult> candidates;
  double rms_px = 0.0;  ///< over all corners of used views, 2-D error per corner
  std::optional<double> holdout_rms_px;
  int points = 0;
  double height_px =
      0.0;  ///< of the surface over its centre, Johnson's R0: pixels per radian there
  double height_sigma_px = 0.0;     ///< its standard deviation; NaN where it cannot be told
  double uncertainty_rms_px = 0.0;  ///< of directions, over the image (projectionUncertainty())
  double uncertainty_max_px = 0.0;
  std::vector<DepthUncertainty>
      depth_uncertainty;              ///< at the boards, 2 and 10 times as far, infinity
  std::optional<double> bias_rms_px;  ///< difference from the next richer model
  std::string bias_against;           ///< that model
  std::optional<StageResult> stage;   ///< where views had stage positions
  std::vector<std::string> warnings;  ///< for a person: bad images by name, poor coverage, …
};

/// Joint adjustment of lens, poses and board warp with a robust loss, started from bearings without
/// a focal guess. Views with a stage position share the pose of their board, moved by the known
/// steps along an axis that is estimated too; lengths of board and stage are then of one unit.
/// @throws Error with the reason where the data cannot carry a calibration (too few views, boards
/// only square to the axis, …), ContradictionError as CalibrationOptions::contradictions says.
/// Never returns a failed fit.
CalibrationResult calibrate(const Detections& detections, const CalibrationOptions& options);

struct StereoCalibrationResult {
  CalibrationResult left;
  CalibrationResult right;
  Pose T_left_right;    ///< maps right (displaced) into left (reference)
  double rms_px = 0.0;  ///< joint, over the corners of both cameras
  /// Over pairs unseen by lenses, warp and the pose between the cameras, whose board pose alone was
  /// refitted to both images; where folds were asked for.
  std::optional<double> holdout_rms_px;
  std::vector<std::string> warnings;
};

/// The same adjustment over two rigidly joined cameras; view i of both saw the board at one
/// instant. Views are paired by index; a view may be empty where one camera did not see the board.
StereoCalibrationResult calibrateStereo(const Detections& left, const Detections& right,
                                        const CalibrationOptions& options);

}  // namespace omnister
