// SPDX-License-Identifier: Apache-2.0
/// What calibration leaves unknown, against many calibrations that are wrong by as much.
#include "stereo/result/range_uncertainty.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <random>

#include "analytic_scene.h"
#include "omnister/common/error.h"
#include "omnister/lens/lens_models.h"
#include "omnister/stereo/thesis_matcher.h"
#include "stereo/sweep/sweep_matcher.h"

namespace omnister {
namespace {

const cv::Size kSize(320, 260);

LensPtr asphere() {
  LensStructure structure;
  structure.model = "asphere";
  structure.even_terms = 2;
  return makeLens(structure, {161.2, 128.4}, 150.0, 1.5);
}

/// Parameters that are wrong together: correlations as a calibration has them.
Eigen::MatrixXd lensCovariance(const LensModel& lens, double pixels) {
  const Eigen::VectorXd parameters = lens.parameters();
  const Eigen::Index count = parameters.size();
  // Of each parameter what moves the image by some pixels at 60 degrees.
  Eigen::MatrixXd root = Eigen::MatrixXd::Zero(count, count);
  JacobianParams by_parameters;
  lens.project({std::sin(1.05), 0.1, std::cos(1.05)}, nullptr, &by_parameters);
  for (Eigen::Index i = 0; i < count; ++i) {
    root(i, i) = pixels / std::max(by_parameters.col(i).norm(), 1e-9);
    if (i > 0) root(i, i - 1) = -0.5 * root(i, i);
  }
  return root * root.transpose();
}

Eigen::VectorXd draw(const Eigen::MatrixXd& covariance, std::mt19937* random) {
  std::normal_distribution<double> normal;
  Eigen::VectorXd free(covariance.rows());
  for (double& x : free) x = normal(*random);
  return Eigen::MatrixXd(covariance.llt().matrixL()) * free;
}

struct Setting {
  Pose T_ref_disp;
  bool lens, pose;
};

/// Range of a point whose two pixels are right but whose lens and pose are not.
double rangeBy(const LensModel& lens, const Pose& T_ref_disp, const Eigen::Vector2d& pixel,
               const Eigen::Vector2d& seen) {
  const auto ray = lens.unproject(pixel), other = lens.unproject(seen);
  if (!ray || !other) return std::nan("");
  const Eigen::Vector3d e = T_ref_disp.translation().normalized();
  const double theta = std::acos(ray->dot(e));
  const double theta_other = std::acos((T_ref_disp.linear() * *other).dot(e));
  return T_ref_disp.translation().norm() * std::sin(theta_other) / std::sin(theta_other - theta);
}

class EveryError : public testing::TestWithParam<Setting> {};

TEST_P(EveryError, SpreadsRangesAsSigmaSays) {
  const LensPtr lens = asphere();
  const Eigen::MatrixXd covariance = lensCovariance(*lens, 0.05);
  StereoGeometry geometry;
  geometry.reference_lens = lens;
  geometry.reference_size = kSize;
  geometry.displaced.push_back({lens, kSize, GetParam().T_ref_disp});
  const Eigen::MatrixXd pose_covariance =
      (Eigen::VectorXd(6) << 1e-6, 4e-6, 1e-6, 4e-7, 1e-7, 1e-7).finished().asDiagonal();
  if (GetParam().lens) geometry.reference_covariance = covariance;
  if (GetParam().pose) geometry.displaced[0].pose_covariance = pose_covariance;
  ASSERT_TRUE(hasCovariance(geometry));
  const double nearest = 0.6;
  const RangeUncertainty uncertainty(geometry, nearest, 2);
  int checked = 0;
  for (double v = 40; v < kSize.height; v += 45) {
    for (double u = 40; u < kSize.width; u += 48) {
      const auto ray = lens->unproject({u, v});
      if (!ray) continue;
      const Eigen::Vector3d e = GetParam().T_ref_disp.translation().normalized();
      // Nearer to the epipole sigma bends more than the table of so small an image follows.
      if (std::abs(ray->dot(e)) > 0.9) continue;
      for (const double range : {0.8, 2.0}) {
        const auto seen = lens->project(GetParam().T_ref_disp.inverse() * (range * *ray));
        if (!seen) continue;
        std::mt19937 random(7);
        double squares = 0.0;
        constexpr int kDraws = 300;
        int made = 0;
        for (int i = 0; i < kDraws; ++i) {
          const Eigen::VectorXd by_lens = draw(covariance, &random);
          const Eigen::VectorXd by_pose = draw(pose_covariance, &random);
          LensPtr wrong = lens;
          Pose pose = GetParam().T_ref_disp;
          if (GetParam().lens) wrong = lens->withParameters(lens->parameters() + by_lens);
          if (GetParam().pose) {
            const Eigen::Vector3d turn = by_pose.tail<3>();
            pose.translation() += by_pose.head<3>();
            pose.linear() = Eigen::AngleAxisd(turn.norm(), turn.normalized()).toRotationMatrix() *
                            pose.linear();
          }
          if (!wrong) continue;
          const double found = rangeBy(*wrong, pose, {u, v}, *seen);
          if (std::isnan(found)) continue;
          squares += (found - range) * (found - range);
          ++made;
        }
        ASSERT_GT(made, kDraws * 9 / 10);
        const double spread = std::sqrt(squares / made);
        const double sigma = uncertainty.sigma(u, v, range);
        // Of 300 draws a spread is known to 4 %; the table is linear between its nodes.
        EXPECT_NEAR(sigma / spread, 1.0, 0.2) << u << " " << v << " at " << range << " m";
        ++checked;
      }
    }
  }
  EXPECT_GT(checked, 30);
}

INSTANTIATE_TEST_SUITE_P(RangeUncertainty, EveryError,
                         testing::Values(Setting{test::pose(0.15, 0, 0), true, false},
                                         Setting{test::pose(0.15, 0, 0), false, true},
                                         Setting{test::pose(0.02, 0.03, 0.14, 0.1, {0.3, 1, 0}),
                                                 true, true}));

TEST(RangeUncertainty, TwoCamerasWereTurnedByTheirCalibration) {
  // A shift of one lens' centre looks like a rotation of its camera, which the pose has answered.
  const LensPtr left = asphere(), right = asphere();
  Eigen::MatrixXd covariance =
      Eigen::MatrixXd::Zero(left->parameters().size(), left->parameters().size());
  covariance(0, 0) = covariance(1, 1) = 1.0;
  StereoGeometry geometry;
  geometry.reference_lens = left;
  geometry.reference_size = kSize;
  geometry.displaced.push_back({right, kSize, test::pose(0.1, 0, 0)});
  geometry.displaced[0].covariance = covariance;
  const RangeUncertainty answered(geometry, 0.4, 1);
  // Untaken, a centre that is off by a pixel would be a pixel of parallax: 1.5 m^2 / (150 * 0.1 m).
  EXPECT_LT(answered.sigma(160, 130, 1.5), 0.3 * 1.5 * 1.5 / 15);
  EXPECT_GT(answered.sigma(160, 130, 1.5), 0.0);
}

TEST(RangeUncertainty, ScoresOfMatchesThroughAWrongLensAreNormal) {
  const LensPtr lens = asphere();
  const Eigen::MatrixXd covariance = lensCovariance(*lens, 1.5);
  const Pose step = test::pose(0.15, 0.02, 0);
  const auto scene = test::room(1.6, 0.09);
  const test::View reference = test::look(scene, *lens, kSize, Pose::Identity(), 2);
  const cv::Mat displaced = test::look(scene, *lens, kSize, step, 2).image;
  std::vector<double> with, without;
  std::mt19937 random(3);
  constexpr int kCalibrations = 10;
  for (int i = 0; i < kCalibrations; ++i) {
    const LensPtr wrong = lens->withParameters(lens->parameters() + draw(covariance, &random));
    ASSERT_TRUE(wrong);
    StereoGeometry geometry;
    geometry.reference_lens = wrong;
    geometry.reference_size = kSize;
    geometry.displaced.push_back({wrong, kSize, step});
    const MatchResult blind = makeSweepMatcher(geometry, {})->match(reference.image, {displaced});
    geometry.reference_covariance = covariance;
    const MatchResult told = makeSweepMatcher(geometry, {})->match(reference.image, {displaced});
    for (int y = 0; y < kSize.height; ++y) {
      for (int x = 0; x < kSize.width; ++x) {
        const double range = told.range.at<float>(y, x), truth = reference.range.at<double>(y, x);
        ASSERT_EQ(std::isnan(range), std::isnan(blind.range.at<float>(y, x)));
        if (std::isnan(range)) continue;
        ASSERT_TRUE(std::isfinite(told.sigma.at<float>(y, x)));
        if (std::isnan(truth)) continue;
        with.push_back(std::abs(range - truth) / told.sigma.at<float>(y, x));
        without.push_back(std::abs(range - truth) / blind.sigma.at<float>(y, x));
      }
    }
  }
  ASSERT_GT(with.size(), kCalibrations * 40000u);
  const auto quantile = [](std::vector<double>& values, double share) {
    const auto at = values.begin() + static_cast<std::ptrdiff_t>(share * (values.size() - 1));
    std::nth_element(values.begin(), at, values.end());
    return *at;
  };
  std::cout << "z: median " << quantile(with, 0.5) << ", 95 % " << quantile(with, 0.95)
            << "; without the lens' covariance " << quantile(without, 0.5) << ", "
            << quantile(without, 0.95) << '\n';
  // Of a normal distribution 0.67 and 1.96; ten calibrations do not make it a smooth one.
  EXPECT_GT(quantile(with, 0.5), 0.4);
  EXPECT_LT(quantile(with, 0.5), 1.0);
  EXPECT_LT(quantile(with, 0.95), 2.8);
  EXPECT_GT(quantile(without, 0.5), 1.5) << "the lens makes most of these errors";
}

TEST(RangeUncertainty, CovariancesOfAnotherShapeAreRefused) {
  StereoGeometry geometry;
  geometry.reference_lens = asphere();
  geometry.reference_size = kSize;
  geometry.displaced.push_back({geometry.reference_lens, kSize, test::pose(0.1, 0, 0)});
  EXPECT_FALSE(hasCovariance(geometry));
  geometry.reference_covariance = Eigen::MatrixXd::Identity(2, 2);
  EXPECT_THROW(makeSweepMatcher(geometry, {}), Error);
  EXPECT_THROW(makeThesisMatcher(geometry, {}), Error);
  geometry.reference_covariance = {};
  geometry.displaced[0].pose_covariance = Eigen::MatrixXd::Identity(3, 3);
  EXPECT_THROW(makeSweepMatcher(geometry, {}), Error);
  geometry.displaced[0].pose_covariance =
      Eigen::MatrixXd::Constant(6, 6, std::numeric_limits<double>::infinity());
  EXPECT_THROW(makeSweepMatcher(geometry, {}), Error);
}

TEST(RangeUncertainty, IsFiniteEverywhereAndTheSameForAnyNumberOfThreads) {
  StereoGeometry geometry;
  geometry.reference_lens = asphere();
  geometry.reference_size = kSize;
  // Along the axis: in the middle of the image there is no parallax.
  geometry.displaced.push_back({geometry.reference_lens, kSize, test::pose(0, 0, 0.2)});
  geometry.reference_covariance = lensCovariance(*geometry.reference_lens, 0.1);
  const RangeUncertainty one(geometry, 0.8, 1), many(geometry, 0.8, 3);
  for (double v = 0; v < kSize.height; v += 3.7) {
    for (double u = 0; u < kSize.width; u += 3.3) {
      for (const double range : {0.1, 0.8, 5.0, 1e4}) {
        const double sigma = one.sigma(u, v, range);
        ASSERT_TRUE(std::isfinite(sigma) && sigma >= 0) << u << " " << v << " " << range;
        ASSERT_EQ(sigma, many.sigma(u, v, range));
      }
    }
  }
  const Eigen::Vector2d epipole = *geometry.reference_lens->project({0, 0, 1});
  EXPECT_GT(one.sigma(epipole.x(), epipole.y(), 2.0), 10 * one.sigma(250, 130, 2.0));
}

}  // namespace
}  // namespace omnister
