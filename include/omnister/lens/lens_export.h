// SPDX-License-Identifier: Apache-2.0
/// @file Lens surfaces written as other programs' calibrations: the way back of lens_import.h.
#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "omnister/lens/lens_file.h"

namespace omnister {

/// "kalibr", "ocam" and "equidistant" (ROS camera_info).
const std::vector<std::string>& exportFormats();

/// Models a Kalibr camchain is written with: "pinhole-equidistant", "eucm", "ds", "omni-radtan".
const std::vector<std::string>& kalibrExportModels();

/// A foreign calibration and how near it comes to the lens. Residuals are over the field up to
/// max_theta_rad in every direction, evenly in angle and azimuth, from the numbers as they are
/// written.
struct LensExport {
  std::string text;              ///< the file
  std::string model;             ///< of kalibrExportModels(), "ocam" or "equidistant"
  double residual_rms_px = 0.0;  ///< of the 2-D error [px]
  double residual_max_px = 0.0;  ///< largest 2-D error [px]
  /// The field: that of the lens, or the farthest ray within the image where that is less [rad].
  double max_theta_rad = 0.0;
  /// RMS [px] of every model that was tried; infinite where it is not one-to-one over the field.
  std::vector<std::pair<std::string, double>> tried;
  std::vector<std::string> remarks;  ///< what of the lens the format cannot say
};

/// Fits the numbers of a foreign model to the rays of a lens over its field and writes them down.
/// Of the Kalibr models the nearest is taken (the first in the order of kalibrExportModels() where
/// several are exact). OCamCalib gets both polynomials, and the residual is that of the worse one.
/// @param format one of exportFormats()
/// @param model for "kalibr": only this one of kalibrExportModels(); empty takes the nearest
/// @param narrowed_theta say the lens only this far off the axis [rad]; the image's whole field
/// else
/// @throws Error when no model of the format is one-to-one over the field, or the image lies
///         outside the field
LensExport exportLens(const LensFile& file, std::string_view format, std::string_view model = "",
                      std::optional<double> narrowed_theta = std::nullopt);

/// exportLens() over the widest field, to a quarter of a degree, whose residual is within the
/// bound.
/// @return nothing when not even 10 degrees off the axis are
std::optional<LensExport> exportWidest(const LensFile& file, std::string_view format,
                                       std::string_view model, double max_residual_px);

}  // namespace omnister
