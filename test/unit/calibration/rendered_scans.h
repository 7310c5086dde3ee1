// SPDX-License-Identifier: Apache-2.0
/// @file A rendered room, scanned by a stage: truth for calibration without a target.
#pragma once

#include <Eigen/Geometry>
#include <cmath>
#include <string>
#include <vector>

#include "omnister/calibration/feature_tracks.h"
#include "omnister/lens/lens_models.h"
#include "omnister/sim/renderer.h"

namespace omnister::test {

struct RenderedScans {
  LensPtr lens;
  Eigen::Vector3d axis = Eigen::Vector3d(0.998, -0.02, 0.05).normalized();
  std::vector<Pose> T_world_scan;
  std::vector<StageScan> scans;
  std::vector<cv::Mat> middle_range;  ///< of the middle image of every scan [m]
};

/// Images of the room at stage positions 5 cm apart, the rig turned between scans.
inline RenderedScans renderScans(cv::Size size, double focal, int positions, int orientations) {
  RenderedScans result;
  LensStructure structure;
  structure.model = "asphere";
  structure.even_terms = 1;
  result.lens =
      makeLens(structure, {0.51 * size.width, 0.49 * size.height}, focal, 95.0 * M_PI / 180.0);
  const sim::ScenePtr scene =
      sim::readScene(std::string(OMNISTER_SOURCE_DIR) + "/config/scenes/room.yaml");
  const sim::Renderer renderer(*result.lens, size);
  const double turns[3][3] = {{0, 0, 0}, {24, 6, 4}, {-6, -22, -8}};
  for (int k = 0; k < orientations; ++k) {
    Pose pose = Pose::Identity();
    pose.linear() = (Eigen::AngleAxisd(turns[k][0] * M_PI / 180.0, Eigen::Vector3d::UnitY()) *
                     Eigen::AngleAxisd(turns[k][1] * M_PI / 180.0, Eigen::Vector3d::UnitX()) *
                     Eigen::AngleAxisd(turns[k][2] * M_PI / 180.0, Eigen::Vector3d::UnitZ()))
                        .toRotationMatrix();
    pose.translation() = Eigen::Vector3d(0.08 * k, -0.05 * k, 0.06 * k);
    result.T_world_scan.push_back(pose);
    StageScan scan;
    for (int i = 0; i < positions; ++i) {
      const double travel = 0.05 * (i - positions / 2);
      sim::RenderOptions options;
      options.adaptive = true;
      options.color = false;
      options.noise_sigma = 1.0;
      options.seed = static_cast<std::uint64_t>(100 * k + i + 1);
      Pose camera = pose;
      camera.translation() += pose.linear() * (travel * result.axis);
      auto frame = renderer.render(*scene, camera, options);
      if (i == positions / 2) result.middle_range.push_back(frame.range);
      scan.images.push_back(frame.image);
      scan.positions_m.push_back(travel);
    }
    result.scans.push_back(scan);
  }
  return result;
}

/// RMS angle between the rays of two lenses within 90 degrees, rays of `fitted` scaled in z by `c`
/// [deg]; infinite where few pixels have both.
inline double angleRms(const LensModel& truth, const LensModel& fitted, cv::Size size, double c) {
  double sum = 0.0;
  int count = 0;
  for (int v = 0; v < size.height; v += 8) {
    for (int u = 0; u < size.width; u += 8) {
      const auto a = truth.unproject({u, v});
      auto b = fitted.unproject({u, v});
      if (!a || !b || std::acos(a->z()) > 0.5 * M_PI) continue;
      b->z() *= c;
      const double angle = std::atan2(a->cross(*b).norm(), a->dot(*b));
      sum += angle * angle;
      ++count;
    }
  }
  return count > 2000 ? std::sqrt(sum / count) * 180.0 / M_PI : HUGE_VAL;
}

/// The same with the scale that a single straight scan leaves open.
inline double bestAngleRms(const LensModel& truth, const LensModel& fitted, cv::Size size) {
  double best = 1e9;
  for (double c = 0.5; c < 2.0; c *= 1.002) {
    best = std::min(best, angleRms(truth, fitted, size, c));
  }
  return best;
}

}  // namespace omnister::test
