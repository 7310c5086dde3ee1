// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <opencv2/core/types.hpp>
#include <optional>

#include "omnister/lens/lens_model.h"
#include "omnister/lens/standard_camera_info.h"

namespace omnister::detail {

/// The Kannala-Brandt ("equidistant") model nearest to a lens over its image, whatever its
/// residual:
///     [u; v] = [cx; cy] + diag(fx, fy) theta (1 + k1 theta^2 + … + k4 theta^8) (cos phi, sin phi)
/// @return nullopt when no part of the image lies in the field, or the fit is not one-to-one over
/// it
std::optional<StandardCameraInfo> fitEquidistant(const LensModel& lens, cv::Size image_size);

}  // namespace omnister::detail
