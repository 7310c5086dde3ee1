// SPDX-License-Identifier: Apache-2.0
/// @file The stereo node's parameters, as they are loaded and as they change live.
#pragma once

#include <opencv2/core/mat.hpp>
#include <string>

#include "omnister/ros/stereo_pipeline.h"
#include "omnister/stereo/matching_limits.h"

namespace omnister {

/// For regions of an image whose size is not known yet.
inline const cv::Size kAnySize(kMaxImageSide, kMaxImageSide);

/// @param path image file; empty: none  @throws IoError or InputError
cv::Mat loadMask(const std::string& path);

/// Sets what the preset stands for.
void applyPreset(StereoConfig& config);

StereoConfig toConfig(const StereoParameters& parameters);
/// All but the mask's pixels. @param config that holds
void take(const StereoConfig& config, StereoParameters& parameters);

WorkerSettings settingsOf(const StereoParameters& parameters);

}  // namespace omnister
