// SPDX-License-Identifier: Apache-2.0
#include "calibration/fit/board_turns.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

namespace omnister::calibration {
namespace {

Eigen::Matrix3d quarterTurn(int quarters) {
  Eigen::Matrix3d turn = Eigen::Matrix3d::Identity();
  Eigen::Matrix3d quarter;
  quarter << 0, -1, 0, 1, 0, 0, 0, 0, 1;
  for (int i = 0; i < quarters; ++i) turn = quarter * turn;
  return turn;
}

double distanceOf(const Pose& a, const Pose& b, double length) {
  const double angle = Eigen::AngleAxisd(a.linear().transpose() * b.linear()).angle();
  return std::min(1.0, angle + (a.translation() - b.translation()).norm() / length);
}

/// Of orders that agree alike, the one as detected.
constexpr double kTurnPenalty = 1e-3;

}  // namespace

std::vector<int> turnsOf(const std::vector<Corner>& corners, const Board& board) {
  std::vector<int> turns = {0};
  const double close = 1e-3 * board.half.norm();
  for (const int quarters : {1, 2, 3}) {
    const Eigen::Matrix3d turn = quarterTurn(quarters);
    const bool same = std::all_of(corners.begin(), corners.end(), [&](const Corner& corner) {
      const Eigen::Vector2d place = (turn * corner.point).head<2>();
      return std::any_of(corners.begin(), corners.end(), [&](const Corner& other) {
        return (other.point.head<2>() - place).norm() < close;
      });
    });
    if (same) turns.push_back(quarters);
  }
  return turns;
}

void turnBoard(int quarters, const Board& board, std::vector<Corner>& corners,
               Pose& T_camera_plane) {
  const Eigen::Matrix3d turn = quarterTurn(quarters);
  for (Corner& corner : corners) {
    corner.point = turn * corner.point;
    corner.bulge = 1.0 - (corner.point.head<2>().array() / board.half.array()).square();
  }
  T_camera_plane.linear() = T_camera_plane.linear() * turn.transpose();
}

std::vector<int> agreeingTurns(const std::vector<TurnedAnswers>& views, double length) {
  const auto nearest = [&](const TurnedAnswers& view, const Pose& answer) {
    std::pair<double, int> best(HUGE_VAL, 0);
    for (std::size_t k = 0; k < view.turns.size(); ++k) {
      const double penalty = view.turns[k] == 0 ? 0.0 : kTurnPenalty;
      const double distance = distanceOf(view.answers[k], answer, length) + penalty;
      if (distance < best.first) best = {distance, view.turns[k]};
    }
    return best;
  };
  const auto sumAbout = [&](const Pose& answer, bool turned) {
    double sum = 0.0;
    for (const TurnedAnswers& view : views) {
      sum += turned ? nearest(view, answer).first : distanceOf(view.answers[0], answer, length);
    }
    return sum;
  };
  double least = HUGE_VAL;
  double least_unturned = HUGE_VAL;
  const Pose* middle = nullptr;
  for (const TurnedAnswers& view : views) {
    least_unturned = std::min(least_unturned, sumAbout(view.answers[0], false));
    for (std::size_t k = 0; k < view.turns.size(); ++k) {
      const double penalty = view.turns[k] == 0 ? 0.0 : kTurnPenalty;
      const double sum = sumAbout(view.answers[k], true) + penalty;
      if (sum < least) {
        least = sum;
        middle = &view.answers[k];
      }
    }
  }
  std::vector<int> turns(views.size(), 0);
  if (middle == nullptr || !(least < 0.9 * least_unturned)) return turns;
  for (std::size_t i = 0; i < views.size(); ++i) turns[i] = nearest(views[i], *middle).second;
  return turns;
}

}  // namespace omnister::calibration
