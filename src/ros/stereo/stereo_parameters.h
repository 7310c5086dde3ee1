// SPDX-License-Identifier: Apache-2.0
/// @file The stereo node's parameters, as they are loaded and as they change live.
#pragma once

#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

#include "omnister/stereo/matching_limits.h"
#include "ros/stereo/stereo_pipeline.h"

namespace omnister {

/// For regions of an image whose size is not known yet.
inline const cv::Size kAnySize(kMaxImageSide, kMaxImageSide);

/// @param path image file; empty: none  @throws IoError or InputError
cv::Mat loadMask(const std::string& path);

/// `custom` and the names of matchingPresets().
std::vector<std::string> presetNames();

/// Sets what the preset stands for.
void applyPreset(StereoConfig& config);
/// A preset that was just chosen sets its values; one whose values were then changed is `custom`.
/// @param before what held; an unknown preset stays what it was
void settlePreset(StereoConfig& config, const StereoConfig& before);

StereoConfig toConfig(const StereoParameters& parameters);
/// All but the mask's pixels. @param config that holds
void take(const StereoConfig& config, StereoParameters& parameters);

WorkerSettings settingsOf(const StereoParameters& parameters);

}  // namespace omnister
