// SPDX-License-Identifier: Apache-2.0
#include "stereo/sweep/sweep_matcher.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <numeric>
#include <opencv2/core.hpp>

#include "analytic_scene.h"
#include "omnister/common/error.h"
#include "omnister/lens/lens_models.h"
#include "omnister/stereo/thesis_matcher.h"
#include "stereo/sweep/kernels/kernels.h"

namespace omnister {
namespace {

constexpr double kDegree = M_PI / 180.0;

LensPtr lensOf(const std::string& model, cv::Size size, double field_deg) {
  LensStructure structure;
  structure.model = model;
  structure.even_terms = model == "asphere" ? 2 : 0;
  const double half = field_deg / 2 * kDegree;
  return makeLens(structure, {0.5 * (size.width - 1) + 0.7, 0.5 * (size.height - 1) - 0.4},
                  0.5 * size.width / half, half);
}

struct Pair {
  StereoGeometry geometry;
  test::View reference;
  cv::Mat displaced;
};

Pair makePair(const std::vector<test::Rectangle>& scene, const LensPtr& lens, cv::Size size,
              const Pose& T_ref_disp) {
  Pair pair;
  pair.geometry.reference_lens = lens;
  pair.geometry.reference_size = size;
  pair.geometry.displaced.push_back({lens, size, T_ref_disp});
  pair.reference = test::look(scene, *lens, size, Pose::Identity(), 2);
  pair.displaced = test::look(scene, *lens, size, T_ref_disp, 2).image;
  return pair;
}

struct Quality {
  std::size_t truth = 0, found = 0;
  std::vector<double> pixels;  ///< distance from the true point in the displaced image [px]
  double density() const { return static_cast<double>(found) / static_cast<double>(truth); }
  double quantile(double share) {
    const auto at = pixels.begin() + static_cast<std::ptrdiff_t>(share * (pixels.size() - 1));
    std::nth_element(pixels.begin(), at, pixels.end());
    return *at;
  }
};

/// Over the pixels whose point the displaced camera sees well inside its image, more than 3 degrees
/// from the baseline.
Quality judge(const Pair& pair, const MatchResult& result) {
  Quality quality;
  const StereoGeometry::Displaced& displaced = pair.geometry.displaced.front();
  const Pose T_disp_ref = displaced.T_ref_disp.inverse();
  const Eigen::Vector3d e = displaced.T_ref_disp.translation().normalized();
  for (int y = 0; y < result.range.rows; ++y) {
    for (int x = 0; x < result.range.cols; ++x) {
      const double truth = pair.reference.range.at<double>(y, x);
      const auto ray = pair.geometry.reference_lens->unproject(Eigen::Vector2d(x, y));
      if (std::isnan(truth) || !ray || std::abs(ray->dot(e)) > std::cos(3 * kDegree)) continue;
      const auto at = displaced.lens->project(T_disp_ref * (truth * *ray));
      if (!at || at->x() < 4 || at->y() < 4 || at->x() > displaced.size.width - 5 ||
          at->y() > displaced.size.height - 5) {
        continue;
      }
      ++quality.truth;
      const double range = result.range.at<float>(y, x);
      if (std::isnan(range)) continue;
      ++quality.found;
      const auto found = displaced.lens->project(T_disp_ref * (range * *ray));
      quality.pixels.push_back(found ? (*found - *at).norm() : 100.0);
    }
  }
  return quality;
}

bool same(const cv::Mat& a, const cv::Mat& b) {
  if (a.size() != b.size()) return false;
  for (int y = 0; y < a.rows; ++y)
    if (std::memcmp(a.ptr(y), b.ptr(y), a.cols * a.elemSize()) != 0) return false;
  return true;
}

bool same(const MatchResult& a, const MatchResult& b) {
  return same(a.range, b.range) && same(a.sigma, b.sigma) && same(a.score, b.score) &&
         a.statistics.valid == b.statistics.valid && a.statistics.rejected == b.statistics.rejected;
}

struct Setting {
  const char* model;
  double field_deg;
  Pose T_ref_disp;
};

class EveryLensAndPose : public testing::TestWithParam<Setting> {};

TEST_P(EveryLensAndPose, FindsTheWallsOfARoom) {
  const cv::Size size(260, 230);
  const LensPtr lens = lensOf(GetParam().model, size, GetParam().field_deg);
  const Pair pair = makePair(test::room(1.6, 0.09), lens, size, GetParam().T_ref_disp);
  const MatchResult result =
      makeSweepMatcher(pair.geometry, {})->match(pair.reference.image, {pair.displaced});
  Quality quality = judge(pair, result);
  ASSERT_GT(quality.truth, 15000u);
  EXPECT_GT(quality.density(), 0.95);
  EXPECT_LT(quality.quantile(0.5), 0.12);
  EXPECT_LT(quality.quantile(0.95), 0.6);
  // The count is that of the image, and every value is a number or none.
  std::size_t valid = 0;
  for (int y = 0; y < size.height; ++y) {
    for (int x = 0; x < size.width; ++x) {
      const float range = result.range.at<float>(y, x), sigma = result.sigma.at<float>(y, x);
      const float score = result.score.at<float>(y, x);
      ASSERT_EQ(std::isnan(range), std::isnan(sigma));
      ASSERT_EQ(std::isnan(range), std::isnan(score));
      if (std::isnan(range)) continue;
      ++valid;
      ASSERT_TRUE(std::isfinite(range) && range > 0) << x << " " << y;
      ASSERT_TRUE(std::isfinite(sigma) && sigma > 0) << x << " " << y;
      ASSERT_TRUE(score >= 0 && score <= 1) << x << " " << y;
    }
  }
  EXPECT_EQ(valid, result.statistics.valid);
}

INSTANTIATE_TEST_SUITE_P(
    Sweep, EveryLensAndPose,
    testing::Values(Setting{"conic", 180, test::pose(0.15, 0, 0)},
                    Setting{"conic", 180, test::pose(-0.15, 0, 0)},
                    Setting{"asphere", 160, test::pose(0, 0.15, 0)},
                    Setting{"spline", 180, test::pose(0.01, 0.02, 0.15)},
                    Setting{"spline", 220, test::pose(0.15, 0, 0)},
                    Setting{"spline", 230, test::pose(0.02, -0.01, 0.16)},
                    Setting{"spline", 200, test::pose(0.1, 0.05, 0.08, 0.15, {0.3, 1, 0.2})},
                    Setting{"quadric", 140, test::pose(0.1, -0.1, 0.03, 0.2, {0, 0, 1})},
                    Setting{"spherical", 120, test::pose(0.12, 0.02, 0, -0.1, {1, 0, 0})}));

class SmallPair : public testing::Test {
 protected:
  static const Pair& rendered() {
    static const Pair pair = makePair(test::room(1.5, 0.1), lensOf("spline", {246, 203}, 190),
                                      {246, 203}, test::pose(0.14, 0.03, 0.02, 0.1, {0.2, 1, 0}));
    return pair;
  }
  ~SmallPair() override { sweep::holdSimd("best"); }

