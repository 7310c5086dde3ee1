// SPDX-License-Identifier: Apache-2.0
/// @file Boards seen from known positions of a stage: views of one placement share one pose, and
/// the steps between them are lengths.
#pragma once

#include "calibration/board/calibration_steps.h"
#include "calibration/fit/fit.h"

namespace omnister::calibration {

/// Whether any view has a stage position.
bool hasStage(const Detections& detections);

/// Gives the views of each placement of the board one pose, and finds the stage's axis.
/// A view that contradicts its position keeps a pose of its own, and is named in the warnings.
/// @param prepared every view with its own pose, as `first` was fitted to; changed to shared poses
/// @throws Error where no placement is seen from two positions, or positions and board disagree
Fit joinByStage(const Detections& detections, Prepared& prepared, const Fit& first);

/// Axis and scale of the stage with their uncertainties after a fit.
/// @param[in,out] warnings a remark is added where stage and board disagree about lengths
StageResult judgeStage(const FitInput& input, const Fit& fit, std::vector<std::string>& warnings);

}  // namespace omnister::calibration
