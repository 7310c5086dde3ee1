// SPDX-License-Identifier: Apache-2.0
/// @file Where a stage held the camera at each view, and its CSV file:
///
///     view,position_m,board
///     a_000.png,0.000,wall
///     a_010.png,0.010,wall
///     b_000.png,0.000,floor
///
/// One row a view. Views of one `board` saw it in one place, while the stage moved the camera to
/// `position_m` [m] along its straight axis; board coordinates then are in metres too. Without the
/// column `board` it stood in one place for all of them.
#pragma once

#include <filesystem>
#include <string>
#include <string_view>
#include <vector>

#include "omnister/calibration/detections.h"

namespace omnister {

struct StageView {
  std::string view;
  StagePosition stage;
};

/// @throws InputError naming line and column
std::vector<StageView> parseStagePositions(std::string_view text, std::string_view source);
std::vector<StageView> readStagePositions(const std::filesystem::path& path);

/// Gives views the positions of their names; a view whose name is a path also answers to its file
/// name alone. Views that no row names stay free.
/// @param source of the positions, for messages
/// @return remarks for a person: rows without a view, views without a row
/// @throws InputError where nothing matches, or a name could mean two views
std::vector<std::string> applyStagePositions(const std::vector<StageView>& positions,
                                             std::string_view source, Detections& detections);

}  // namespace omnister
