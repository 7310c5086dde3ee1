// SPDX-License-Identifier: Apache-2.0
/// @file Boards seen from known positions of a stage.
#pragma once

#include <cmath>
#include <string>

#include "omnister/calibration/calibrate.h"
#include "synthetic_boards.h"

namespace omnister::test {

struct StageScene {
  LensPtr lens = makeLens("quadric", {645.3, 473.1},
                          {{"R0", {300.0}}, {"a", {34.0}}, {"b", {35.0}}}, 95 * M_PI / 180, "test");
  Eigen::Vector3d axis = Eigen::Vector3d(1.0, 0.02, -0.03).normalized();
  double tilt = 30 * M_PI / 180;
  int boards = 1;  ///< placements, tilted towards as many sides
  int positions = 6;
  double step = 0.1;       ///< [m]
  double unit = 1.0;       ///< of the positions that are told, per metre
  double distance = 0.25;  ///< of the board's middle [m]
  BoardScene board;

  StageScene() {
    board.cols = 12;
    board.rows = 9;
    board.square = 0.04;
    board.noise_px = 0.3;
  }

  /// The corners, with names like b0_3: placement 0, position 3.
  Detections seen(unsigned seed) const {
    std::mt19937 random(seed);
    Detections detections;
    detections.image_size = board.image_size;
    const Eigen::Vector3d middle(0.5 * (board.cols - 1) * board.square,
                                 0.5 * (board.rows - 1) * board.square, 0.0);
    for (int b = 0; b < boards; ++b) {
      for (int k = 0; k < positions; ++k) {
        Pose pose = Pose::Identity();
        pose.linear() = (Eigen::AngleAxisd(0.3 + 2 * M_PI * b / boards, Eigen::Vector3d::UnitZ()) *
                         Eigen::AngleAxisd(tilt, Eigen::Vector3d::UnitY()))
                            .toRotationMatrix();
        const double travel = step * k;
        pose.translation() = Eigen::Vector3d(0.0, 0.0, distance) - pose.linear() * middle +
                             (0.5 * step * (positions - 1) - travel) * axis;
        auto view = seenBoard(*lens, board, pose, "b" + std::to_string(b) + "_" + std::to_string(k),
                              random);
        view.stage = StagePosition{(1.7 + travel) * unit, "placement " + std::to_string(b)};
        detections.views.push_back(std::move(view));
      }
    }
    return detections;
  }

  CalibrationOptions options() const {
    CalibrationOptions options;
    options.structure = structureOf(*lens);
    return options;
  }
};

}  // namespace omnister::test
