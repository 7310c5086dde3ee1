// SPDX-License-Identifier: Apache-2.0
/// @file The board as the fit sees it: a plane with a frame of its own and a shallow bend.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "omnister/calibration/detections.h"
#include "omnister/common/pose.h"

namespace omnister::calibration {

/// One corner in the frame of the board's plane.
struct Corner {
  Eigen::Vector2d pixel;  ///< [px]
  Eigen::Vector3d
      point;  ///< plane frame, board units; z is the board's own deviation from the plane
  Eigen::Vector2d bulge;  ///< (1 - x'^2, 1 - y'^2): d(z)/d(warp), see Board
};

/// The plane through all points of a board. Its frame has the origin in the middle of the points, x
/// and y in the plane, and x' = x / half.x, y' = y / half.y in [-1, 1]. A bent board is
///     z = z_board + k1 (1 - x'^2) + k2 (1 - y'^2)
/// with the warp (k1, k2) in board units: the height of the middle over the ends along either axis.
struct Board {
  Pose T_plane_board = Pose::Identity();
  Eigen::Vector2d half = Eigen::Vector2d::Ones();

  Corner corner(const Eigen::Vector2d& pixel, const Eigen::Vector3d& point) const;
};

/// @throws Error when the points lie on one line or far from any plane
Board makeBoard(const std::vector<ViewDetections>& views);

/// Whether the points of a view span the plane: false for points on one line.
bool spansPlane(const std::vector<Corner>& corners, const Board& board);

}  // namespace omnister::calibration
