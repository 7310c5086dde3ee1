// SPDX-License-Identifier: Apache-2.0
#include "calibration/fit/board_pose.h"

#include <vector>

#include "calibration/fit/bundle.h"
#include "calibration/fit/start.h"

namespace omnister::calibration {

std::optional<Pose> boardPose(const ViewDetections& view, const LensModel& lens) {
  constexpr double kLossPx = 3.0;
  std::vector<Eigen::Vector3d> bearings;
  std::vector<Corner> corners;
  for (std::size_t i = 0; i < view.pixels.size(); ++i) {
    if (const auto bearing = lens.unproject(view.pixels[i])) {
      bearings.push_back(*bearing);
      corners.push_back({view.pixels[i], view.points[i], Eigen::Vector2d::Zero()});
    }
  }
  const auto start = poseFromBearings(bearings, corners);
  if (!start) return std::nullopt;
  BundleState state;
  // Not owned: the state lives no longer than this call.
  state.lenses = {LensPtr(LensPtr(), &lens)};
  state.poses = {*start};
  BundleView sight;
  sight.corners = &corners;
  refinePose({sight}, kLossPx, state);
  return state.poses[0];
}

}  // namespace omnister::calibration
