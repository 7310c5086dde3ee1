// SPDX-License-Identifier: Apache-2.0
#include "stereo/sweep/multi_position.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <iostream>
#include <limits>
#include <random>

#include "analytic_scene.h"
#include "omnister/common/error.h"
#include "omnister/lens/lens_models.h"
#include "omnister/stereo/stream_matcher.h"
#include "stereo/sweep/refine/joint_refinement.h"

namespace omnister {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
const cv::Size kSize(250, 210);

LensPtr lens() {
  LensStructure structure;
  structure.model = "spline";
  return makeLens(structure, {125.2, 104.6}, 80.0, 1.5);
}

/// A room with a panel that hides some of it from the far positions.
std::vector<test::Rectangle> scene() {
  auto walls = test::room(1.9, 0.1);
  walls.push_back({{-0.25, 0.05, 1.0},
                   Eigen::Vector3d(0.25, 0.1, -1.0).normalized(),
                   0.28,
                   test::Waves(0.05, 0.4, 77)});
  return walls;
}

void addNoise(cv::Mat* image, double sigma, unsigned seed) {
  std::mt19937 random(seed);
  for (int y = 0; y < image->rows; ++y) {
    for (int x = 0; x < image->cols; ++x) {
      // Sum of twelve uniforms: the same on every library.
      double sum = -6.0;
      for (int i = 0; i < 12; ++i) sum += static_cast<double>(random()) / 4294967296.0;
      image->at<uchar>(y, x) = cv::saturate_cast<uchar>(image->at<uchar>(y, x) + sigma * sum);
    }
  }
}

struct Scan {
  test::View reference;
  std::vector<cv::Mat> images;
  std::vector<Pose> poses;

