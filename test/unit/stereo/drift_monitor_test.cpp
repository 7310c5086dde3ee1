// SPDX-License-Identifier: Apache-2.0
// Drift of lens and pose, on rendered pairs of a room whose calibration is right or not.
#include "omnister/stereo/drift_monitor.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <string>

#include "omnister/common/error.h"
#include "omnister/lens/lens_models.h"
#include "omnister/sim/renderer.h"

namespace omnister {
namespace {

using State = DriftVerdict::State;

constexpr int kPairs = 3;
const cv::Size kSize(640, 480);

LensPtr lensOf(double focal_px, const Eigen::Vector2d& center) {
  LensStructure structure;
  structure.model = "conic";
  return makeLens(structure, center, focal_px, 1.5);
}

LensPtr trueLens() { return lensOf(200.0, {320.0, 238.0}); }

/// A lens whose rays at the rim lie some pixels off those of the true one.
LensPtr bentLens(double share) {
  const LensPtr lens = trueLens();
  Eigen::VectorXd parameters = lens->parameters();
  const auto names = lens->parameterNames();
  for (std::size_t i = 0; i < names.size(); ++i) {
    if (names[i] == "alpha") parameters[static_cast<Eigen::Index>(i)] *= 1.0 + share;
  }
  return lens->withParameters(parameters, lens->maxTheta());
}

/// The rig on its stage: three steps to and fro in a room, seen once and kept.
struct Room {
  struct Pair {
    cv::Mat reference, displaced;
    Pose T_ref_disp = Pose::Identity();
  };
  std::vector<Pair> pairs;

