// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/feature_tracks.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <set>
#include <string>

#include "omnister/calibration/target_free.h"
#include "omnister/common/error.h"
#include "omnister/sim/renderer.h"
#include "unit/stereo/real_data.h"

namespace omnister {
namespace {

constexpr double kDegree = M_PI / 180.0;

struct RenderedScans {
  LensPtr lens;
  Eigen::Vector3d axis = Eigen::Vector3d(0.998, -0.02, 0.05).normalized();
  std::vector<Pose> T_world_scan;
  std::vector<StageScan> scans;
  std::vector<cv::Mat> middle_range;  ///< of the middle image of every scan [m]
};

RenderedScans renderScans(cv::Size size, double focal, int positions, int orientations) {
  RenderedScans result;
  LensStructure structure;
  structure.model = "asphere";
  structure.even_terms = 1;
  result.lens = makeLens(structure, {0.51 * size.width, 0.49 * size.height}, focal, 95.0 * kDegree);
  const sim::ScenePtr scene =
      sim::readScene(std::string(OMNISTER_SOURCE_DIR) + "/config/scenes/room.yaml");
  const sim::Renderer renderer(*result.lens, size);
  const double turns[3][3] = {{0, 0, 0}, {24, 6, 4}, {-6, -22, -8}};
  for (int k = 0; k < orientations; ++k) {
    Pose pose = Pose::Identity();
    pose.linear() = (Eigen::AngleAxisd(turns[k][0] * kDegree, Eigen::Vector3d::UnitY()) *
                     Eigen::AngleAxisd(turns[k][1] * kDegree, Eigen::Vector3d::UnitX()) *
                     Eigen::AngleAxisd(turns[k][2] * kDegree, Eigen::Vector3d::UnitZ()))
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

TEST(FeatureTracks, FollowsRenderedPointsAndMatchesTurnedScans) {
  const RenderedScans rendered = renderScans({640, 480}, 150.0, 5, 2);
  TrackingOptions options;
  options.features_per_scan = 600;
  const FeatureTracks tracks = trackFeatures(rendered.scans, options);
  EXPECT_EQ(tracks.image_size, cv::Size(640, 480));

  std::vector<double> errors;
  const auto worldPoint = [&](const FeatureTrack& track) -> std::optional<Eigen::Vector3d> {
    for (const auto& o : track.observations) {
      if (o.image != 2) continue;
      const auto ray = rendered.lens->unproject(o.pixel);
      const float range = rendered.middle_range[o.scan].at<float>(
          static_cast<int>(std::lround(o.pixel.y())), static_cast<int>(std::lround(o.pixel.x())));
      if (!ray || !std::isfinite(range)) return std::nullopt;
      return rendered.T_world_scan[o.scan] * Eigen::Vector3d(range * *ray);
    }
    return std::nullopt;
  };
  for (const FeatureTrack& track : tracks.tracks) {
    const auto point = worldPoint(track);
    if (!point) continue;
    for (const auto& o : track.observations) {
      const Eigen::Vector3d X = rendered.T_world_scan[o.scan].inverse() * *point -
                                tracks.positions_m[o.scan][o.image] * rendered.axis;
      const auto pixel = rendered.lens->project(X);
      if (pixel && o.image != 2) errors.push_back((*pixel - o.pixel).norm());
    }
  }
  ASSERT_GT(errors.size(), 1500u);
  std::sort(errors.begin(), errors.end());
  EXPECT_LT(errors[errors.size() / 2], 0.15);
  EXPECT_LT(errors[errors.size() * 8 / 10], 0.6);

  ASSERT_GT(tracks.matches.size(), 40u);
  int right = 0;
  int judged = 0;
  for (const TrackMatch& match : tracks.matches) {
    const auto a = worldPoint(tracks.tracks[match.first]);
    const auto b = worldPoint(tracks.tracks[match.second]);
    if (!a || !b) continue;
    ++judged;
    if ((*a - *b).norm() < 0.05) ++right;
  }
  EXPECT_GT(judged, 30);
  EXPECT_GT(right, judged / 2);
}

TEST(FeatureTracks, RefusesScansThatAreNone) {
  StageScan scan;
  EXPECT_THROW(trackFeatures({}), Error);
  scan.images = {cv::Mat(64, 64, CV_8UC1, cv::Scalar(0))};
  scan.positions_m = {0.0};
  EXPECT_THROW(trackFeatures({scan}), Error);
  scan.images.push_back(cv::Mat(64, 65, CV_8UC1, cv::Scalar(0)));
  scan.positions_m = {0.0, 0.1};
  EXPECT_THROW(trackFeatures({scan}), Error);
  scan.images[1] = scan.images[0];
  scan.positions_m = {0.1, 0.1};
  EXPECT_THROW(trackFeatures({scan}), Error);
  scan.positions_m = {0.0, 0.1};
  EXPECT_TRUE(trackFeatures({scan}).tracks.empty());
}

double angleRms(const LensModel& truth, const LensModel& fitted, cv::Size size, double c) {
  double sum = 0.0;
  int count = 0;
  for (int v = 0; v < size.height; v += 8) {
    for (int u = 0; u < size.width; u += 8) {
      const auto a = truth.unproject({u, v});
      auto b = fitted.unproject({u, v});
      if (!a || !b || std::acos(a->z()) > 90.0 * kDegree) continue;
      b->z() *= c;
      const double angle = std::atan2(a->cross(*b).norm(), a->dot(*b));
      sum += angle * angle;
      ++count;
    }
  }
  EXPECT_GT(count, 2000);
  return std::sqrt(sum / count) / kDegree;
}

double bestAngleRms(const LensModel& truth, const LensModel& fitted, cv::Size size) {
  double best = 1e9;
  for (double c = 0.5; c < 2.0; c *= 1.002) {
    best = std::min(best, angleRms(truth, fitted, size, c));
  }
  return best;
}

TEST(FeatureTracks, LensFromARenderedRoom) {
  const cv::Size size(640, 480);
  const RenderedScans rendered = renderScans(size, 150.0, 5, 2);
  TrackingOptions tracking;
  tracking.features_per_scan = 500;
  const TargetFreeResult paths = calibrateTargetFree(trackFeatures(rendered.scans, tracking), {});
  TargetFreeOptions options;
  options.grow = false;
  const TargetFreeResult result = calibrateTargetFree(rendered.scans, tracking, options);
  EXPECT_EQ(result.scale, SurfaceScale::kRotatedScans);
  const double before = angleRms(*rendered.lens, *paths.file.lens, size, 1.0);
  const double after = angleRms(*rendered.lens, *result.file.lens, size, 1.0);
  std::printf("paths alone %.4f deg RMS, measured through the lens %.4f\n", before, after);
  EXPECT_LT(after, 0.03);
  EXPECT_LT(after, 0.5 * before);
  // The round picture ends at 95 degrees: nothing may be taken for scene beyond, little be missed.
  EXPECT_NEAR(result.file.lens->maxTheta(), 95.0 * kDegree, 3.0 * kDegree);
  EXPECT_LT(std::acos(std::min(1.0, result.file.stage_axis->dot(rendered.axis))), 0.05 * kDegree);
  ASSERT_FALSE(result.track_points.empty());
}

TEST(FeatureTracks, LensFromARenderedRoomInFull) {
  const char* full = std::getenv("OMNISTER_FULL_TESTS");
  if (full == nullptr || std::string(full) != "ON") GTEST_SKIP() << "runs with ./run test --full";
  const cv::Size size(1280, 960);
  const RenderedScans rendered = renderScans(size, 300.0, 9, 3);
  TrackingOptions tracking;
  tracking.features_per_scan = 2000;
  {
    const TargetFreeResult result = calibrateTargetFree(rendered.scans, tracking, {});
    EXPECT_EQ(result.scale, SurfaceScale::kRotatedScans);
    const double rms = angleRms(*rendered.lens, *result.file.lens, size, 1.0);
    std::printf("three scans: %.4f deg RMS, sigma of log c %.5f, %.3f px, %d points\n", rms,
                result.scale_sigma, result.rms_px, result.points);
    EXPECT_LT(rms, 0.01);
    EXPECT_LT(std::acos(std::min(1.0, result.file.stage_axis->dot(rendered.axis))), 0.01 * kDegree);
  }
  const TargetFreeResult result = calibrateTargetFree({rendered.scans[0]}, tracking, {});
  EXPECT_EQ(result.scale, SurfaceScale::kFree);
  const double best = bestAngleRms(*rendered.lens, *result.file.lens, size);
  std::printf("one scan, free scale fitted: %.4f deg RMS, %.3f px, %d points\n", best,
              result.rms_px, result.points);
  EXPECT_LT(best, 0.03);
}

// A car that turns by half a degree on its way is no stage: what comes of it, up to the one scale.
TEST(FeatureTracks, LensFromACarThatSlidesSideways) {
  const char* full = std::getenv("OMNISTER_FULL_TESTS");
  if (full == nullptr || std::string(full) != "ON") GTEST_SKIP() << "runs with ./run test --full";
  if (!std::filesystem::exists(test::dataFolder("planesweep_car_fisheye"))) {
    GTEST_SKIP() << "planesweep_car_fisheye is not there";
  }
  const test::CarSequence car = test::readCarSequence("left");
  const std::size_t middle = car.images.size() / 2;
  const Eigen::Vector3d way =
      car.T_ref_disp(middle, car.images.size() - 1).translation().normalized();
  StageScan scan;
  for (std::size_t i = middle - 2; i <= middle + 2; ++i) {
    scan.images.push_back(car.image(i));
    scan.positions_m.push_back(i == middle ? 0.0
                                           : car.T_ref_disp(middle, i).translation().dot(way));
  }
  TrackingOptions tracking;
  tracking.features_per_scan = 2000;
  const TargetFreeResult result = calibrateTargetFree({scan}, tracking, {});
  EXPECT_EQ(result.scale, SurfaceScale::kFree);
  const double best = bestAngleRms(*car.lens.lens, *result.file.lens, car.size);
  std::printf("car, free scale fitted: %.3f deg RMS, %.3f px, %d points\n", best, result.rms_px,
              result.points);
  EXPECT_LT(best, 1.2);
  EXPECT_LT(std::acos(std::min(1.0, result.file.stage_axis->dot(way))), 2.0 * kDegree);
}

}  // namespace
}  // namespace omnister
