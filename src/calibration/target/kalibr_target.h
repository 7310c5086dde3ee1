// SPDX-License-Identifier: Apache-2.0
/// @file Kalibr's target files (`target_type: 'aprilgrid'`, ...), and Basalt's, which have the same
/// keys for the grid and no type.
#pragma once

#include <yaml-cpp/yaml.h>

#include <string_view>

#include "omnister/calibration/target.h"

namespace omnister {

/// Whether the document has the keys of Kalibr's target files rather than those of a TARGET.yaml.
bool isKalibrTarget(const YAML::Node& root);

/// Lengths are metres in both. Source: Kalibr's wiki, "Calibration targets", and the layout in
/// GridCalibrationTargetAprilgrid and GridCalibrationTargetCirclegrid.
/// @param root a mapping for which isKalibrTarget() holds
/// @return not yet through checkTarget() @throws InputError naming key, value and what was expected
Target parseKalibrTarget(const YAML::Node& root, std::string_view source);

}  // namespace omnister