  Room() {
    const auto scene =
        sim::readScene(std::string(OMNISTER_SOURCE_DIR) + "/config/scenes/room.yaml");
    const sim::Renderer renderer(*trueLens(), kSize);
    sim::RenderOptions options;
    options.adaptive = true;
    options.color = false;
    options.noise_sigma = 2.0;
    const auto at = [](double x) {
      Pose pose = Pose::Identity();
      pose.translation().x() = x;
      return pose;
    };
    const double places[kPairs][2] = {{0.0, 0.15}, {0.15, 0.0}, {0.05, 0.2}};
    for (const auto& place : places) {
      Pair pair;
      pair.reference = renderer.render(*scene, at(place[0]), options).image;
      ++options.seed;
      pair.displaced = renderer.render(*scene, at(place[1]), options).image;
      ++options.seed;
      pair.T_ref_disp = at(place[1] - place[0]);
      pairs.push_back(pair);
    }
  }
};

const Room& room() {
  static const Room kept;
  return kept;
}

/// Matches the room with this lens. A right camera of two that is turned about its axis sees only
/// the pairs in which it stands on the right.
DriftVerdict watch(const LensPtr& lens, double turned_degrees = 0.0) {
  const Eigen::AngleAxisd turn(turned_degrees * M_PI / 180.0, Eigen::Vector3d::UnitZ());
  DriftMonitor monitor;
  int time = 0;
  for (const Room::Pair& pair : room().pairs) {
    StereoGeometry geometry;
    geometry.reference_lens = lens;
    geometry.reference_size = kSize;
    if (turned_degrees != 0.0 && pair.T_ref_disp.translation().x() < 0.0) continue;
    geometry.displaced = {{lens, kSize, pair.T_ref_disp * turn}};
    MatcherOptions matching;
    matching.max_range = 20.0;
    const MatchResult match =
        makeMatcher("sweep", geometry, matching)->match(pair.reference, {pair.displaced});
    EXPECT_GT(monitor.add(++time, geometry, pair.reference, pair.displaced, match.range), 60);
  }
  return monitor.verdict();
}

void print(const char* what, const DriftVerdict& verdict) {
  std::printf("%s: drift %.3f px, at least %.3f, noise %.3f, %d features in %d parts\n", what,
              verdict.drift_px, verdict.at_least_px, verdict.noise_px, verdict.features,
              verdict.parts);
}

TEST(DriftMonitor, IsStillWhereLensAndPoseAreRight) {
  const DriftVerdict verdict = watch(trueLens());
  print("right", verdict);
  EXPECT_EQ(verdict.state, State::kGood);
  EXPECT_LT(verdict.drift_px, 0.2);
  EXPECT_LT(verdict.at_least_px, 0.15);
  EXPECT_EQ(verdict.pairs, kPairs);
  EXPECT_GE(verdict.parts, 12);
  EXPECT_GT(verdict.features, 200);
}

TEST(DriftMonitor, TellsOfALensThatIsNoLongerThatOfTheCamera) {
  const DriftVerdict little = watch(bentLens(0.02));
  print("lens bent a little", little);
  EXPECT_EQ(little.state, State::kGood);
  const DriftVerdict bent = watch(bentLens(0.1));
  print("bent lens", bent);
  EXPECT_EQ(bent.state, State::kWarning);
  EXPECT_GT(bent.drift_px, little.drift_px);
  const DriftVerdict other = watch(lensOf(200.0, {350.0, 260.0}));
  print("another lens", other);
  EXPECT_EQ(other.state, State::kWarning);
}

TEST(DriftMonitor, TellsOfATurnedCamera) {
  const auto turned = [](double degrees) {
    const DriftVerdict verdict = watch(trueLens(), degrees);
    print("turned", verdict);
    return verdict.state;
  };
  EXPECT_EQ(turned(0.05), State::kGood);
  EXPECT_EQ(turned(0.4), State::kWarning);
  EXPECT_EQ(turned(2.0), State::kError);
}

TEST(DriftMonitor, SaysNothingWithoutFeatures) {
  StereoGeometry geometry;
  geometry.reference_lens = trueLens();
  geometry.reference_size = kSize;
  geometry.displaced = {{trueLens(), kSize, room().pairs[0].T_ref_disp}};
  const cv::Mat grey(kSize, CV_8UC1, cv::Scalar(90));
  const cv::Mat range(kSize, CV_32FC1, cv::Scalar(2.0));
  DriftMonitor monitor;
  EXPECT_EQ(monitor.add(1.0, geometry, grey, grey, range), 0);
  EXPECT_EQ(monitor.verdict().state, State::kUnknown);
  EXPECT_THROW(monitor.add(2.0, geometry, grey, cv::Mat(), range), Error);
  EXPECT_THROW(monitor.add(2.0, geometry, grey, grey, grey), Error);
}

TEST(DriftMonitor, ForgetsWhatIsOldAndOtherLenses) {
  DriftOptions options;
  options.window = 10.0;
  DriftMonitor monitor(options);
  const Room::Pair& pair = room().pairs[0];
  StereoGeometry geometry;
  geometry.reference_lens = trueLens();
  geometry.reference_size = kSize;
  geometry.displaced = {{geometry.reference_lens, kSize, pair.T_ref_disp}};
  // The sky is far away: features stay in their places.
  const cv::Mat range(kSize, CV_32FC1, cv::Scalar(1e6));
  const auto pairs_after = [&](double time) {
    EXPECT_GT(monitor.add(time, geometry, pair.reference, pair.reference, range), 60);
    return monitor.verdict().pairs;
  };
  EXPECT_EQ(pairs_after(1.0), 1);
  EXPECT_EQ(pairs_after(9.0), 2);
  EXPECT_EQ(pairs_after(12.0), 2);
  EXPECT_EQ(pairs_after(3.0), 1) << "the clock went back";
  geometry.displaced[0].lens = trueLens();
  EXPECT_EQ(pairs_after(4.0), 1) << "another lens";
  EXPECT_NEAR(monitor.verdict().drift_px, 0.0, 0.01);
  EXPECT_THROW(DriftMonitor(DriftOptions{0}), Error);
}

}  // namespace
}  // namespace omnister
