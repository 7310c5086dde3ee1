// SPDX-License-Identifier: Apache-2.0
// Rays, paths and the checks before a match.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <map>
#include <random>

#include "analytic_scene.h"
#include "omnister/common/error.h"
#include "omnister/lens/lens_models.h"
#include "omnister/stereo/epipolar.h"
#include "omnister/stereo/matching_limits.h"
#include "stereo/geometry/triangulation.h"

namespace omnister {
namespace {

using Eigen::Vector3d;
using test::pose;
using ::testing::HasSubstr;

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

LensPtr conic(double max_theta = 1.4, double focal = 80.0) {
  return makeLens(LensStructure{}, {79.5, 59.5}, focal, max_theta);
}

Vector3d randomDirection(std::mt19937& random) {
  std::normal_distribution<double> normal;
  return Vector3d(normal(random), normal(random), normal(random)).normalized();
}

TEST(Triangulate, FindsThePointTwoRaysShare) {
  std::mt19937 random(1);
  int found = 0;
  for (int i = 0; i < 1000; ++i) {
    const Vector3d p0 = randomDirection(random), q0 = randomDirection(random);
    const Vector3d point = 5.0 * randomDirection(random);
    const auto result = triangulate(p0, 3.0 * (point - p0), q0, 0.1 * (point - q0));
    if (!result) continue;
    ++found;
    EXPECT_LT((result->point - point).norm(), 1e-9);
    EXPECT_NEAR(result->range_first, (point - p0).norm(), 1e-9);
    EXPECT_NEAR(result->range_second, (point - q0).norm(), 1e-9);
    EXPECT_LT(result->residual, 1e-9);
  }
  EXPECT_EQ(found, 1000);
}

TEST(Triangulate, TakesTheMiddleOfTheShortestSegmentOfSkewRays) {
  // Along x at z = 1, and along y at z = 3: the segment is the z axis between them.
  const auto result =
      triangulate(Vector3d(-2, 0, 1), Vector3d(1, 0, 0), Vector3d(0, -5, 3), Vector3d(0, 2, 0));
  ASSERT_TRUE(result);
  EXPECT_LT((result->point - Vector3d(0, 0, 2)).norm(), 1e-12);
  EXPECT_NEAR(result->range_first, 2.0, 1e-12);
  EXPECT_NEAR(result->range_second, 5.0, 1e-12);
  EXPECT_NEAR(result->residual, 2.0, 1e-12);
}

TEST(Triangulate, RefusesParallelDivergingAndBrokenRays) {
  const Vector3d origin = Vector3d::Zero(), z = Vector3d::UnitZ(), x = Vector3d::UnitX();
  EXPECT_FALSE(triangulate(origin, z, x, z));
  EXPECT_FALSE(triangulate(origin, z, x, -2.0 * z));
  EXPECT_FALSE(triangulate(origin, z, x, z + 1e-10 * x));
  EXPECT_TRUE(triangulate(origin, z, x, z - 1e-6 * x));
  EXPECT_FALSE(triangulate(origin, z, x, z + 0.1 * x)) << "the rays meet behind the cameras";
  EXPECT_FALSE(triangulate(origin, z, x, Vector3d(kNan, 0, 1)));
  EXPECT_FALSE(triangulate(origin, z, Vector3d(kInfinity, 0, 0), z - 0.1 * x));
  EXPECT_FALSE(triangulate(origin, origin, x, z));
}

TEST(Triangulate, SmallAnglesKeepTheirDigits) {
  const Pose T = pose(1.0, 0.0, 0.0, 0.2);
  for (double range : {10.0, 1e3, 1e5}) {
    const Vector3d point(0.1 * range, 0.2 * range, range);
    const auto result = triangulate(point.normalized(), T.inverse() * point, T);
    ASSERT_TRUE(result) << range;
    EXPECT_NEAR(result->range_first / point.norm(), 1.0, 1e-15 * range * 100.0);
  }
}

TEST(Triangulate, PinholeDepth) {
  EXPECT_NEAR(*depthFromDisparity(500.0, 0.1, 10.0), 5.0, 1e-12);
  EXPECT_NEAR(*depthFromDisparity(500.0, -0.1, -10.0), 5.0, 1e-12);
  EXPECT_FALSE(depthFromDisparity(500.0, 0.1, 0.0));
  EXPECT_FALSE(depthFromDisparity(500.0, kNan, 1.0));
}

TEST(EpipolarCurve, PassesThroughEveryPointOfTheRay) {
  const LensPtr lens = conic(2.0);
  const std::map<std::string, Pose> poses = {{"sideways", pose(0.3, 0, 0)},
                                             {"forward", pose(0, 0, 0.3)},
                                             {"turned", pose(0.2, -0.1, 0.1, 0.5, {1, 2, 3})}};
  for (const auto& [name, T] : poses) {
    std::mt19937 random(7);
    int inside = 0;
    for (int i = 0; i < 500; ++i) {
      const Vector3d ray = randomDirection(random);
      const double range = std::exp(std::uniform_real_distribution<double>(-1.0, 4.0)(random));
      const EpipolarCurve curve(ray, T, *lens);
      const Vector3d seen = T.inverse() * (range * ray);
      EXPECT_LT((curve.bearing(1.0 / range).normalized() - seen.normalized()).norm(), 1e-12)
          << name;
      // The law of sines both ways.
      const double parallax = curve.parallax(1.0 / range);
      EXPECT_NEAR(parallax,
                  std::acos(std::clamp(ray.dot(T.linear() * seen.normalized()), -1.0, 1.0)), 1e-6);
      EXPECT_NEAR(curve.inverseRange(parallax) * range, 1.0, 1e-6) << name;
      EXPECT_LT(parallax, curve.maxParallax());
      const auto pixel = curve.pixel(1.0 / range);
      const auto projected = lens->project(seen);
      ASSERT_EQ(pixel.has_value(), projected.has_value());
      if (!pixel) continue;
      ++inside;
      EXPECT_LT((*pixel - *projected).norm(), 1e-7);
    }
    EXPECT_GT(inside, 250) << name;
  }
}

// Johnson 1997, eqs 4.17, 4.18, 4.26 to 4.32 and fig. 5.2, written out for the quadric.
TEST(EpipolarCurve, IsTheThesisShiftForASidewaysMove) {
  const double R0 = 90.0, qa = 0.003, qb = 0.0025;
  const LensPtr lens = makeLens(
      "quadric", {79.5, 59.5},
      {{"R0", {R0}}, {"a", {1.0 / std::sqrt(qa)}}, {"b", {1.0 / std::sqrt(qb)}}}, 1.3, "test");
  const double baseline = 0.25;
  const Pose T = pose(baseline, 0, 0);
  int points = 0;
  for (double x : {-60.0, -20.0, 0.0, 35.0, 70.0}) {
    for (double y : {-50.0, 0.0, 10.0, 55.0}) {
      const auto ray = lens->unproject({79.5 + x, 59.5 + y});
      if (!ray) continue;
      const double h = R0 - qa * x * x - qb * y * y;
      const double u = R0 * x / h, v = R0 * y / h;
      for (double depth : {0.7, 1.5, 40.0}) {
        const double shifted = u - R0 * baseline / depth;
        const double q = qa * shifted * shifted + qb * v * v;
        const double t = 2.0 / (1.0 + std::sqrt(1.0 + 4.0 * q / R0));
        const auto pixel = EpipolarCurve(*ray, T, *lens).pixel(ray->z() / depth);
        if (!pixel) continue;
        ++points;
        EXPECT_NEAR(pixel->x(), 79.5 + shifted * t, 1e-6);
        EXPECT_NEAR(pixel->y(), 59.5 + v * t, 1e-6);
      }
    }
  }
  EXPECT_GT(points, 40);
}

TEST(EpipolarCurve, SamplesInSmallStepsFromEndToEnd) {
  const LensPtr lens = conic(2.0);
  const Vector3d ray = Vector3d(0.5, 0.3, 1.0).normalized();
  const EpipolarCurve curve(ray, pose(0.2, 0.05, 0.1, 0.1), *lens);
  const auto points = curve.sample(0.0, 2.0, 0.25);
  ASSERT_GT(points.size(), 10u);
  EXPECT_EQ(points.front().inverse_range, 0.0);
  EXPECT_EQ(points.back().inverse_range, 2.0);
  for (std::size_t i = 1; i < points.size(); ++i) {
    EXPECT_GT(points[i].inverse_range, points[i - 1].inverse_range);
    EXPECT_LE((points[i].pixel - points[i - 1].pixel).norm(), 0.25);
  }
  // Along the baseline there is no path, only a point.
  const EpipolarCurve none(Vector3d::UnitX(), pose(0.2, 0, 0), *conic(2.0));
  EXPECT_EQ(none.parallax(1.0), 0.0);
}

class CheckMatching : public ::testing::Test {
 protected:
  CheckMatching() {
    geometry_.reference_lens = conic();
    geometry_.reference_size = {160, 120};
    geometry_.displaced.push_back({conic(), {160, 120}, pose(0.25, 0, 0)});
  }

