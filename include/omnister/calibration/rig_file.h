// SPDX-License-Identifier: Apache-2.0
/// @file The rig file: two lens files and the pose between their cameras.
///
///     rig:
///       version: 1
///       reference: left.yaml              # lens files, absolute or relative to the rig file
///       displaced: right.yaml
///       T_ref_disp: [tx, ty, tz, qx, qy, qz, qw]   # displaced into reference coordinates [m]
///       baseline_m: 0.0994                # |t|, for people; checked against T_ref_disp
///       rms_px: 0.32                      # optional: joint RMS of the calibration
///       date: "2026-01-01T00:00:00Z"      # optional
#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <string_view>

#include "omnister/common/pose.h"

namespace omnister {

struct RigFile {
  std::filesystem::path
      reference;  ///< lens file of the reference (left) camera; absolute once read
  std::filesystem::path displaced;  ///< lens file of the displaced (right) camera
  Pose T_ref_disp = Pose::Identity();
  std::optional<double> rms_px;
  std::string date;  ///< ISO 8601, UTC; may be empty
};

/// Parses the text of a rig file; lens paths come back as they stand in it.
/// @param source for messages, usually the path
/// @throws InputError naming file, key, value and what was expected
RigFile parseRigFile(std::string_view text, std::string_view source);

/// Reads a rig file; relative lens paths are resolved against its folder. The lens files themselves
/// are not opened. @throws IoError or InputError
RigFile readRigFile(const std::filesystem::path& path);

std::string formatRigFile(const RigFile& rig);

/// Writes atomically, keeping the previous version; lens paths are written relative to the rig file
/// where they lie in or below its folder. @throws IoError
void writeRigFile(const std::filesystem::path& path, const RigFile& rig);

}  // namespace omnister
