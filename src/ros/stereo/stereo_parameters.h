// SPDX-License-Identifier: Apache-2.0
/// @file The stereo node's parameters, as they are loaded and as they change live.
#pragma once

#include <omnister/StereoConfig.h>

#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

#include "omnister/stereo/matcher.h"
#include "omnister/stereo/matching_limits.h"
#include "ros/node/parameters.h"
#include "ros/stereo/drift_diagnostic.h"
#include "stereo/session/frame_pairing.h"
#include "stereo/session/stereo_worker.h"

namespace omnister {

/// Private parameters of the stereo node; lengths in metres.
struct StereoParameters {
  bool rig = false;  ///< mode: `stage` (one camera that moves) or `rig` (two cameras)
  std::string lens;  ///< lens file of the (left) camera; empty: topic lens_model
  std::string
      lens_displaced;    ///< rig: lens file of the right camera; empty: topic, or the rig file
  std::string rig_file;  ///< rig: pose and lenses of both; empty: tf between the images' frames
  std::string fixed_frame = "stage_base";  ///< stage: camera poses are taken in this tf frame
  PairingOptions pairing;
  double max_skew = 0.02;   ///< rig: between the stamps of left and right [s]
  double min_period = 0.0;  ///< between the beginnings of two matches [s]; of `max_rate`
  MatcherOptions matching;  ///< with the mask
  std::string matcher = "sweep";
  std::string preset = "custom";   ///< see matchingPresets(), cfg/Stereo.cfg
  std::string cost = "census";     ///< see parseMatchCost()
  std::string window = "surface";  ///< see parseMatchWindow()
  std::string mask;                ///< image file; empty: none
  std::string region;              ///< `roi`, see parseRegion()
  int reduce = 1;
  bool use_prior = false, stream = false;  ///< see WorkerSettings
  DriftParameters drift;
  std::string epipolar_pixels;  ///< of the overlay, see parsePixels(); empty: defaultPixels()
};

/// @throws InputError naming key, value and range, or the mask file
StereoParameters loadStereoParameters(Parameters& parameters);

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
