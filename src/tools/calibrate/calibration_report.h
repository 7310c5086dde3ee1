// SPDX-License-Identifier: Apache-2.0
/// @file The report of a calibration: one HTML file that needs no other.
#pragma once

#include <string>

#include "omnister/calibration/calibrate.h"
#include "tools/calibrate/report_pictures.h"

namespace omnister::tools {

/// First whether it is good, why and what to do; then residual vectors, residuals against radius
/// and azimuth, coverage by radius and sector, uncertainty map, lens profile, the models tried and
/// every view, as the text of an HTML file with its drawings inside.
std::string calibrationReport(const std::string& title, const Detections& detections,
                              const CalibrationResult& result, const ReportPictures& pictures = {});

}  // namespace omnister::tools
