// SPDX-License-Identifier: Apache-2.0
/// @file Boards whose pattern looks the same when turned: every image has its corners numbered from
/// the end that lies uppermost or leftmost in it, which need not be the same end for two cameras
/// that are rolled against each other.
#pragma once

#include <vector>

#include "calibration/fit/board.h"
#include "omnister/common/pose.h"

namespace omnister::calibration {

/// Quarter turns about the middle of the board that carry the points of a view onto each other; 0
/// is always among them. More than the pattern allows where its colours or codes tell its ends
/// apart.
std::vector<int> turnsOf(const std::vector<Corner>& corners, const Board& board);

/// Numbers the corners of a view as if the board were turned; the pose of the board follows.
void turnBoard(int quarters, const Board& board, std::vector<Corner>& corners,
               Pose& T_camera_plane);

/// One answer for each turn that a view allows.
struct TurnedAnswers {
  std::vector<int> turns;     ///< turnsOf()
  std::vector<Pose> answers;  ///< the pose that ought to be one and the same for all views
};

/// The turn of each view with which most answers agree: each is compared with the answer that is
/// nearest to those of all others. @param length distance that counts as much as one radian
/// @return a turn each, 0 for all where turning does not make them agree better
std::vector<int> agreeingTurns(const std::vector<TurnedAnswers>& views, double length);

}  // namespace omnister::calibration