  std::string refusal() const {
    try {
      checkMatching(geometry_, options_);
    } catch (const Error& error) {
      return error.what();
    }
    return "accepted";
  }

  StereoGeometry geometry_;
  MatcherOptions options_;
};

TEST_F(CheckMatching, FillsInDefaults) {
  const MatchingLimits limits = checkMatching(geometry_, options_);
  EXPECT_NEAR(limits.min_range, 1.0, 1e-12);
  EXPECT_EQ(limits.max_range, kInfinity);
  EXPECT_EQ(limits.minInverseRange(), 0.0);
  // A parallax of atan(1/4) at 80 px/rad on the axis is 19.6 px.
  EXPECT_GT(limits.longest_path_px, 17.0);
  EXPECT_LT(limits.longest_path_px, 40.0);
  EXPECT_EQ(limits.hypotheses, std::ceil(limits.longest_path_px) + 1);
  options_.min_range = 2.0;
  options_.max_range = 3.0;
  options_.hypotheses = 7;
  EXPECT_EQ(checkMatching(geometry_, options_).hypotheses, 7);
}

TEST_F(CheckMatching, RefusesOptionsWithoutSense) {
  const auto with = [&](auto change) {
    const StereoGeometry geometry = geometry_;
    const MatcherOptions options = options_;
    change();
    const std::string text = refusal();
    geometry_ = geometry;
    options_ = options;
    return text;
  };
  EXPECT_EQ(refusal(), "accepted");
  EXPECT_THAT(with([&] { options_.min_range = kNan; }), HasSubstr("minimum range is nan"));
  EXPECT_THAT(with([&] { options_.min_range = -1.0; }), HasSubstr("minimum range is -1"));
  EXPECT_THAT(with([&] { options_.min_range = kInfinity; }), HasSubstr("minimum range is inf"));
  EXPECT_THAT(with([&] { options_.max_range = kNan; }), HasSubstr("maximum range is nan"));
  EXPECT_THAT(with([&] { options_.max_range = 0.5; }), HasSubstr("four baselines"));
  EXPECT_THAT(with([&] { options_.min_range = 3.0, options_.max_range = 2.0; }),
              HasSubstr("not below"));
  EXPECT_THAT(with([&] { options_.hypotheses = -1; }), HasSubstr("hypotheses is -1"));
  EXPECT_THAT(with([&] { options_.hypotheses = 2000000000; }), HasSubstr("hypotheses"));
  EXPECT_THAT(with([&] { options_.threads = -1; }), HasSubstr("threads"));
  EXPECT_THAT(with([&] { options_.mask = cv::Mat(10, 10, CV_8UC1); }), HasSubstr("mask is 10x10"));
  EXPECT_THAT(with([&] { options_.min_range = 1e4; }), HasSubstr("baseline is too short"));
  EXPECT_THAT(with([&] { geometry_.displaced[0].T_ref_disp = Pose::Identity(); }),
              HasSubstr("displaced camera 1 stands where the reference camera stands"));
  EXPECT_THAT(with([&] { geometry_.displaced[0].T_ref_disp.translation().x() = kNan; }),
              HasSubstr("not finite"));
  EXPECT_THAT(with([&] { geometry_.displaced[0].T_ref_disp.linear() *= 2.0; }), HasSubstr("rigid"));
  EXPECT_THAT(with([&] { geometry_.displaced[0].T_ref_disp = pose(0.25, 0, 0, M_PI); }),
              HasSubstr("see nothing"));
  EXPECT_THAT(with([&] { geometry_.displaced[0].size = {}; }), HasSubstr("size of the image"));
  EXPECT_THAT(with([&] { geometry_.reference_size = {100000, 5}; }), HasSubstr("100000x5"));
  EXPECT_THAT(with([&] { geometry_.displaced.clear(); }), HasSubstr("no displaced camera"));
  EXPECT_THAT(with([&] { geometry_.reference_lens = nullptr; }), HasSubstr("no lens"));
}

TEST_F(CheckMatching, BoundsMemoryAndImages) {
  EXPECT_NO_THROW(checkMemory(1e6, "nothing"));
  EXPECT_THROW(checkMemory(1e15, "the cost volume"), Error);
  const cv::Mat image(120, 160, CV_8UC1);
  EXPECT_NO_THROW(checkImages(geometry_, image, {image}));
  EXPECT_THROW(checkImages(geometry_, image, {}), Error);
  EXPECT_THROW(checkImages(geometry_, cv::Mat(), {image}), Error);
  EXPECT_THROW(checkImages(geometry_, image, {cv::Mat(120, 161, CV_8UC1)}), Error);
  EXPECT_THROW(checkImages(geometry_, cv::Mat(120, 160, CV_16UC1), {image}), Error);
}

}  // namespace
}  // namespace omnister
