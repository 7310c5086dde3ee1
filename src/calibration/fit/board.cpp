// SPDX-License-Identifier: Apache-2.0
#include "calibration/fit/board.h"

#include <Eigen/Eigenvalues>
#include <cmath>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"

namespace omnister::calibration {

Corner Board::corner(const Eigen::Vector2d& pixel, const Eigen::Vector3d& point) const {
  Corner corner;
  corner.pixel = pixel;
  corner.point = T_plane_board * point;
  corner.bulge = 1.0 - (corner.point.head<2>().array() / half.array()).square();
  return corner;
}

Board makeBoard(const std::vector<ViewDetections>& views) {
  Eigen::Vector3d mean = Eigen::Vector3d::Zero();
  std::size_t count = 0;
  for (const ViewDetections& view : views) {
    for (const Eigen::Vector3d& point : view.points) mean += point;
    count += view.points.size();
  }
  if (count == 0) throw Error("no corner of the board was found in any view");
  mean /= static_cast<double>(count);
  Eigen::Matrix3d scatter = Eigen::Matrix3d::Zero();
  for (const ViewDetections& view : views) {
    for (const Eigen::Vector3d& point : view.points) {
      scatter += (point - mean) * (point - mean).transpose();
    }
  }
  scatter /= static_cast<double>(count);
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(scatter);
  const Eigen::Vector3d spread = solver.eigenvalues().cwiseMax(0.0).cwiseSqrt();  // ascending
  if (!(spread[2] > 0.0) || spread[1] < 1e-3 * spread[2]) {
    throw Error("the board points lie on one line; expected the corners of a flat board");
  }
  if (spread[0] > 0.1 * spread[1]) {
    throw Error("the board points are far from any plane (" + formatNumber(spread[0]) +
                " across, " + formatNumber(spread[2]) +
                " along); expected the corners of a flat board");
  }

  // The board's own axes where it lies in z = constant, so that the warp is along its rows and
  // columns.
  Eigen::Matrix3d axes = Eigen::Matrix3d::Identity();
  const Eigen::Vector3d normal = solver.eigenvectors().col(0);
  if (std::abs(normal.z()) < 0.999) {
    axes.row(0) = solver.eigenvectors().col(2);
    axes.row(2) = normal;
    axes.row(1) = axes.row(2).cross(axes.row(0));
  }
  Eigen::Vector3d low = Eigen::Vector3d::Constant(HUGE_VAL);
  Eigen::Vector3d high = -low;
  for (const ViewDetections& view : views) {
    for (const Eigen::Vector3d& point : view.points) {
      low = low.cwiseMin(axes * point);
      high = high.cwiseMax(axes * point);
    }
  }
  Board board;
  board.T_plane_board.linear() = axes;
  board.T_plane_board.translation() = -0.5 * (low + high);
  board.half = 0.5 * (high - low).head<2>();
  return board;
}

bool spansPlane(const std::vector<Corner>& corners, const Board& board) {
  Eigen::Vector2d mean = Eigen::Vector2d::Zero();
  for (const Corner& corner : corners) mean += corner.point.head<2>();
  mean /= static_cast<double>(corners.size());
  Eigen::Matrix2d scatter = Eigen::Matrix2d::Zero();
  for (const Corner& corner : corners) {
    const Eigen::Vector2d offset = (corner.point.head<2>() - mean).cwiseQuotient(board.half);
    scatter += offset * offset.transpose();
  }
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> solver(scatter);
  return solver.eigenvalues()[0] > 1e-6 * solver.eigenvalues()[1];
}

}  // namespace omnister::calibration
