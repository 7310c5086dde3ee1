// SPDX-License-Identifier: Apache-2.0
// The oracle against scenes that are known in closed form. Errors are counted in pixels of the
// path, so that one bound serves every lens, pose and depth.
#include "omnister/stereo/thesis_matcher.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <iostream>
#include <vector>

#include "analytic_scene.h"
#include "omnister/common/error.h"
#include "omnister/lens/lens_models.h"
#include "omnister/stereo/epipolar.h"

namespace omnister {
namespace {

using test::look;
using test::pose;

const cv::Size kSize(128, 96);

struct Accuracy {
  double density = 0.0;        ///< of the pixels whose point the displaced images see
  double median_px = 0.0;      ///< along the path
  double median_error = 0.0;   ///< share of the range
  double beyond_one_px = 0.0;  ///< share of the valid pixels
  std::size_t visible = 0;
};

// Pixels with at least `least_path` px of parallax whose point lies inside the displaced image with
// `border` px to spare, and inside the reference image likewise.
Accuracy compare(const MatchResult& match, const test::View& truth, const StereoGeometry& geometry,
                 const cv::Mat& mask, double least_path = 2.0, int border = 8) {
  Accuracy accuracy;
  std::vector<double> errors_px, errors;
  std::size_t wrong = 0;
  const auto& camera = geometry.displaced[0];
  for (int v = border; v < truth.range.rows - border; ++v) {
    for (int u = border; u < truth.range.cols - border; ++u) {
      const double range = truth.range.at<double>(v, u);
      if (!mask.empty() && mask.at<uchar>(v, u) == 0) continue;
      const auto ray =
          geometry.reference_lens->unproject({static_cast<double>(u), static_cast<double>(v)});
      if (!ray || !std::isfinite(range)) continue;
      const EpipolarCurve curve(*ray, camera.T_ref_disp, *camera.lens);
      const auto place = curve.pixel(1.0 / range);
      const auto far = curve.pixel(0.0);
      if (!place || !far || (*place - *far).norm() < least_path) continue;
      if (place->x() < border || place->y() < border ||
          place->x() > camera.size.width - 1 - border ||
          place->y() > camera.size.height - 1 - border) {
        continue;
      }
      // The mask and the next candidate need room as well, inside image and field.
      bool room = true;
      for (double du : {-1.0, 0.0, 1.0}) {
        for (double dv : {-1.0, 0.0, 1.0}) {
          room = room && camera.lens->unproject(*place + border * Eigen::Vector2d(du, dv));
        }
      }
      if (!room) continue;
      ++accuracy.visible;
      const double found = match.range.at<float>(v, u);
      if (!std::isfinite(found)) continue;
      const auto matched = curve.pixel(1.0 / found);
      errors.push_back(std::abs(found - range) / range);
      errors_px.push_back(matched ? (*matched - *place).norm() : 1e9);
      wrong += errors_px.back() > 1.0;
    }
  }
  if (errors.empty()) return accuracy;
  const auto median = [](std::vector<double>& values) {
    std::nth_element(values.begin(), values.begin() + values.size() / 2, values.end());
    return values[values.size() / 2];
  };
  accuracy.density = static_cast<double>(errors.size()) / accuracy.visible;
  accuracy.beyond_one_px = static_cast<double>(wrong) / errors.size();
  accuracy.median_px = median(errors_px);
  accuracy.median_error = median(errors);
  return accuracy;
}

std::ostream& operator<<(std::ostream& out, const Accuracy& a) {
  return out << a.visible << " visible, density " << a.density << ", median " << a.median_px
             << " px, " << 100.0 * a.median_error << " %, beyond 1 px " << 100.0 * a.beyond_one_px
             << " %";
}

LensPtr lensOf(const std::string& model, double focal = 55.0, double max_theta = 1.3) {
  LensStructure structure;
  structure.model = model;
  if (model == "asphere") structure.even_terms = 2;
  return makeLens(structure, {63.2, 47.9}, focal, max_theta);
}

StereoGeometry geometryOf(const LensPtr& lens, const std::vector<Pose>& poses) {
  StereoGeometry geometry;
  geometry.reference_lens = lens;
  geometry.reference_size = kSize;
  for (const Pose& T : poses) geometry.displaced.push_back({lens, kSize, T});
  return geometry;
}

// One pixel of four: the oracle is slow.
cv::Mat oneOfFour() {
  cv::Mat mask(kSize, CV_8UC1, cv::Scalar(0));
  for (int v = 0; v < kSize.height; v += 2) {
    for (int u = 0; u < kSize.width; u += 2) mask.at<uchar>(v, u) = 255;
  }
  return mask;
}

struct Match {
  MatchResult result;
  Accuracy accuracy;
};

Match matchScene(const std::vector<test::Rectangle>& scene, const StereoGeometry& geometry,
                 MatcherOptions options = {}, const ThesisOptions& thesis = {},
                 double least_path = 2.0) {
  const test::View reference = look(scene, *geometry.reference_lens, kSize, Pose::Identity());
  std::vector<cv::Mat> displaced;
  for (const auto& camera : geometry.displaced) {
    displaced.push_back(look(scene, *camera.lens, kSize, camera.T_ref_disp).image);
  }
  Match match;
  match.result = makeThesisMatcher(geometry, options, thesis)->match(reference.image, displaced);
  match.accuracy = compare(match.result, reference, geometry, options.mask, least_path);
  return match;
}

class EveryModel : public ::testing::TestWithParam<std::string> {};

TEST_P(EveryModel, AWallFromASidewaysMove) {
  const StereoGeometry geometry = geometryOf(lensOf(GetParam()), {pose(0.3, 0, 0)});
  MatcherOptions options;
  options.min_range = 1.2;
  options.mask = oneOfFour();
  const Match match = matchScene(test::wall(2.0, 0.25), geometry, options);
  std::cout << GetParam() << ": " << match.accuracy << '\n';
  EXPECT_GT(match.accuracy.visible, 1500u);
  EXPECT_GT(match.accuracy.density, 0.98);
  EXPECT_LT(match.accuracy.median_px, 0.06);
  EXPECT_LT(match.accuracy.median_error, 0.01);
  EXPECT_LT(match.accuracy.beyond_one_px, 0.03);
}

INSTANTIATE_TEST_SUITE_P(Shipped, EveryModel, ::testing::ValuesIn(lensModelNames()),
                         [](const auto& info) { return info.param; });

struct PoseCase {
  const char* name;
  Pose T;
  std::size_t least_visible;
};

class EveryPose : public ::testing::TestWithParam<PoseCase> {};

// A room seen all around, past 90 degrees off the axis.
TEST_P(EveryPose, ARoom) {
  const StereoGeometry geometry = geometryOf(lensOf("conic", 30.0, 1.8), {GetParam().T});
  MatcherOptions options;
  options.min_range = 1.0;
  options.mask = oneOfFour();
  ThesisOptions thesis;
  thesis.window = 7;
  const Match match = matchScene(test::room(2.0, 0.5), geometry, options, thesis);
  EXPECT_GT(match.accuracy.visible, GetParam().least_visible);
  EXPECT_GT(match.accuracy.density, 0.97);
  EXPECT_LT(match.accuracy.median_px, 0.15);
  EXPECT_LT(match.accuracy.beyond_one_px, 0.06);
}

INSTANTIATE_TEST_SUITE_P(
    Known, EveryPose,
    ::testing::Values(PoseCase{"Sideways", pose(0.4, 0, 0), 900},
                      PoseCase{"Left", pose(-0.4, 0, 0), 900},
                      PoseCase{"Up", pose(0, -0.4, 0), 900},
                      PoseCase{"Forward", pose(0, 0, 0.4), 650},
                      PoseCase{"Turned", pose(0.35, 0.1, -0.1, 0.2, {0.2, 1.0, 0.5}), 775},
                      PoseCase{"UpsideDown", pose(0.3, 0.2, 0.1, 3.0, {0.1, 0.0, 1.0}), 775}),
    [](const auto& info) { return info.param.name; });

TEST(ThesisMatcher, MaskOfFig54AgreesOnAWall) {
  ThesisOptions thesis;
  thesis.mask = ThesisMask::kDewarpedSquare;
  MatcherOptions options;
  options.min_range = 1.2;
  options.mask = oneOfFour();
  // A mask of the dewarped space covers few distorted pixels far off the axis: a narrower field.
  const StereoGeometry geometry = geometryOf(lensOf("quadric", 75.0, 0.9), {pose(0.3, 0, 0)});
  const Match dewarped = matchScene(test::wall(2.0, 0.25), geometry, options, thesis);
  const Match distorted = matchScene(test::wall(2.0, 0.25), geometry, options);
  std::cout << "fig. 5.4: " << dewarped.accuracy << "\nfig. 5.5: " << distorted.accuracy << '\n';
  EXPECT_GT(dewarped.accuracy.density, 0.98);
  EXPECT_LT(dewarped.accuracy.median_px, 0.06);
  EXPECT_GT(distorted.accuracy.density, 0.98);
  int compared = 0, apart = 0;
  for (int v = 0; v < kSize.height; ++v) {
    for (int u = 0; u < kSize.width; ++u) {
      const double a = dewarped.result.range.at<float>(v, u),
                   b = distorted.result.range.at<float>(v, u);
      if (!std::isfinite(a) || !std::isfinite(b)) continue;
      ++compared;
      apart += std::abs(a - b) > 0.05 * b;
    }
  }
  EXPECT_GT(compared, 1500);
  EXPECT_LT(apart, 0.05 * compared);
}

// Eq. 2.1 is used for an exact sideways move, eqs 2.2-2.9 for any other.
TEST(ThesisMatcher, BothWaysToDepthAgree) {
  const std::vector<test::Rectangle> scene = test::wall(2.0, 0.25);
  MatcherOptions options;
  options.mask = oneOfFour();
  options.min_range = 1.2;
  const LensPtr lens = lensOf("conic");
  const Match pinhole = matchScene(scene, geometryOf(lens, {pose(0.3, 0, 0)}), options);
  const Match rays = matchScene(scene, geometryOf(lens, {pose(0.3, 1e-11, 0)}), options);
  int same = 0, valid = 0;
  for (int v = 0; v < kSize.height; ++v) {
    for (int u = 0; u < kSize.width; ++u) {
      const double a = pinhole.result.range.at<float>(v, u), b = rays.result.range.at<float>(v, u);
      valid += std::isfinite(a);
      same += std::isfinite(a) && std::abs(a - b) < 1e-5 * a;
    }
  }
  EXPECT_GT(valid, 1700);
  EXPECT_GE(same, valid - 2);
}

TEST(ThesisMatcher, MorePositionsAreMoreAccurate) {
  MatcherOptions options;
  options.mask = oneOfFour();
  options.min_range = 1.2;
  const LensPtr lens = lensOf("conic");
  const std::vector<test::Rectangle> scene = test::wall(2.0, 0.25);
  const Match two = matchScene(scene, geometryOf(lens, {pose(0.15, 0, 0)}), options, {}, 1.0);
  const Match four =
      matchScene(scene, geometryOf(lens, {pose(0.15, 0, 0), pose(0.3, 0, 0), pose(-0.3, 0, 0)}),
                 options, {}, 1.0);
  std::cout << "two: " << two.accuracy << "\nfour: " << four.accuracy << '\n';
  EXPECT_LT(four.accuracy.median_error, 0.75 * two.accuracy.median_error);
  EXPECT_LT(four.accuracy.beyond_one_px, 0.02);
}

TEST(ThesisMatcher, SigmaIsInProportionToTheSquareOfTheRange) {
  MatcherOptions options;
  options.mask = oneOfFour();
  options.min_range = 1.2;
  const StereoGeometry geometry = geometryOf(lensOf("conic"), {pose(0.3, 0, 0)});
  const Match near = matchScene(test::wall(2.0, 0.25), geometry, options);
  const Match far = matchScene(test::wall(4.0, 0.25), geometry, options);
  const float a = near.result.sigma.at<float>(48, 64), b = far.result.sigma.at<float>(48, 64);
  // A quarter pixel: 0.25 / (55 px/rad) Z^2 / b.
  EXPECT_NEAR(a, 0.25 / 55.0 * 4.0 / 0.3, 0.01);
  EXPECT_NEAR(b / a, 4.0, 0.6);
}

TEST(ThesisMatcher, ResultDoesNotDependOnThreads) {
  const StereoGeometry geometry = geometryOf(lensOf("conic"), {pose(0.3, 0, 0.1, 0.1)});
  MatcherOptions options;
  options.mask = oneOfFour();
  options.threads = 1;
  const Match one = matchScene(test::wall(2.0, 0.25), geometry, options);
  options.threads = 3;
  const Match three = matchScene(test::wall(2.0, 0.25), geometry, options);
  EXPECT_EQ(one.result.statistics.valid, three.result.statistics.valid);
  EXPECT_EQ(one.result.statistics.rejected, three.result.statistics.rejected);
  EXPECT_GT(one.result.statistics.valid, 1500u);
  EXPECT_EQ(0, std::memcmp(one.result.range.data, three.result.range.data, 4u * kSize.area()));
}

TEST(ThesisMatcher, EveryPixelIsAccountedFor) {
  const StereoGeometry geometry = geometryOf(lensOf("conic", 30.0, 1.3), {pose(0.3, 0, 0)});
  MatcherOptions options;
  options.mask = cv::Mat(kSize, CV_8UC1, cv::Scalar(255));
  options.mask(cv::Rect(40, 30, 20, 10)) = 0;
  const Match match = matchScene(test::wall(2.0, 0.25), geometry, options);
  std::size_t sum = match.result.statistics.valid;
  for (const auto& [reason, count] : match.result.statistics.rejected) sum += count;
  EXPECT_EQ(sum, static_cast<std::size_t>(kSize.area()));
  EXPECT_EQ(match.result.statistics.rejected.at("masked"), 200u);
  EXPECT_GT(match.result.statistics.rejected.at("outside_field"), 2000u);
  EXPECT_TRUE(std::isnan(match.result.range.at<float>(35, 50)));
  EXPECT_GE(match.result.statistics.seconds.at("total"), 0.0);
}

TEST(ThesisMatcher, NothingToSeeGivesAnHonestEmptyResult) {
  const StereoGeometry geometry = geometryOf(lensOf("conic"), {pose(0.3, 0, 0)});
  const auto matcher = makeThesisMatcher(geometry, {});
  for (int level : {0, 255}) {
    const cv::Mat flat(kSize, CV_8UC1, cv::Scalar(level));
    const MatchResult match = matcher->match(flat, {flat});
    EXPECT_EQ(match.statistics.valid, 0u);
    EXPECT_GT(match.statistics.rejected.at("no_texture"), 7000u);
    EXPECT_EQ(cv::countNonZero(match.range == match.range), 0);
  }
  const cv::Mat dark(kSize, CV_8UC1, cv::Scalar(0));
  cv::Mat noise(kSize, CV_8UC1);
  cv::randu(noise, 0, 255);
  EXPECT_EQ(matcher->match(noise, {dark}).statistics.valid, 0u) << "all correlations are zero";
}

TEST(ThesisMatcher, RefusesOptionsWithoutSense) {
  const StereoGeometry geometry = geometryOf(lensOf("conic"), {pose(0.3, 0, 0)});
  ThesisOptions thesis;
  thesis.window = 10;
  EXPECT_THROW(makeThesisMatcher(geometry, {}, thesis), Error);
  thesis.window = 1001;
  EXPECT_THROW(makeThesisMatcher(geometry, {}, thesis), Error);
  thesis = {};
  thesis.object_plane_limit = 2.0;
  EXPECT_THROW(makeThesisMatcher(geometry, {}, thesis), Error);
  EXPECT_THROW(parseThesisMask("fig5.6"), Error);
  EXPECT_EQ(parseThesisMask("fig5.4"), ThesisMask::kDewarpedSquare);
  EXPECT_THROW(makeMatcher("best", geometry, {}), Error);
  EXPECT_NE(makeMatcher("thesis", geometry, {}), nullptr);
  // Images of a tiny camera.
  StereoGeometry tiny = geometry;
  tiny.reference_size = tiny.displaced[0].size = {1, 1};
  tiny.reference_lens = tiny.displaced[0].lens = makeLens(LensStructure{}, {0.0, 0.0}, 1.0, 1.0);
  MatcherOptions options;
  options.min_range = 0.5;
  try {
    const cv::Mat pixel(1, 1, CV_8UC1, cv::Scalar(9));
    EXPECT_EQ(makeThesisMatcher(tiny, options)->match(pixel, {pixel}).statistics.valid, 0u);
  } catch (const Error&) {
    // No path lies inside a displaced image of one pixel: refused as such.
  }
}

}  // namespace
}  // namespace omnister
