// SPDX-License-Identifier: Apache-2.0
/// @file The steps of a one-camera calibration, which the two-camera one starts from.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "calibration/fit/fit.h"
#include "omnister/calibration/calibrate.h"
#include "omnister/common/text.h"

namespace omnister::calibration {

/// The usable views, and a result for every view with the reason where it is not used.
struct Prepared {
  FitInput input;
  std::vector<ViewResult> views;
  std::vector<std::string> warnings;
};

/// Leaves out views that cannot be used, by name.
/// @param board its plane; null: that of these detections @throws Error when fewer than 3 are left
Prepared prepareViews(const Detections& detections, bool warp, const Board* board = nullptr);

/// A conic fit, with views that contradict it left out of `prepared` by name.
/// @throws Error when nothing explains the corners
Fit trustedFirstFit(Prepared& prepared, int threads);

/// The same, with views that contradict each other dealt with as the options say.
/// @throws ContradictionError
Fit agreedFirstFit(Prepared& prepared, const CalibrationOptions& options);

struct Selection {
  Fit fit;
  std::vector<CandidateResult> candidates;
  std::optional<double> holdout_rms_px;
};

/// The structure that `options` asks for, or the one that predicts unseen views best.
Selection selectStructure(const FitInput& input, const Fit& first,
                          const CalibrationOptions& options);

/// Noise that the question "is the lens determined at all?" assumes, however well the corners fit
/// [px].
inline constexpr double kDoubtSigmaPx = 0.05;

/// The next richer structure, to compare with.
LensStructure richerThan(const LensStructure& structure);

/// Lens file, view results, warnings and refusals of a finished fit.
/// @param richer a fit of a richer structure to compare with, if there is one
CalibrationResult assembleResult(const Prepared& prepared, const Selection& selection,
                                 const CalibrationOptions& options,
                                 const Eigen::MatrixXd& covariance,
                                 const std::optional<Fit>& richer);

/// Throws Error with the reason when the lens is not determined by these views.
void refuseUndetermined(const FitInput& input, const BundleState& state, const LensModel& lens,
                        const Eigen::MatrixXd& covariance, cv::Size image_size);

}  // namespace omnister::calibration
