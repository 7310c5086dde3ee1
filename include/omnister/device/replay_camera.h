// SPDX-License-Identifier: Apache-2.0
/// @file A recorded sequence of images as a camera.
///
/// `replay:PATH` is a folder, or the YAML file that lists its frames. A folder that holds
/// `replay.yaml` is described by it; any other folder is all its images (png, jpg, jpeg, tif, tiff,
/// bmp, pgm, ppm) in the order of their names. The file:
///
///     version: 1
///     rate: 10.0                 # [Hz] of frames without stamps; default 10
///     lens: wide.yaml            # optional: the lens file of this camera
///     encoding: bayer_rggb8      # optional: what the pixels mean; default by the image's own type
///     frames:
///       - {image: 000.png, stamp: 1342626147.554042, stage_position_m: 0.211, settled: true}
///
/// Paths are relative to the file. `stamp` [s since 1970, decimals kept to 1 ns] stands in all
/// frames or in none and increases; `stage_position_m` [m] and `settled` may be left out.
#pragma once

#include <filesystem>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "omnister/device/camera.h"

namespace omnister::device {

struct Recording {
  struct Entry {
    std::filesystem::path image;
    std::optional<Stamp> stamp;
    std::optional<double> stage_position_m;
    std::optional<bool> settled;
  };
  std::string name;  ///< of the folder
  double rate_hz = 10.0;
  std::string encoding;  ///< empty: by the image's own type
  std::optional<std::filesystem::path> lens;
  std::vector<Entry> frames;  ///< at least one
};

/// @throws InputError naming key, value and what was expected
Recording parseRecording(std::string_view text, std::string_view source,
                         const std::filesystem::path& folder);

/// @param path folder or YAML file. All images must exist; they are decoded when it is their turn.
/// @throws IoError, InputError
Recording readRecording(const std::filesystem::path& path);

/// Frames come at the recorded intervals (or at settings.frame_rate_hz). Stamps are those of the
/// replay unless settings.recorded_stamps; the intervals between them are the recorded ones. After
/// stop() and start() it goes on with the next frame. An image that cannot be read is a lost frame
/// (a gap in the sequence) and a remark.
std::unique_ptr<Camera> makeReplayCamera(Recording recording, const CameraSettings& settings);

}  // namespace omnister::device