  MatchResult match(const MatcherOptions& options = {}) const {
    return makeSweepMatcher(pair_.geometry, options)
        ->match(pair_.reference.image, {pair_.displaced});
  }

  /// Median and 90 % quantile of errors over sigma; of a normal distribution 0.67 and 1.64.
  std::pair<double, double> errorsInSigmas(const MatchResult& result) const {
    std::vector<double> ratios;
    for (int y = 0; y < size_.height; ++y) {
      for (int x = 0; x < size_.width; ++x) {
        const double truth = pair_.reference.range.at<double>(y, x);
        const double range = result.range.at<float>(y, x);
        if (std::isnan(truth) || std::isnan(range)) continue;
        ratios.push_back(std::abs(range - truth) / result.sigma.at<float>(y, x));
      }
    }
    EXPECT_GT(ratios.size(), 20000u);
    std::sort(ratios.begin(), ratios.end());
    return {ratios[ratios.size() / 2], ratios[ratios.size() * 9 / 10]};
  }

  const cv::Size size_{246, 203};
  const Pair& pair_ = rendered();
};

TEST_F(SmallPair, IsTheSameOnEveryInstructionSet) {
  const MatchResult best = match();
  ASSERT_GT(best.statistics.valid, 20000u);
  for (const char* name : {"avx2", "sse4", "scalar"}) {
    sweep::holdSimd(name);
    EXPECT_TRUE(same(best, match())) << name << " is " << sweep::simdName();
  }
  EXPECT_THROW(sweep::holdSimd("mmx"), Error);
}

TEST_F(SmallPair, IsTheSameForAnyNumberOfThreadsAndTime) {
  MatcherOptions options;
  options.threads = 1;
  const MatchResult one = match(options);
  for (const int threads : {2, 3, 7}) {
    options.threads = threads;
    EXPECT_TRUE(same(one, match(options))) << threads;
  }
  const auto matcher = makeSweepMatcher(pair_.geometry, options);
  const MatchResult first = matcher->match(pair_.reference.image, {pair_.displaced});
  const cv::Mat kept = first.range.clone();
  const MatchResult other = matcher->match(pair_.displaced, {pair_.reference.image});
  EXPECT_TRUE(same(kept, first.range)) << "a result changed under its holder";
  EXPECT_TRUE(same(one, matcher->match(pair_.reference.image, {pair_.displaced})));
}

TEST(Sweep, AgreesWithTheThesisMatcher) {
  const cv::Size size(120, 100);
  const Pair pair = makePair(test::room(1.5, 0.16), lensOf("conic", size, 150), size,
                             test::pose(0.14, 0.03, 0.02));
  MatcherOptions options;
  options.min_range = 0.8;
  const MatchResult sweep =
      makeSweepMatcher(pair.geometry, options)->match(pair.reference.image, {pair.displaced});
  const MatchResult thesis =
      makeThesisMatcher(pair.geometry, options)->match(pair.reference.image, {pair.displaced});
  const Pose T_disp_ref = pair.geometry.displaced[0].T_ref_disp.inverse();
  const LensModel& lens = *pair.geometry.reference_lens;
  int both = 0, near = 0;
  for (int y = 0; y < size.height; ++y) {
    for (int x = 0; x < size.width; ++x) {
      const double a = sweep.range.at<float>(y, x), b = thesis.range.at<float>(y, x);
      if (std::isnan(a) || std::isnan(b)) continue;
      const Eigen::Vector3d ray = *lens.unproject(Eigen::Vector2d(x, y));
      const auto p = lens.project(T_disp_ref * (a * ray)), q = lens.project(T_disp_ref * (b * ray));
      if (!p || !q) continue;
      ++both;
      near += (*p - *q).norm() < 1.0;
    }
  }
  ASSERT_GT(both, 5000);
  EXPECT_GT(near, 0.95 * both);
}

TEST_F(SmallPair, RespectsMaskAndRangeLimits) {
  MatcherOptions options;
  options.mask = cv::Mat(size_, CV_8UC1, cv::Scalar(255));
  options.mask(cv::Rect(50, 60, 80, 70)).setTo(0);
  options.min_range = 1.2;
  options.max_range = 2.0;
  const MatchResult result = match(options);
  ASSERT_GT(result.statistics.valid, 8000u);
  for (int y = 0; y < size_.height; ++y) {
    for (int x = 0; x < size_.width; ++x) {
      const float range = result.range.at<float>(y, x);
      if (std::isnan(range)) continue;
      ASSERT_NE(options.mask.at<uchar>(y, x), 0);
      ASSERT_GE(range, 1.2f);
      ASSERT_LE(range, 2.0f);
    }
  }
  options.hypotheses = 12;
  EXPECT_GT(match(options).statistics.valid, 8000u) << "coarser steps still find the walls";
}

TEST_F(SmallPair, SigmaTellsTheError) {
  const MatchResult result = match();
  const auto [median, most] = errorsInSigmas(result);
  EXPECT_GT(median, 0.25);
  EXPECT_LT(median, 1.3);
  EXPECT_LT(most, 4.0);
}

class EveryCost : public SmallPair, public testing::WithParamInterface<const char*> {
 protected:
  MatcherOptions options() const {
    MatcherOptions options;
    options.cost = parseMatchCost(GetParam());
    return options;
  }
};

TEST_P(EveryCost, FindsTheWallsAndKnowsItsErrors) {
  const MatchResult result = match(options());
  Quality quality = judge(pair_, result);
  EXPECT_GT(quality.density(), 0.93);
  EXPECT_LT(quality.quantile(0.5), 0.12);
  EXPECT_LT(quality.quantile(0.95), 0.7);
  const auto [median, most] = errorsInSigmas(result);
  EXPECT_GT(median, 0.25);
  EXPECT_LT(median, 1.3);
  EXPECT_LT(most, 4.0);
}

TEST_P(EveryCost, IsTheSameOnEveryInstructionSetAndForAnyNumberOfThreads) {
  MatcherOptions few = options();
  few.threads = 1;
  const MatchResult best = match(few);
  ASSERT_GT(best.statistics.valid, 20000u);
  few.threads = 3;
  EXPECT_TRUE(same(best, match(few)));
  for (const char* name : {"avx2", "sse4", "scalar"}) {
    sweep::holdSimd(name);
    EXPECT_TRUE(same(best, match(options()))) << name << " is " << sweep::simdName();
  }
}

TEST_P(EveryCost, OfUnrelatedImagesGivesLittle) {
  const cv::Mat other =
      test::look(test::room(1.5, 0.1, 77), *pair_.geometry.reference_lens, size_, Pose::Identity())
          .image;
  const MatchResult result =
      makeSweepMatcher(pair_.geometry, options())->match(pair_.reference.image, {other});
  EXPECT_LT(result.statistics.valid, 0.05 * size_.area());
}

INSTANTIATE_TEST_SUITE_P(Sweep, EveryCost, testing::Values("census", "zncc", "eq3.1"));

TEST_F(SmallPair, OnlyCensusAndZnccTakeAnotherExposure) {
  cv::Mat darker;
  pair_.displaced.convertTo(darker, CV_8UC1, 0.55, 60);
  const auto found = [&](const char* cost) {
    MatcherOptions options;
    options.cost = parseMatchCost(cost);
    return judge(pair_,
                 makeSweepMatcher(pair_.geometry, options)->match(pair_.reference.image, {darker}))
        .density();
  };
  EXPECT_GT(found("census"), 0.9);
  EXPECT_GT(found("zncc"), 0.9);
  EXPECT_LT(found("eq3.1"), found("zncc"));
  EXPECT_THROW(parseMatchCost("ncc"), Error);
}

TEST_F(SmallPair, WindowsMayStandAnyWay) {
  for (const char* window : {"ray", "fronto", "best"}) {
    MatcherOptions options;
    options.window = parseMatchWindow(window);
    options.threads = 1;
    const MatchResult result = match(options);
    Quality quality = judge(pair_, result);
    EXPECT_GT(quality.density(), 0.93) << window;
    EXPECT_LT(quality.quantile(0.5), 0.12) << window;
    EXPECT_LT(quality.quantile(0.95), 0.8) << window;
    options.threads = 3;
    EXPECT_TRUE(same(result, match(options))) << window;
  }
  EXPECT_THROW(parseMatchWindow("slanted"), Error);
}

// A wall parallel to the image plane: windows that stand as it does see it without a bend.
TEST(Sweep, WindowsThatStandAsTheSurfaceDoesCostLess) {
  const cv::Size size(260, 230);
  const LensPtr lens = lensOf("conic", size, 150);
  const Pair pair = makePair(test::wall(1.2, 0.05), lens, size, test::pose(0.28, 0, 0));
  const auto score = [&](MatchWindow window) {
    MatcherOptions options;
    options.window = window;
    const MatchResult result =
        makeSweepMatcher(pair.geometry, options)->match(pair.reference.image, {pair.displaced});
    EXPECT_GT(result.statistics.valid, 15000u);
    double sum = 0;
    int count = 0;
    for (int y = 0; y < size.height; ++y) {
      for (int x = 0; x < size.width; ++x) {
        const float s = result.score.at<float>(y, x);
        const auto ray = lens->unproject(Eigen::Vector2d(x, y));
        // Where wall and ray-normal windows differ most.
        if (std::isnan(s) || !ray || ray->z() > std::cos(45 * kDegree)) continue;
        sum += s;
        ++count;
      }
    }
    EXPECT_GT(count, 3000);
    return sum / count;
  };
  const double ray = score(MatchWindow::kRay), fronto = score(MatchWindow::kFronto);
  EXPECT_GT(fronto, ray + 0.01);
  EXPECT_GT(score(MatchWindow::kBest), ray + 0.01);
}

TEST_F(SmallPair, ExposureDoesNotMatter) {
  cv::Mat darker;
  pair_.displaced.convertTo(darker, CV_8UC1, 0.55, 12);
  const MatchResult result =
      makeSweepMatcher(pair_.geometry, {})->match(pair_.reference.image, {darker});
  Quality quality = judge(pair_, result);
  EXPECT_GT(quality.density(), 0.93);
  EXPECT_LT(quality.quantile(0.5), 0.15);
}

TEST_F(SmallPair, ImagesWithoutContentGiveNothing) {
  const auto match = [&](const cv::Mat& reference, const cv::Mat& displaced) {
    return makeSweepMatcher(pair_.geometry, {})->match(reference, {displaced}).statistics.valid;
  };
  for (const int grey : {0, 127, 255}) {
    const cv::Mat flat(size_, CV_8UC1, cv::Scalar(grey));
    const MatchResult result = makeSweepMatcher(pair_.geometry, {})->match(flat, {flat});
    EXPECT_EQ(result.statistics.valid, 0u) << grey;
    std::size_t rejected = 0;
    for (const auto& [name, count] : result.statistics.rejected) rejected += count;
    EXPECT_GT(rejected, 20000u) << "every pixel of the field is told why it has no range";
    EXPECT_EQ(match(flat, pair_.displaced), 0u) << grey;
    EXPECT_EQ(match(pair_.reference.image, flat), 0u) << grey;
  }
}

TEST_F(SmallPair, UnrelatedImagesGiveLittle) {
  const cv::Mat other =
      test::look(test::room(1.5, 0.1, 77), *pair_.geometry.reference_lens, size_, Pose::Identity())
          .image;
  const MatchResult result =
      makeSweepMatcher(pair_.geometry, {})->match(pair_.reference.image, {other});
  EXPECT_LT(result.statistics.valid, 0.05 * size_.area());
}

TEST(Sweep, TinyImagesAreNoTrouble) {
  for (const cv::Size size : {cv::Size(1, 1), cv::Size(2, 7), cv::Size(9, 1), cv::Size(17, 13),
                              cv::Size(65, 3), cv::Size(97, 41)}) {
    const LensPtr lens = lensOf("conic", cv::Size(97, 41), 170);
    StereoGeometry geometry;
    geometry.reference_lens = lens;
    geometry.reference_size = size;
    geometry.displaced.push_back({lens, size, test::pose(0.1, 0.02, 0)});
    const cv::Mat image(size, CV_8UC1, cv::Scalar(90));
    std::unique_ptr<Matcher> matcher;
    try {
      matcher = makeSweepMatcher(geometry, {});
    } catch (const Error&) {
      continue;  // no parallax to speak of in so few pixels
    }
    const MatchResult result = matcher->match(image, {image});
    EXPECT_EQ(result.range.size(), size);
    EXPECT_EQ(result.statistics.valid, 0u);
  }
}

TEST(Sweep, WhatNoMachineHoldsIsRefusedBeforeItIsAllocated) {
  StereoGeometry geometry;
  geometry.reference_size = cv::Size(32766, 32766);
  geometry.reference_lens = lensOf("conic", geometry.reference_size, 170);
  for (int i = 1; i <= 16; ++i) {
    geometry.displaced.push_back(
        {geometry.reference_lens, geometry.reference_size, test::pose(0.1 * i, 0, 0)});
  }
  try {
    makeSweepMatcher(geometry, {});
    FAIL() << "taken";
  } catch (const Error& error) {
    EXPECT_NE(std::string(error.what()).find("more than half of this machine's memory"),
              std::string::npos)
        << error.what();
  }
}

TEST(Sweep, NearTheBaselineThereIsNoRange) {
  const cv::Size size(240, 240);
  const Pair pair =
      makePair(test::room(1.5, 0.1), lensOf("spline", size, 180), size, test::pose(0, 0, 0.15));
  const MatchResult result =
      makeSweepMatcher(pair.geometry, {})->match(pair.reference.image, {pair.displaced});
  const Eigen::Vector2d epipole = *pair.geometry.reference_lens->project({0, 0, 1});
  int sure = 0, near = 0;
  for (int y = 0; y < size.height; ++y) {
    for (int x = 0; x < size.width; ++x) {
      if ((Eigen::Vector2d(x, y) - epipole).norm() > 3) continue;
      ++near;
      // Half a pixel of parallax error there is half the range.
      sure += result.sigma.at<float>(y, x) < 0.05f * result.range.at<float>(y, x);
    }
  }
  ASSERT_GT(near, 20);
  EXPECT_EQ(sure, 0);
}

}  // namespace
}  // namespace omnister
