// SPDX-License-Identifier: Apache-2.0
/// @file Corners of a board as a given lens would see them: truth for tests of the fit.
#pragma once

#include <Eigen/Geometry>
#include <cmath>
#include <random>
#include <string>

#include "omnister/calibration/detections.h"
#include "omnister/common/pose.h"
#include "omnister/lens/lens_model.h"

namespace omnister::test {

struct BoardScene {
  cv::Size image_size{1280, 960};
  int cols = 8;
  int rows = 6;
  double square = 0.03;  ///< [m]
  int views = 20;
  double noise_px = 0.0;        ///< standard deviation of either coordinate
  double outliers = 0.0;        ///< part of all corners that lie 5 to 40 px off
  double largest_tilt = 0.9;    ///< [rad] against the line of sight
  double least_distance = 0.1;  ///< [m]
  double largest_distance = 0.3;
  Eigen::Vector2d warp = Eigen::Vector2d::Zero();  ///< [m], see CalibrationResult::board_warp
  unsigned seed = 1;
};

/// The corner (col, row) of the bent board.
inline Eigen::Vector3d bentCorner(const BoardScene& scene, int col, int row) {
  const double x = 2.0 * col / (scene.cols - 1) - 1.0;
  const double y = 2.0 * row / (scene.rows - 1) - 1.0;
  return {col * scene.square, row * scene.square,
          scene.warp[0] * (1 - x * x) + scene.warp[1] * (1 - y * y)};
}

/// A pose of the board that looks at the camera from a random direction within the field, tilted
/// against the line of sight.
inline Pose randomBoardPose(const BoardScene& scene, double max_theta, std::mt19937& random) {
  std::uniform_real_distribution<double> unit(0.0, 1.0);
  const double theta = max_theta * std::sqrt(unit(random));
  const double azimuth = 2.0 * M_PI * unit(random);
  const double distance =
      scene.least_distance + (scene.largest_distance - scene.least_distance) * unit(random);
  const Eigen::Vector3d sight(std::sin(theta) * std::cos(azimuth),
                              std::sin(theta) * std::sin(azimuth), std::cos(theta));
  const Eigen::Quaterniond facing =
      Eigen::Quaterniond::FromTwoVectors(Eigen::Vector3d::UnitZ(), sight);
  const double tilt = scene.largest_tilt * std::sqrt(unit(random));
  const double about = 2.0 * M_PI * unit(random);
  const Eigen::AngleAxisd tilted(tilt, Eigen::Vector3d(std::cos(about), std::sin(about), 0.0));
  const Eigen::AngleAxisd turned(2.0 * M_PI * unit(random), Eigen::Vector3d::UnitZ());
  Pose pose = Pose::Identity();
  pose.linear() = (facing * tilted * turned).toRotationMatrix();
  const Eigen::Vector3d middle(0.5 * (scene.cols - 1) * scene.square,
                               0.5 * (scene.rows - 1) * scene.square, 0.0);
  pose.translation() = distance * sight - pose.linear() * middle;
  return pose;
}

/// Corners of one board pose that fall into the image; noise and outliers added.
inline ViewDetections seenBoard(const LensModel& lens, const BoardScene& scene, const Pose& pose,
                                const std::string& name, std::mt19937& random) {
  std::normal_distribution<double> noise(0.0, scene.noise_px > 0.0 ? scene.noise_px : 1.0);
  std::uniform_real_distribution<double> unit(0.0, 1.0);
  ViewDetections view;
  view.name = name;
  for (int row = 0; row < scene.rows; ++row) {
    for (int col = 0; col < scene.cols; ++col) {
      const auto pixel = lens.project(pose * bentCorner(scene, col, row));
      if (!pixel) continue;
      Eigen::Vector2d seen = *pixel;
      if (scene.noise_px > 0.0) seen += Eigen::Vector2d(noise(random), noise(random));
      if (scene.outliers > 0.0 && unit(random) < scene.outliers) {
        const double angle = 2.0 * M_PI * unit(random);
        seen += (5.0 + 35.0 * unit(random)) * Eigen::Vector2d(std::cos(angle), std::sin(angle));
      }
      if (seen.x() < 0 || seen.y() < 0 || seen.x() > scene.image_size.width - 1 ||
          seen.y() > scene.image_size.height - 1) {
        continue;
      }
      view.pixels.push_back(seen);
      view.points.emplace_back(col * scene.square, row * scene.square, 0.0);
    }
  }
  return view;
}

/// Views of random boards, each with at least half of its corners in the picture.
inline Detections simulatedBoards(const LensModel& lens, const BoardScene& scene) {
  // Poses have a source of their own, so that noise and outliers do not move the boards.
  std::mt19937 random_pose(scene.seed);
  std::mt19937 random(scene.seed + 1000003u);
  Detections detections;
  detections.image_size = scene.image_size;
  for (int attempt = 0; attempt < 100 * scene.views; ++attempt) {
    if (static_cast<int>(detections.views.size()) == scene.views) break;
    const Pose pose = randomBoardPose(scene, lens.maxTheta(), random_pose);
    auto view =
        seenBoard(lens, scene, pose, "board" + std::to_string(detections.views.size()), random);
    if (2 * static_cast<int>(view.pixels.size()) >= scene.cols * scene.rows) {
      detections.views.push_back(std::move(view));
    }
  }
  return detections;
}

/// 190 degrees over 1280x960, as most simulated calibrations see them.
inline LensPtr wideLens() {
  return makeLens("asphere", {645.3, 473.1},
                  {{"f", {285.0}}, {"alpha", {0.66}}, {"beta", {1.05}}, {"a4", {0.02}}},
                  95 * M_PI / 180.0, "test");
}

inline BoardScene wideScene(unsigned seed, double noise_px) {
  BoardScene scene;
  scene.seed = seed;
  scene.noise_px = noise_px;
  return scene;
}

/// A lens with a 2-D spline that no radial surface can say.
inline LensPtr bentLens() {
  LensStructure structure;
  structure.model = "spline";
  structure.even_terms = 1;
  structure.grid = 6;
  const LensPtr plain = makeLens(structure, {645.3, 473.1}, 285.0, 95 * M_PI / 180.0);
  Eigen::VectorXd numbers = plain->parameters();
  std::mt19937 random(3);
  std::uniform_real_distribution<double> unit(-0.004, 0.004);
  for (double& value : numbers.tail(72)) value = unit(random);
  return plain->withParameters(numbers);
}

/// What it takes to calibrate that lens: many corners.
inline BoardScene bentScene(int views) {
  BoardScene scene = wideScene(5, 0.1);
  scene.views = views;
  scene.cols = scene.rows = 10;
  scene.square = 0.02;
  return scene;
}

}  // namespace omnister::test
