// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>

#include "omnister/calibration/detections.h"
#include "omnister/common/pose.h"
#include "omnister/lens/lens_model.h"

namespace omnister::calibration {

/// T_camera_board of a planar board (z = 0) seen through a known lens: linear start on the
/// bearings, then least squares in the image with a robust loss. Corners outside the field are left
/// out.
/// @return nullopt where fewer than four corners have rays, or they lie on one line
std::optional<Pose> boardPose(const ViewDetections& view, const LensModel& lens);

}  // namespace omnister::calibration
