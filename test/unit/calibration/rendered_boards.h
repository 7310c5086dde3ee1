// SPDX-License-Identifier: Apache-2.0
/// @file Boards drawn by the renderer, so that the truth of every point is known.
#pragma once

#include <Eigen/Geometry>
#include <cmath>
#include <opencv2/core/mat.hpp>
#include <string>

#include "omnister/calibration/target.h"
#include "omnister/common/numbers.h"
#include "omnister/common/pose.h"
#include "omnister/lens/lens_models.h"
#include "omnister/sim/renderer.h"
#include "omnister/sim/scene.h"

namespace omnister::test {

struct Placement {
  double theta_deg;    ///< off the optical axis
  double azimuth_deg;  ///< around it, from x to y
  double distance;     ///< of the middle of the board [m]
  double tilt_deg;     ///< of the board's normal from the line of sight, about the board's x
  double roll_deg;     ///< about the line of sight
};

inline Pose boardPose(const Target& target, const Placement& placement) {
  const TargetArtwork art = targetArtwork(target);
  const Eigen::Vector2d middle = 0.5 * (art.min + art.max);
  // Looking along the line of sight, the picture's down stays the board's down.
  const Eigen::Matrix3d turn =
      (Eigen::AngleAxisd(placement.azimuth_deg * (M_PI / 180.0), Eigen::Vector3d::UnitZ()) *
       Eigen::AngleAxisd(placement.theta_deg * (M_PI / 180.0), Eigen::Vector3d::UnitY()) *
       Eigen::AngleAxisd(-placement.azimuth_deg * (M_PI / 180.0), Eigen::Vector3d::UnitZ()))
          .toRotationMatrix();
  Pose pose = Pose::Identity();
  pose.linear() = turn *
                  Eigen::AngleAxisd(placement.roll_deg * (M_PI / 180.0), Eigen::Vector3d::UnitZ()) *
                  Eigen::AngleAxisd(placement.tilt_deg * (M_PI / 180.0), Eigen::Vector3d::UnitX());
  pose.translation() = turn * Eigen::Vector3d(0, 0, placement.distance) -
                       pose.linear() * Eigen::Vector3d(middle.x(), middle.y(), 0);
  return pose;
}

// 190 degrees across the picture's width.
inline LensPtr wideLens(const cv::Size& size) {
  const double focal = 0.5 * size.width / (95 * (M_PI / 180.0));
  return makeLens({"conic"}, {0.5 * size.width - 3.3, 0.5 * size.height + 2.7}, focal,
                  100 * (M_PI / 180.0));
}

inline cv::Mat draw(const Target& target, const Pose& pose, const LensModel& lens,
                    const cv::Size& size, double noise = 2.0) {
  const Eigen::Quaterniond q(pose.linear());
  const auto list = [](const Eigen::VectorXd& v) {
    std::string text;
    for (const double value : v) text += (text.empty() ? "[" : ", ") + formatNumber(value);
    return text + "]";
  };
  const TargetArtwork art = targetArtwork(target);
  const auto scene = sim::parseScene(
      "version: 1\nbackground: [110, 110, 110]\nobjects:\n  - {type: board, target: " +
          formatTarget(target).substr(0, formatTarget(target).size() - 1) +
          ", position: " + list(pose.translation()) + ", quaternion: " + list(q.coeffs()) +
          ", margin: " + formatNumber(art.margin) + "}\n",
      "scene");
  sim::RenderOptions options;
  options.supersampling = 4;
  options.noise_sigma = noise;
  options.color = false;
  return sim::render(*scene, lens, size, Pose::Identity(), options).image;
}

}  // namespace omnister::test
