// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/feature_tracks.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <set>
#include <string>

#include "full_tests.h"
#include "omnister/calibration/target_free.h"
#include "omnister/common/error.h"
#include "rendered_scans.h"
#include "unit/stereo/real_data.h"

namespace omnister {
namespace {

constexpr double kDegree = M_PI / 180.0;

using test::angleRms;
using test::bestAngleRms;
using test::RenderedScans;
using test::renderScans;

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
  if (!test::fullTests()) GTEST_SKIP() << "runs with ./run test --full";
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
  if (!test::fullTests()) GTEST_SKIP() << "runs with ./run test --full";
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
