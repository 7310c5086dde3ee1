// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/target_free.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "omnister/common/error.h"

namespace omnister {
namespace {

constexpr double kDegree = M_PI / 180.0;

struct Simulation {
  LensPtr lens;
  Eigen::Vector3d axis;
  std::vector<Pose> T_first_scan;  ///< scan k's camera at position 0 into scan 0's
  FeatureTracks tracks;
  std::vector<Eigen::Vector3d> scene;
};

Pose turned(double pan_deg, double tilt_deg, double roll_deg, const Eigen::Vector3d& moved) {
  Pose pose = Pose::Identity();
  pose.linear() = (Eigen::AngleAxisd(pan_deg * kDegree, Eigen::Vector3d::UnitY()) *
                   Eigen::AngleAxisd(tilt_deg * kDegree, Eigen::Vector3d::UnitX()) *
                   Eigen::AngleAxisd(roll_deg * kDegree, Eigen::Vector3d::UnitZ()))
                      .toRotationMatrix();
  pose.translation() = moved;
  return pose;
}

/// Points on the walls of a room of 5 x 3 x 5 m around the rig, seen with noise in every image that
/// they are in; 10 % of the matches between scans are wrong.
Simulation simulate(const std::vector<Pose>& T_first_scan, double noise_px, unsigned seed,
                    int points = 1100) {
  Simulation sim;
  const cv::Size size(1280, 960);
  LensStructure structure;
  structure.model = "asphere";
  structure.even_terms = 1;
  // A 190-degree lens that is neither equidistant nor centred.
  const LensPtr equidistant = makeLens(structure, {652.3, 471.8}, 285.0, 95.0 * kDegree);
  Eigen::VectorXd parameters = equidistant->parameters();
  parameters[3] *= 1.07;
  sim.lens = equidistant->withParameters(parameters);
  EXPECT_TRUE(sim.lens);
  sim.axis = Eigen::Vector3d(0.995, 0.03, -0.08).normalized();
  sim.T_first_scan = T_first_scan;
  sim.tracks.image_size = size;
  std::mt19937 random(seed);
  std::normal_distribution<double> noise(0.0, noise_px);
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  for (int i = 0; i < points; ++i) {
    Eigen::Vector3d p(2.5 * uniform(random), 1.5 * uniform(random), 2.5 * uniform(random));
    const int wall = i % 3;
    p[wall] = std::copysign(wall == 1 ? 1.5 : 2.5, p[wall]);
    sim.scene.push_back(p);
  }
  std::vector<double> positions;
  for (int i = 0; i < 9; ++i) positions.push_back(-0.2 + 0.05 * i);
  std::vector<std::vector<int>> track_of(T_first_scan.size(),
                                         std::vector<int>(sim.scene.size(), -1));
  for (std::size_t k = 0; k < T_first_scan.size(); ++k) {
    sim.tracks.positions_m.push_back(positions);
    for (std::size_t p = 0; p < sim.scene.size(); ++p) {
      FeatureTrack track;
      for (int i = 0; i < 9; ++i) {
        const Eigen::Vector3d X =
            T_first_scan[k].inverse() * sim.scene[p] - positions[i] * sim.axis;
        const auto pixel = sim.lens->project(X);
        if (!pixel || pixel->x() < 0 || pixel->y() < 0 || pixel->x() > size.width - 1 ||
            pixel->y() > size.height - 1) {
          continue;
        }
        track.observations.push_back(
            {static_cast<int>(k), i, *pixel + Eigen::Vector2d(noise(random), noise(random))});
      }
      if (track.observations.size() < 3) continue;
      track_of[k][p] = static_cast<int>(sim.tracks.tracks.size());
      sim.tracks.tracks.push_back(track);
    }
  }
  std::uniform_int_distribution<std::size_t> any(0, sim.scene.size() - 1);
  for (std::size_t a = 0; a < T_first_scan.size(); ++a) {
    for (std::size_t b = a + 1; b < T_first_scan.size(); ++b) {
      for (std::size_t p = 0; p < sim.scene.size(); p += 3) {
        const std::size_t q = p % 10 == 0 ? any(random) : p;
        if (track_of[a][p] >= 0 && track_of[b][q] >= 0) {
          sim.tracks.matches.push_back({track_of[a][p], track_of[b][q]});
        }
      }
    }
  }
  return sim;
}

/// RMS angle between the rays of two lenses over the image within `field` [deg], rays of `b` scaled
/// in z.
double angleRms(const LensModel& truth, const LensModel& fitted, double field, double c = 1.0) {
  double sum = 0.0;
  int count = 0;
  for (int v = 0; v < 960; v += 16) {
    for (int u = 0; u < 1280; u += 16) {
      const auto a = truth.unproject({u, v});
      if (!a || std::acos(a->z()) > field * kDegree) continue;
      auto b = fitted.unproject({u, v});
      if (!b) continue;
      b->z() *= c;
      const double angle = std::atan2(a->cross(*b).norm(), a->dot(*b));
      sum += angle * angle;
      ++count;
    }
  }
  EXPECT_GT(count, 2000);
  return std::sqrt(sum / count) / kDegree;
}

double bestAngleRms(const LensModel& truth, const LensModel& fitted, double field) {
  double best = 1e9;
  for (double c = 0.3; c < 3.0; c *= 1.002)
    best = std::min(best, angleRms(truth, fitted, field, c));
  return best;
}

TEST(TargetFree, ThreeTurnedScansFixEverything) {
  const Simulation sim = simulate({Pose::Identity(), turned(25, 5, 3, {0.1, 0.05, -0.1}),
                                   turned(-8, -22, 10, {-0.2, 0.1, 0.1})},
                                  0.1, 1);
  const TargetFreeResult result = calibrateTargetFree(sim.tracks, {});
  EXPECT_EQ(result.scale, SurfaceScale::kRotatedScans);
  EXPECT_LT(result.scale_sigma, 0.005);
  EXPECT_LT(angleRms(*sim.lens, *result.file.lens, 90.0), 0.05);
  ASSERT_TRUE(result.file.stage_axis);
  EXPECT_LT(std::acos(std::min(1.0, result.file.stage_axis->dot(sim.axis))) / kDegree, 0.05);
  ASSERT_EQ(result.T_first_scan.size(), 3u);
  for (int k : {1, 2}) {
    const Pose error = result.T_first_scan[k].inverse() * sim.T_first_scan[k];
    EXPECT_LT(Eigen::AngleAxisd(error.linear()).angle() / kDegree, 0.1);
    EXPECT_LT(error.translation().norm(), 0.005);
  }
}

TEST(TargetFree, OneScanLeavesExactlyOneScaleOpenAndSaysSo) {
  const Simulation sim = simulate({Pose::Identity()}, 0.1, 2, 1500);
  const TargetFreeResult result = calibrateTargetFree(sim.tracks, {});
  EXPECT_EQ(result.scale, SurfaceScale::kFree);
  EXPECT_TRUE(std::isinf(result.scale_sigma));
  EXPECT_FALSE(result.warnings.empty());
  EXPECT_FALSE(result.file.covariance);
  // Across the axis of travel the centre is the weakest: h + p x is removed by the rim alone.
  EXPECT_LT(bestAngleRms(*sim.lens, *result.file.lens, 90.0), 0.1);
}

TEST(TargetFree, TurningAboutTheOpticalAxisDoesNotHelp) {
  const Simulation sim = simulate({Pose::Identity(), turned(0, 0, 40, {0.1, 0.0, 0.0})}, 0.1, 3);
  const TargetFreeResult result = calibrateTargetFree(sim.tracks, {});
  EXPECT_EQ(result.scale, SurfaceScale::kFree);
  EXPECT_TRUE(result.joined[1]);
  EXPECT_LT(bestAngleRms(*sim.lens, *result.file.lens, 90.0), 0.05);
}

TEST(TargetFree, AKnownAngleFixesTheScale) {
  const Simulation sim = simulate({Pose::Identity()}, 0.1, 4);
  TargetFreeOptions options;
  KnownAngle known;
  known.first = {400.0, 450.0};
  known.second = {880.0, 500.0};
  known.angle =
      std::acos(sim.lens->unproject(known.first)->dot(*sim.lens->unproject(known.second)));
  options.known_angle = known;
  const TargetFreeResult result = calibrateTargetFree(sim.tracks, options);
  EXPECT_EQ(result.scale, SurfaceScale::kKnownAngle);
  EXPECT_LT(angleRms(*sim.lens, *result.file.lens, 90.0), 0.1);
  const LensModel& lens = *result.file.lens;
  EXPECT_NEAR(std::acos(lens.unproject(known.first)->dot(*lens.unproject(known.second))),
              known.angle, 1e-5);
}

ViewDetections boardView(const Simulation& sim, double tilt_deg, double noise_px) {
  ViewDetections view;
  view.name = "board";
  std::mt19937 random(9);
  std::normal_distribution<double> noise(0.0, noise_px);
  const Pose T = turned(0.4 * tilt_deg, tilt_deg, 5, {-0.1, -0.1, 0.4});
  for (int y = 0; y < 6; ++y) {
    for (int x = 0; x < 9; ++x) {
      const Eigen::Vector3d point(0.04 * x, 0.04 * y, 0.0);
      const auto pixel = sim.lens->project(T * point);
      EXPECT_TRUE(pixel);
      view.points.push_back(point);
      view.pixels.push_back(*pixel + Eigen::Vector2d(noise(random), noise(random)));
    }
  }
  return view;
}

TEST(TargetFree, OneTiltedBoardFixesTheScale) {
  const Simulation sim = simulate({Pose::Identity()}, 0.1, 5);
  TargetFreeOptions options;
  options.boards.image_size = sim.tracks.image_size;
  options.boards.views = {boardView(sim, 30.0, 0.1)};
  const TargetFreeResult result = calibrateTargetFree(sim.tracks, options);
  EXPECT_EQ(result.scale, SurfaceScale::kBoard);
  EXPECT_LT(angleRms(*sim.lens, *result.file.lens, 90.0), 0.15);
}

TEST(TargetFree, RefusesWhatItCannotUse) {
  Simulation sim = simulate({Pose::Identity()}, 0.1, 6);
  FeatureTracks few = sim.tracks;
  few.tracks.resize(20);
  EXPECT_THROW(calibrateTargetFree(few, {}), Error);
  // Nothing moves: no parallax.
  FeatureTracks still = sim.tracks;
  for (FeatureTrack& track : still.tracks) {
    for (auto& o : track.observations) o.pixel = track.observations.front().pixel;
  }
  EXPECT_THROW(calibrateTargetFree(still, {}), Error);
}

TEST(TargetFree, ScaledSurfacesHaveScaledRays) {
  const Simulation sim = simulate({Pose::Identity()}, 0.0, 7);
  const LensPtr scaled = scaleSurface(*sim.lens, 1.2);
  ASSERT_TRUE(scaled);
  int compared = 0;
  for (double u = 100; u < 1200; u += 50) {
    auto ray = sim.lens->unproject({u, 480.0});
    if (!ray) continue;
    ray->z() *= 1.2;
    const auto pixel = scaled->project(*ray);
    ASSERT_TRUE(pixel);
    EXPECT_NEAR((*pixel - Eigen::Vector2d(u, 480.0)).norm(), 0.0, 0.05);
    ++compared;
  }
  EXPECT_GT(compared, 15);
  EXPECT_FALSE(scaleSurface(*sim.lens, 0.0));
}

}  // namespace
}  // namespace omnister