  StereoGeometry geometry(const std::vector<std::size_t>& which) const {
    StereoGeometry result;
    result.reference_lens = lens();
    result.reference_size = kSize;
    for (const std::size_t i : which) result.displaced.push_back({lens(), kSize, poses[i]});
    return result;
  }
  MatchResult match(const std::vector<std::size_t>& which, const MatcherOptions& given = {}) const {
    MatcherOptions options = given;
    if (options.min_range == 0) options.min_range = 0.7;
    std::vector<cv::Mat> displaced;
    for (const std::size_t i : which) displaced.push_back(images[i]);
    return makeMatcher("sweep", geometry(which), options)->match(reference.image, displaced);
  }
};

/// Steps of 5 cm along x: displaced images 0 to 3, and 4 and 5 on the other side.
const Scan& scan() {
  static const Scan made = [] {
    Scan s;
    s.reference = test::look(scene(), *lens(), kSize, Pose::Identity(), 2);
    addNoise(&s.reference.image, 1.5, 1);
    for (const double x : {0.05, 0.10, 0.15, 0.20, -0.05, -0.10}) {
      s.poses.push_back(test::pose(x, 0, 0));
      s.images.push_back(test::look(scene(), *lens(), kSize, s.poses.back(), 2).image);
      addNoise(&s.images.back(), 1.5, 1 + static_cast<unsigned>(s.images.size()));
    }
    return s;
  }();
  return made;
}

/// Whether the camera at `pose` sees what pixel (x, y) of the reference sees.
bool seen(const Scan& s, int x, int y, const Pose& pose) {
  const double range = s.reference.range.at<double>(y, x);
  const auto ray = lens()->unproject({static_cast<double>(x), static_cast<double>(y)});
  if (std::isnan(range) || !ray) return false;
  const Eigen::Vector3d across = range * *ray - pose.translation();
  if (!lens()->project(pose.linear().transpose() * across)) return false;
  static const auto walls = scene();
  for (const auto& rectangle : walls) {
    const auto hit = test::hit(rectangle, pose.translation(), across.normalized(), nullptr);
    if (hit && *hit < across.norm() * 0.999) return false;
  }
  return true;
}

struct Quality {
  std::size_t truth = 0;
  std::vector<double> errors;  ///< of range, relative
  std::vector<double> z;       ///< by sigma
  double density() const { return static_cast<double>(errors.size()) / truth; }
  double right(double limit) const {
    return static_cast<double>(
               std::count_if(errors.begin(), errors.end(), [&](double e) { return e < limit; })) /
           truth;
  }
  static double quantile(std::vector<double> values, double share) {
    const auto at = values.begin() + static_cast<std::ptrdiff_t>(share * (values.size() - 1));
    std::nth_element(values.begin(), at, values.end());
    return *at;
  }
  double median() const { return quantile(errors, 0.5); }
};

template <typename Where>
Quality judge(const MatchResult& result, const Where& where) {
  Quality quality;
  for (int y = 0; y < kSize.height; y += 2) {
    for (int x = 0; x < kSize.width; x += 2) {
      if (!where(x, y)) continue;
      ++quality.truth;
      const double range = result.range.at<float>(y, x);
      if (std::isnan(range)) continue;
      const double truth = scan().reference.range.at<double>(y, x);
      quality.errors.push_back(std::abs(range / truth - 1));
      quality.z.push_back((range - truth) / result.sigma.at<float>(y, x));
    }
  }
  return quality;
}

TEST(MultiPosition, TravelTightensRange) {
  const auto everywhere = [](int x, int y) { return seen(scan(), x, y, scan().poses[3]); };
  const Quality two = judge(scan().match({0}), everywhere);
  const Quality three = judge(scan().match({0, 1}), everywhere);
  const Quality five = judge(scan().match({0, 1, 2, 3}), everywhere);
  ASSERT_GT(two.truth, 7500u);
  EXPECT_GT(five.density(), 0.97);
  EXPECT_LT(three.median(), 0.6 * two.median());
  EXPECT_LT(five.median(), 0.25 * two.median());
  // Sigma says how good it is.
  for (const Quality* quality : {&three, &five}) {
    std::vector<double> sizes;
    for (const double z : quality->z) sizes.push_back(std::abs(z));
    const double spread = Quality::quantile(sizes, 0.6827);
    EXPECT_GT(spread, 0.5);
    EXPECT_LT(spread, 1.6);
  }
}

TEST(MultiPosition, NearPositionsSeeWhatTheFarOneCannot) {
  const Quality two_all =
      judge(scan().match({3}), [](int x, int y) { return seen(scan(), x, y, scan().poses[3]); });
  const auto hidden = [](int x, int y) {
    return !seen(scan(), x, y, scan().poses[3]) && seen(scan(), x, y, scan().poses[1]) &&
           seen(scan(), x, y, scan().poses[0]);
  };
  const MatchResult of_five = scan().match({0, 1, 2, 3});
  const Quality two = judge(scan().match({3}), hidden), five = judge(of_five, hidden);
  ASSERT_GT(five.truth, 40u);
  EXPECT_GT(five.density(), two.density() + 0.3);
  // A single pair's paths carry the background on into what is hidden, often rightly, so that two
  // images are no measure of five here.
  EXPECT_GT(five.right(0.05), 0.3);
  const Quality five_all =
      judge(of_five, [](int x, int y) { return seen(scan(), x, y, scan().poses[3]); });
  EXPECT_LT(five_all.median(), two_all.median());
}

bool same(const cv::Mat& a, const cv::Mat& b) {
  for (int y = 0; y < a.rows; ++y)
    if (std::memcmp(a.ptr(y), b.ptr(y), a.cols * a.elemSize()) != 0) return false;
  return a.size() == b.size();
}

TEST(MultiPosition, IsTheSameForAnyOrderThreadsAndTime) {
  MatcherOptions options;
  options.min_range = 0.7;
  options.threads = 1;
  const MatchResult one = scan().match({4, 0, 5}, options);
  EXPECT_GT(one.statistics.valid, 30000u);
  EXPECT_TRUE(same(scan().match({3, 0, 1}).range, scan().match({1, 3, 0}).range));
  options.threads = 3;
  const auto matcher = makeMatcher("sweep", scan().geometry({4, 0, 5}), options);
  for (int time = 0; time < 2; ++time) {
    const MatchResult many = matcher->match(scan().reference.image,
                                            {scan().images[4], scan().images[0], scan().images[5]});
    EXPECT_TRUE(same(one.range, many.range)) << time;
    EXPECT_TRUE(same(one.sigma, many.sigma)) << time;
    EXPECT_TRUE(same(one.score, many.score)) << time;
  }
}

TEST(MultiPosition, BothSidesBeatOne) {
  const auto near = [](int x, int y) {
    return seen(scan(), x, y, scan().poses[1]) && seen(scan(), x, y, scan().poses[5]);
  };
  const Quality one = judge(scan().match({1}), near);
  const Quality both = judge(scan().match({1, 5}), near);
  EXPECT_LT(both.median(), 0.7 * one.median());
}

TEST(MultiPosition, PosesNeedNotLieOnALine) {
  StereoGeometry geometry;
  geometry.reference_lens = lens();
  geometry.reference_size = kSize;
  std::vector<cv::Mat> displaced;
  for (const Pose& pose : {test::pose(0.1, 0, 0, 0.05), test::pose(0, 0.1, 0.02)}) {
    geometry.displaced.push_back({lens(), kSize, pose});
    displaced.push_back(test::look(scene(), *lens(), kSize, pose, 2).image);
  }
  MatcherOptions options;
  options.min_range = 0.7;
  const MatchResult result =
      makeMatcher("sweep", geometry, options)->match(scan().reference.image, displaced);
  const Quality quality = judge(result, [&](int x, int y) {
    return seen(scan(), x, y, geometry.displaced[0].T_ref_disp) &&
           seen(scan(), x, y, geometry.displaced[1].T_ref_disp);
  });
  EXPECT_GT(quality.density(), 0.97);
  EXPECT_LT(quality.median(), 0.01);
}

TEST(MultiPosition, LimitsOfRangeAndMaskHold) {
  MatcherOptions options;
  options.min_range = 1.2;
  options.max_range = 2.0;
  options.mask = cv::Mat(kSize, CV_8UC1, cv::Scalar(255));
  options.mask(cv::Rect(60, 50, 70, 60)).setTo(0);
  const MatchResult result = scan().match({0, 1, 3}, options);
  std::size_t valid = 0;
  for (int y = 0; y < kSize.height; ++y) {
    for (int x = 0; x < kSize.width; ++x) {
      const float range = result.range.at<float>(y, x);
      ASSERT_EQ(std::isnan(range), std::isnan(result.sigma.at<float>(y, x)));
      ASSERT_EQ(std::isnan(range), std::isnan(result.score.at<float>(y, x)));
      if (std::isnan(range)) continue;
      ++valid;
      ASSERT_NE(options.mask.at<uchar>(y, x), 0);
      ASSERT_TRUE(range >= 1.2f && range <= 2.0f && std::isfinite(result.sigma.at<float>(y, x)));
    }
  }
  EXPECT_EQ(valid, result.statistics.valid);
  EXPECT_GT(valid, 4000u);
}

TEST(Stream, DepthGetsBetterWithTravel) {
  const auto everywhere = [](int x, int y) { return seen(scan(), x, y, scan().poses[3]); };
  MatcherOptions options;
  options.min_range = 0.7;
  StreamMatcher stream(options, 3);
  EXPECT_THROW(stream.add({lens(), kSize, scan().poses[0]}, scan().images[0]), Error);
  for (int time = 0; time < 2; ++time) {
    stream.setReference(lens(), scan().reference.image);
    EXPECT_EQ(stream.frames(), 0);
    double last = 1, first = 0;
    for (std::size_t i = 0; i < 4; ++i) {
      const MatchResult result =
          stream.add({lens(), kSize, scan().poses[i]}, scan().images[i].clone());
      const Quality quality = judge(result, everywhere);
      EXPECT_GT(quality.density(), 0.95);
      EXPECT_LT(quality.median(), 0.9 * last) << i;
      last = quality.median();
      if (i == 0) first = last;
    }
    EXPECT_LT(last, 0.35 * first);
    EXPECT_EQ(stream.frames(), 4);
    EXPECT_EQ(stream.framesKept(), 3);
    // A frame from where the reference stands changes nothing.
    EXPECT_THROW(stream.add({lens(), kSize, Pose::Identity()}, scan().images[0]), Error);
    EXPECT_EQ(stream.frames(), 4);
  }
  EXPECT_THROW(stream.setReference(lens(), cv::Mat(10, 10, CV_16UC1, cv::Scalar(1))), Error);
  EXPECT_THROW(StreamMatcher(options, 0), Error);
}

TEST(Refinement, HalvesTheErrorOfAPair) {
  const auto everywhere = [](int x, int y) { return seen(scan(), x, y, scan().poses[1]); };
  MatcherOptions options;
  const Quality plain = judge(scan().match({1}, options), everywhere);
  options.refine = true;
  const Quality refined = judge(scan().match({1}, options), everywhere);
  EXPECT_LT(refined.median(), 0.7 * plain.median());
  EXPECT_GT(refined.density(), plain.density() - 0.03);
}

TEST(WeakTexture, MatchesInCoarserImages) {
  // Walls of a few grey levels under noise of nearly one.
  StereoGeometry geometry = scan().geometry({2});
  const auto fade = [](const cv::Mat& image, unsigned seed) {
    cv::Mat faded;
    image.convertTo(faded, CV_8U, 0.07, 119);
    addNoise(&faded, 0.8, seed);
    return faded;
  };
  const auto walls = test::room(1.9, 0.12);
  const test::View reference = test::look(walls, *lens(), kSize, Pose::Identity(), 2);
  const cv::Mat displaced = test::look(walls, *lens(), kSize, scan().poses[2], 2).image;
  MatcherOptions options;
  options.min_range = 0.7;
  const MatchResult result = makeMatcher("sweep", geometry, options)
                                 ->match(fade(reference.image, 5), {fade(displaced, 6)});
  std::vector<double> errors, z;
  int truth = 0;
  for (int y = 4; y < kSize.height - 4; ++y) {
    for (int x = 4; x < kSize.width - 4; ++x) {
      const double range = reference.range.at<double>(y, x);
      const auto ray = lens()->unproject({static_cast<double>(x), static_cast<double>(y)});
      if (std::isnan(range) || !ray || std::abs(ray->x()) > 0.9) continue;
      if (!lens()->project(range * *ray - scan().poses[2].translation())) continue;
      ++truth;
      const double found = result.range.at<float>(y, x);
      if (std::isnan(found)) continue;
      errors.push_back(std::abs(found / range - 1));
      z.push_back(std::abs(found - range) / result.sigma.at<float>(y, x));
    }
  }
  ASSERT_GT(truth, 20000);
  std::cout << "density " << static_cast<double>(errors.size()) / truth << ", median "
            << Quality::quantile(errors, 0.5) << ", z " << Quality::quantile(z, 0.6827) << '\n';
  EXPECT_GT(static_cast<double>(errors.size()) / truth, 0.8);
  EXPECT_LT(Quality::quantile(errors, 0.5), 0.03);
}

TEST(RangeFusion, TwoThatAgreeOutweighOneThatDoesNot) {
  RangeFusion fusion({2, 1}, 1);
  const auto add = [&](float first, float sigma, float second) {
    MatchResult result;
    result.range = (cv::Mat_<float>(1, 2) << first, second);
    result.sigma = (cv::Mat_<float>(1, 2) << sigma, 0.1f);
    result.score = (cv::Mat_<float>(1, 2) << 0.5f, 0.5f);
    fusion.add(result);
  };
  add(2.0f, 0.10f, kNaN);
  EXPECT_TRUE(std::isnan(fusion.inverse.at<float>(0, 1)));
  add(1.0f, 0.001f, 3.0f);  // a mismatch that is sure of itself
  EXPECT_FLOAT_EQ(fusion.inverse.at<float>(0, 0), 1.0f);
  EXPECT_FLOAT_EQ(fusion.inverse.at<float>(0, 1), 1 / 3.0f);
  add(2.05f, 0.05f, kNaN);
  EXPECT_NEAR(1 / fusion.inverse.at<float>(0, 0), 2.05, 0.01);
  EXPECT_EQ(fusion.support.at<uchar>(0, 0), 2);
  EXPECT_EQ(fusion.count(), 3);
  fusion.clear();
  EXPECT_TRUE(std::isnan(fusion.inverse.at<float>(0, 0)));
}

TEST(ProjectionTable, FallsWhereTheLensSays) {
  for (const char* model : {"spline", "conic"}) {
    LensStructure structure;
    structure.model = model;
    const cv::Size size(1280, 960);
    const LensPtr wide = makeLens(structure, {640, 480}, 400.0, 1.55);
    const ProjectionTable table(sweep::widen(wide), size, 1);
    EXPECT_NEAR(table.focalPx(), 400.0, 4.0);
    std::mt19937 random(3);
    int inside = 0, outside = 0;
    for (int i = 0; i < 5000; ++i) {
      const auto uniform = [&] { return static_cast<float>(random() / 4294967296.0 * 2 - 1); };
      const Eigen::Vector3f d(uniform() * 2, uniform() * 2, uniform() * 2);
      float u, v;
      table.project(&d.x(), &d.y(), &d.z(), 1, &u, &v);
      const auto pixel = wide->project(d.cast<double>());
      if (!pixel || pixel->x() < 0 || pixel->y() < 0 || pixel->x() > size.width - 1 ||
          pixel->y() > size.height - 1) {
        outside += std::isnan(u) ? 1 : 0;
        continue;
      }
      ++inside;
      ASSERT_NEAR(u, pixel->x(), 0.01) << model;
      ASSERT_NEAR(v, pixel->y(), 0.01) << model;
    }
    EXPECT_GT(inside, 1000);
    EXPECT_GT(outside, 1000);
  }
}

}  // namespace
}  // namespace omnister
