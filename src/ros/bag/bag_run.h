// SPDX-License-Identifier: Apache-2.0
/// @file The stereo pipeline over a recording, without a master and as fast as it goes.
#pragma once

#include <filesystem>
#include <functional>
#include <map>
#include <string>

#include "omnister/common/progress.h"
#include "stereo/session/frame_pairing.h"
#include "stereo/session/stereo_worker.h"

namespace omnister {

/// The same words as the stereo node's parameters.
struct BagRunOptions {
  bool rig = false;         ///< two cameras; else one that moves
  std::string image;        ///< topic (left camera of a rig); empty: the only one in the bag
  std::string right_image;  ///< topic of a rig's right camera
  std::string lens;         ///< lens file; empty: the latest on `<camera>/lens_model` in the bag
  std::string lens_displaced;
  std::string rig_file;
  std::string fixed_frame = "stage_base";
  PairingOptions pairing;
  double max_skew = 0.02;  ///< between left and right [s]
  MatcherOptions matching;
  std::string matcher = "sweep";
};

/// One result. The cloud's grid is the reference image's.
struct BagCloud {
  std::int64_t stamp_ns = 0;  ///< of the reference image
  std::string frame_id;
  std::size_t positions = 0;  ///< displaced images
  double baseline_m = 0.0;    ///< the longest
  double seconds = 0.0;       ///< match and points
  MatchResult match;
  Cloud cloud;
};

struct BagRunSummary {
  std::size_t images = 0;
  std::size_t sets = 0;                        ///< reference images with their displaced ones
  std::size_t skipped = 0;                     ///< sets not wanted
  double recorded_seconds = 0.0;               ///< from the first image's stamp to the last one's
  std::map<std::string, std::size_t> frames;   ///< by what became of them, see FramePairing::counts
  std::map<std::string, std::size_t> dropped;  ///< images and sets, by reason
};

/// Looks first whether the file is a whole bag, then reads poses and lenses, then images in the
/// order of recording, so the same bag gives the same sets in every run. Messages that are broken
/// are left out and counted.
/// @param wanted asked before a set is matched, with the stamp of its reference image [ns]
/// @param take gets each cloud; an exception of it ends the run
/// @throws InputError naming bag, topic and what is wrong, IoError
BagRunSummary runBag(const std::filesystem::path& bag, const BagRunOptions& options,
                     const std::function<bool(std::int64_t)>& wanted,
                     const std::function<void(const BagCloud&)>& take,
                     const Progress& progress = {});

}  // namespace omnister
