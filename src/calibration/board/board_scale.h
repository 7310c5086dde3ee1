// SPDX-License-Identifier: Apache-2.0
/// @file Boards in any unit of length give the same lens: within a fit every board is about as
/// large.
#pragma once

#include "omnister/calibration/calibrate.h"
#include "omnister/calibration/detections.h"

namespace omnister::calibration {

/// The unit, a power of two of the board's, in which the board is about as large as a sheet of
/// paper in metres. 1 for a board of that size, and where there is nothing to measure.
double fittingUnit(const std::vector<const Detections*>& cameras);

/// The same views with lengths in another unit.
Detections inUnit(const Detections& detections, double unit);

/// Lengths of a result back in the board's unit.
void fromUnit(CalibrationResult& result, double unit);

}  // namespace omnister::calibration
