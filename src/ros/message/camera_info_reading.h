// SPDX-License-Identifier: Apache-2.0
/// @file What a CameraInfo says, before a lens is fitted to it: the cheap part of fromCameraInfo().
#pragma once

#include <sensor_msgs/CameraInfo.h>

#include <string>

#include "omnister/lens/lens_import.h"

namespace omnister {

/// @throws InputError for numbers that make no camera, or a model that is not standard
ForeignCamera readCameraInfo(const sensor_msgs::CameraInfo& info, const std::string& source);

}  // namespace omnister
