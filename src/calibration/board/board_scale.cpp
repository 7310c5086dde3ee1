// SPDX-License-Identifier: Apache-2.0
#include "calibration/board/board_scale.h"

#include <cmath>

#include "omnister/common/numbers.h"

namespace omnister::calibration {

double fittingUnit(const std::vector<const Detections*>& cameras) {
  // Half the diagonal of a board of 20 x 15 cm.
  constexpr double kFitting = 0.125;
  Eigen::Vector3d low = Eigen::Vector3d::Constant(HUGE_VAL);
  Eigen::Vector3d high = -low;
  for (const Detections* detections : cameras) {
    for (const ViewDetections& view : detections->views) {
      for (const Eigen::Vector3d& point : view.points) {
        if (!point.allFinite()) return 1.0;
        low = low.cwiseMin(point);
        high = high.cwiseMax(point);
      }
    }
  }
  const double half = 0.5 * (high - low).norm();
  if (!(half > 1e-100) || !(half < 1e100)) return 1.0;
  return std::exp2(std::round(std::log2(half / kFitting)));
}

Detections inUnit(const Detections& detections, double unit) {
  Detections scaled = detections;
  for (ViewDetections& view : scaled.views) {
    for (Eigen::Vector3d& point : view.points) point /= unit;
    if (view.stage) view.stage->position_m /= unit;
  }
  return scaled;
}

void fromUnit(CalibrationResult& result, double unit) {
  for (ViewResult& view : result.views) view.T_camera_board.translation() *= unit;
  result.board_warp *= unit;
  for (DepthUncertainty& depth : result.depth_uncertainty) depth.distance *= unit;
  auto& notes = result.file.calibration.notes;
  const auto warp = notes.find("board_warp");
  if (warp != notes.end()) {
    warp->second = formatNumber(result.board_warp[0]) + " " + formatNumber(result.board_warp[1]);
  }
}

}  // namespace omnister::calibration
