// SPDX-License-Identifier: Apache-2.0
// One suite for every model and structure; closed forms of the single models below it.
#include "omnister/lens/lens_models.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <limits>
#include <random>

#include "omnister/common/error.h"
#include "omnister/lens/lens_part.h"
#include "omnister/lens/reduced_lens.h"

namespace omnister {
namespace {

using ::testing::HasSubstr;

constexpr double kDegree = 3.14159265358979323846 / 180.0;

struct Case {
  std::string name;
  LensStructure structure;
  double max_theta;
  Eigen::VectorXd surface;  // over makeLens()'s values when not empty: parameters from the third on
};

std::ostream& operator<<(std::ostream& out, const Case& c) { return out << c.name; }

LensStructure structure(const std::string& model, bool affinity = false, bool decentring = false,
                        int even_terms = 0, int knots = 12) {
  LensStructure out;
  out.model = model;
  out.affinity = affinity;
  out.decentring = decentring;
  out.even_terms = even_terms;
  out.knots = knots;
  return out;
}

Eigen::VectorXd numbers(std::initializer_list<double> values) {
  Eigen::VectorXd out(values.size());
  std::copy(values.begin(), values.end(), out.data());
  return out;
}

Eigen::VectorXd join(const Eigen::VectorXd& head, const Eigen::VectorXd& tail) {
  Eigen::VectorXd out(head.size() + tail.size());
  out << head, tail;
  return out;
}

// Radii of a lens that compresses its edge, as real ones do, with a slight wave.
Eigen::VectorXd wavyRadii(int knots, double focal, double span) {
  Eigen::VectorXd out(knots);
  for (int i = 1; i <= knots; ++i) {
    const double t = span * i / knots;
    out[i - 1] = focal * (t - 0.03 * t * t * t + 0.002 * std::sin(5.0 * t));
  }
  return out;
}

LensStructure gridStructure(int side, int even_terms) {
  LensStructure out = structure("spline", true, true, even_terms);
  out.grid = side;
  return out;
}

// Shifts of a few milliradians that are nothing but themselves.
Eigen::VectorXd bends(int side) {
  std::mt19937 random(3);
  std::uniform_real_distribution<double> unit(-0.004, 0.004);
  Eigen::VectorXd out(2 * side * side);
  for (double& value : out) value = unit(random);
  return out;
}

std::vector<Case> cases() {
  const Eigen::VectorXd affinity = numbers({0.004, -0.002});
  const Eigen::VectorXd decentring = numbers({1.5e-3, -0.8e-3});
  const Eigen::VectorXd conic = numbers({318.0, 0.58, 1.13});
  const Eigen::VectorXd asphere = numbers({300.0, 0.55, 1.05, -0.012, 0.004, -0.0006});
  const Eigen::VectorXd quadric = numbers({310.0, 33.0, 35.5});
  std::vector<Case> out{
      {"spherical", structure("spherical"), 80 * kDegree, {}},
      {"spherical_affinity", structure("spherical", true), 88 * kDegree,
       join(numbers({420.0}), affinity)},
      {"quadric", structure("quadric"), 95 * kDegree, {}},
      {"quadric_elliptic_wide", structure("quadric"), 150 * kDegree, quadric},
      {"quadric_affinity", structure("quadric", true), 110 * kDegree, join(quadric, affinity)},
      {"conic", structure("conic"), 95 * kDegree, {}},
      {"conic_wide", structure("conic"), 140 * kDegree, numbers({318.0, 0.51, 0.9})},
      {"conic_hyperbolic", structure("conic"), 60 * kDegree, numbers({800.0, 0.2, 1.4})},
      {"conic_pinhole", structure("conic"), 50 * kDegree, numbers({800.0, 0.0, 1.0})},
      {"conic_affinity", structure("conic", true), 115 * kDegree, join(conic, affinity)},
      {"asphere_0", structure("asphere"), 95 * kDegree, {}},
      {"asphere_1", structure("asphere", false, false, 1), 95 * kDegree, {}},
      {"asphere_2_affinity", structure("asphere", true, false, 2), 100 * kDegree,
       join(asphere.head(5), affinity)},
      {"asphere_3_all", structure("asphere", true, true, 3), 110 * kDegree,
       join(asphere, join(affinity, decentring))},
      {"asphere_3_turned",
       [] {
         LensStructure s = structure("asphere", true, true, 3);
         s.turn = true;
         return s;
       }(),
       110 * kDegree, join(asphere, join(numbers({0.004, -0.03, 0.033}), decentring))},
      {"spline_16_growing",
       [] {
         LensStructure s = structure("spline", false, true, 0, 16);
         s.decentring_growth = true;
         return s;
       }(),
       100 * kDegree,
       join(wavyRadii(16, 300.0, 100 * kDegree), numbers({1.5e-3, -0.8e-3, 0.7, -1.3}))},
      {"asphere_3_wide", structure("asphere", false, true, 3), 140 * kDegree, {}},
      {"spline_4", structure("spline", false, false, 0, 4), 95 * kDegree, {}},
      {"spline_12_wide", structure("spline", false, false, 0, 12), 150 * kDegree,
       wavyRadii(12, 300.0, 150 * kDegree)},
      {"spline_16_all", structure("spline", true, true, 0, 16), 110 * kDegree,
       join(wavyRadii(16, 300.0, 110 * kDegree), join(affinity, decentring))},
      {"spline_32", structure("spline", false, true, 0, 32), 95 * kDegree, {}},
      {"spline_grid_6", gridStructure(6, 2), 100 * kDegree,
       join(asphere.head(5), join(affinity, join(decentring, bends(6))))},
      {"spline_grid_12_wide", gridStructure(12, 3), 130 * kDegree,
       join(asphere, join(affinity, join(decentring, bends(12))))},
      {"conic_narrow", structure("conic"), 5 * kDegree, {}},
  };
  return out;
}

LensPtr build(const Case& c) {
  const LensPtr start = makeLens(c.structure, {652.3, 471.9}, 310.0, c.max_theta);
  if (c.surface.size() == 0) return start;
  Eigen::VectorXd parameters = start->parameters();
  EXPECT_EQ(parameters.size(), c.surface.size() + 2);
  parameters.tail(c.surface.size()) = c.surface;
  return start->withParameters(parameters);
}

Eigen::Vector3d direction(double theta, double phi) {
  return {std::sin(theta) * std::cos(phi), std::sin(theta) * std::sin(phi), std::cos(theta)};
}

double angleBetween(const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
  return std::atan2(a.cross(b).norm(), a.dot(b));
}

// The whole field, axis and border included.
std::vector<Eigen::Vector3d> field(double max_theta, int rings = 60, int rays = 17) {
  std::vector<Eigen::Vector3d> out;
  for (int i = 0; i <= rings; ++i) {
    for (int j = 0; j < rays; ++j) {
      out.push_back(direction(max_theta * i / rings, 2 * 180 * kDegree * (j + 0.3) / rays));
    }
  }
  return out;
}

class EveryLens : public ::testing::TestWithParam<Case> {
 protected:
  void SetUp() override {
    lens_ = build(GetParam());
    ASSERT_NE(lens_, nullptr);
  }
  LensPtr lens_;
};

TEST_P(EveryLens, RoundTripsOverTheWholeField) {
  const auto bearings = field(GetParam().max_theta);
  std::size_t done = 0;
  for (const auto& bearing : bearings) {
    const auto pixel = lens_->project(bearing);
    ASSERT_TRUE(pixel) << bearing.transpose();
    const auto back = lens_->unproject(*pixel);
    ASSERT_TRUE(back) << bearing.transpose() << " at " << pixel->transpose();
    EXPECT_NEAR(back->norm(), 1.0, 1e-14);
    EXPECT_LT(angleBetween(*back, bearing), 1e-9) << bearing.transpose();
    const auto again = lens_->project(*back);
    if (angleBetween(*back, Eigen::Vector3d::UnitZ()) <= GetParam().max_theta - 1e-9) {
      ASSERT_TRUE(again);
      EXPECT_LT((*again - *pixel).norm(), 1e-7);
    }
    ++done;
  }
  EXPECT_EQ(done, bearings.size());
}

TEST_P(EveryLens, RadiusRisesWithTheAngle) {
  for (double phi : {0.0, 0.7, 2.0, 3.5, 5.1}) {
    double last = -1.0;
    for (int i = 0; i <= 400; ++i) {
      const auto pixel = lens_->project(direction(GetParam().max_theta * i / 400, phi));
      ASSERT_TRUE(pixel);
      const double radius = (*pixel - lens_->center()).norm();
      EXPECT_GT(radius, last) << i;
      last = radius;
    }
  }
}

TEST_P(EveryLens, LengthOfTheBearingDoesNotMatter) {
  const Eigen::Vector3d bearing = direction(0.7 * GetParam().max_theta, 1.0);
  const auto pixel = lens_->project(bearing);
  ASSERT_TRUE(pixel);
  for (double length : {1e-300, 1e-150, 1e-9, 0.3, 7.0, 1e9, 1e150, 1e300}) {
    const auto scaled = lens_->project(length * bearing);
    ASSERT_TRUE(scaled) << length;
    EXPECT_LT((*scaled - *pixel).norm(), 1e-9) << length;
  }
}

TEST_P(EveryLens, BearingJacobianMatchesDifferences) {
  int compared = 0;
  for (const auto& n : field(0.995 * GetParam().max_theta, 12, 7)) {
    const Eigen::Vector3d bearing = 1.7 * n;
    Jacobian23 d;
    ASSERT_TRUE(lens_->project(bearing, &d));
    constexpr double kStep = 1e-5;
    for (int k = 0; k < 3; ++k) {
      Eigen::Vector3d step = Eigen::Vector3d::Zero();
      step[k] = kStep;
      const auto more = lens_->project(bearing + step);
      const auto less = lens_->project(bearing - step);
      ASSERT_TRUE(more && less);
      const Eigen::Vector2d expected = (*more - *less) / (2 * kStep);
      EXPECT_LT((d.col(k) - expected).norm(), 1e-4 * (1.0 + d.norm())) << n.transpose();
      ++compared;
    }
  }
  EXPECT_EQ(compared, 13 * 7 * 3);
}

TEST_P(EveryLens, ParameterJacobianMatchesDifferences) {
  const Eigen::VectorXd parameters = lens_->parameters();
  ASSERT_EQ(parameters.size(), static_cast<int>(lens_->parameterNames().size()));
  int compared = 0;
  for (const auto& n : field(0.99 * GetParam().max_theta, 10, 5)) {
    JacobianParams d;
    ASSERT_TRUE(lens_->project(n, nullptr, &d));
    ASSERT_EQ(d.cols(), parameters.size());
    for (int k = 0; k < parameters.size(); ++k) {
      const double step = 1e-6 * std::max(1e-1, std::abs(parameters[k]));
      Eigen::VectorXd more = parameters;
      Eigen::VectorXd less = parameters;
      more[k] += step;
      less[k] -= step;
      const LensPtr high = lens_->withParameters(more, 0.995 * GetParam().max_theta);
      LensPtr low = lens_->withParameters(less, 0.995 * GetParam().max_theta);
      ASSERT_NE(high, nullptr) << k;
      double span = 2 * step;
      if (low == nullptr) {  // alpha = 0 has nothing below it
        low = lens_;
        span = step;
      }
      const Eigen::Vector2d expected = (*high->project(n) - *low->project(n)) / span;
      EXPECT_LT((d.col(k) - expected).norm(),
                (span == step ? 1e-3 : 2e-5) * (1.0 + d.col(k).norm()))
          << lens_->parameterNames()[k] << " at " << n.transpose();
      ++compared;
    }
  }
  EXPECT_EQ(compared, 11 * 5 * parameters.size());
}

TEST_P(EveryLens, PixelJacobianMatchesDifferences) {
  int compared = 0;
  for (const auto& n : field(0.99 * GetParam().max_theta, 12, 7)) {
    const auto pixel = lens_->project(n);
    ASSERT_TRUE(pixel);
    Jacobian32 d;
    ASSERT_TRUE(lens_->unproject(*pixel, &d));
    const double step = 1e-3;
    for (int k = 0; k < 2; ++k) {
      Eigen::Vector2d h = Eigen::Vector2d::Zero();
      h[k] = step;
      const auto more = lens_->unproject(*pixel + h);
      const auto less = lens_->unproject(*pixel - h);
      ASSERT_TRUE(more && less);
      EXPECT_LT((d.col(k) - (*more - *less) / (2 * step)).norm(), 1e-4 * d.norm() + 1e-10)
          << n.transpose();
      ++compared;
    }
    // Both Jacobians are inverse to each other on the tangent plane.
    Jacobian23 d_bearing;
    ASSERT_TRUE(lens_->project(n, &d_bearing));
    EXPECT_LT((d_bearing * d - Eigen::Matrix2d::Identity()).norm(), 1e-6);
    EXPECT_LT((n.transpose() * d).norm(), 1e-9 * (1.0 + d.norm()));
  }
  EXPECT_EQ(compared, 13 * 7 * 2);
}

TEST_P(EveryLens, SurfaceHeightGivesTheRay) {
  const LensStructure s = structureOf(*lens_);
  if (s.decentring || s.affinity || s.grid > 0) {
    // Rays are (x, y, h) before decentring and after the affinity is undone: look at the bare
    // surface.
    LensStructure bare = s;
    bare.decentring_growth = bare.decentring = bare.affinity = bare.turn = false;
    if (s.grid > 0) bare.model = "asphere";
    bare.grid = 0;
    const LensPtr start = makeLens(bare, lens_->center(), 300.0, GetParam().max_theta);
    lens_ = start->withParameters(lens_->parameters().head(start->parameters().size()));
    ASSERT_NE(lens_, nullptr);
  }
  int compared = 0;
  for (const auto& n : field(0.999 * GetParam().max_theta, 20, 7)) {
    const Eigen::Vector2d xy = *lens_->project(n) - lens_->center();
    const auto height = lens_->surfaceHeight(xy.x(), xy.y());
    ASSERT_TRUE(height);
    EXPECT_LT(angleBetween({xy.x(), xy.y(), *height}, n), 1e-9);
    ++compared;
  }
  EXPECT_EQ(compared, 21 * 7);
  EXPECT_FALSE(lens_->surfaceHeight(1e8, 0.0));
}

TEST_P(EveryLens, NothingComesFromOutside) {
  const double max_theta = GetParam().max_theta;
  constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
  constexpr double kInf = std::numeric_limits<double>::infinity();
  EXPECT_FALSE(lens_->project(direction(max_theta + 1e-3, 0.4)));
  EXPECT_FALSE(lens_->project({0.0, 0.0, -1.0}));
  EXPECT_FALSE(lens_->project({0.0, 0.0, 0.0}));
  EXPECT_FALSE(lens_->project({kNaN, 0.0, 1.0}));
  EXPECT_FALSE(lens_->project({0.0, kInf, 1.0}));
  EXPECT_FALSE(lens_->unproject({kNaN, 3.0}));
  EXPECT_FALSE(lens_->unproject({kInf, 3.0}));
  EXPECT_FALSE(lens_->unproject({1e8, -1e8}));
  const Eigen::Vector2d axis = *lens_->project({0.0, 0.0, 2.0});
  // A grid may shift the axis too, by a few milliradians here.
  EXPECT_LT((axis - lens_->center()).norm(), structureOf(*lens_).grid > 0 ? 2.0 : 1e-12);
  EXPECT_LT(angleBetween(*lens_->unproject(axis), Eigen::Vector3d::UnitZ()), 1e-12);
  // Just beyond the border on the image: outside, or still a ray that lies within the field.
  int outside = 0;
  for (int j = 0; j < 24; ++j) {
    const Eigen::Vector2d edge =
        *lens_->project(direction(max_theta, j * 15 * kDegree)) - lens_->center();
    const auto ray = lens_->unproject(lens_->center() + 1.01 * edge);
    outside += ray ? 0 : 1;
  }
  EXPECT_EQ(outside, 24);
}

TEST_P(EveryLens, RandomPixelsNeverGiveAWrongRay) {
  std::mt19937 random(7);
  const double reach = 8.0 * 310.0 * GetParam().max_theta;
  std::uniform_real_distribution<double> u(-reach, reach);
  int inside = 0;
  for (int i = 0; i < 5000; ++i) {
    const Eigen::Vector2d pixel(u(random) + 650, u(random) + 470);
    const auto ray = lens_->unproject(pixel);
    if (!ray) continue;
    ++inside;
    EXPECT_LE(std::acos(std::clamp(ray->z(), -1.0, 1.0)), GetParam().max_theta + 1e-6);
    const auto back = lens_->project(*ray);
    ASSERT_TRUE(back);
    EXPECT_LT((*back - pixel).norm(), 1e-6);
  }
  EXPECT_GT(inside, 20);
  EXPECT_LT(inside, 4900);
}

TEST_P(EveryLens, StructureAndNumbersComeBack) {
  const LensStructure s = structureOf(*lens_);
  const LensStructure& expected = GetParam().structure;
  EXPECT_EQ(s.model, expected.model);
  EXPECT_EQ(s.model, lens_->model());
  EXPECT_EQ(s.affinity, expected.affinity);
  EXPECT_EQ(s.turn, expected.turn);
  EXPECT_EQ(s.decentring_growth, expected.decentring_growth);
  EXPECT_EQ(s.decentring, expected.decentring);
  EXPECT_EQ(s.grid, expected.grid);
  if (s.model == "asphere" || s.grid > 0) {
    EXPECT_EQ(s.even_terms, expected.even_terms);
  }
  if (s.model == "spline" && s.grid == 0) {
    EXPECT_EQ(s.knots, expected.knots);
  }
  std::map<std::string, std::vector<double>> named;
  for (const auto& [name, values] : namedParameters(*lens_)) named[name] = values;
  const LensPtr again = makeLens(lens_->model(), lens_->center(), named, lens_->maxTheta(), "test");
  ASSERT_NE(again, nullptr);
  EXPECT_EQ(again->parameters(), lens_->parameters());
  EXPECT_EQ(again->parameterNames(), lens_->parameterNames());
  EXPECT_EQ(again->maxTheta(), lens_->maxTheta());
  for (const auto& n : field(GetParam().max_theta, 10, 5)) {
    EXPECT_EQ(*again->project(n), *lens_->project(n));
  }
}

TEST_P(EveryLens, APartOfTheSensorSeesTheSameRays) {
  LensFile whole;
  whole.image_size = {1280, 960};
  whole.lens = lens_;
  whole.calibration.rms_px = 0.3;
  for (const cv::Size& binning : {cv::Size(1, 1), cv::Size(2, 2), cv::Size(4, 4), cv::Size(2, 1)}) {
    const LensFile part = partOfLens(whole, {101, 60, 900, 701}, binning);
    EXPECT_EQ(part.image_size, cv::Size(900 / binning.width, 701 / binning.height));
    EXPECT_EQ(part.lens->model(), lens_->model());
    std::size_t done = 0;
    const auto bearings = field(GetParam().max_theta, 20, 9);
    for (const auto& bearing : bearings) {
      const auto pixel = lens_->project(bearing);
      const auto there = part.lens->project(bearing);
      ASSERT_TRUE(pixel && there) << bearing.transpose();
      // Pixel u of the part covers those from 101 + bins u on.
      const Eigen::Vector2d bins(binning.width, binning.height);
      const Eigen::Vector2d expected =
          (pixel->array() - Eigen::Array2d(101, 60) + 0.5) / bins.array() - 0.5;
      EXPECT_LT((*there - expected).norm(), 1e-8 * (1.0 + pixel->norm()));
      ++done;
    }
    EXPECT_EQ(done, bearings.size());
    EXPECT_EQ(part.calibration.rms_px, 0.3 / binning.height);
  }
  EXPECT_THROW(partOfLens(whole, {400, 0, 900, 100}, {1, 1}), InputError);
  EXPECT_THROW(partOfLens(whole, {0, 0, 3, 3}, {4, 4}), InputError);
  EXPECT_THROW(partOfLens(whole, {0, 0, 8, 8}, {0, 1}), InputError);
}

TEST_P(EveryLens, RefusesNumbersThatMakeNoLens) {
  const Eigen::VectorXd good = lens_->parameters();
  EXPECT_EQ(lens_->withParameters(good.head(good.size() - 1)), nullptr);
  for (int k = 0; k < good.size(); ++k) {
    for (double bad : {std::numeric_limits<double>::quiet_NaN(),
                       std::numeric_limits<double>::infinity(), 1e300, -1e300}) {
      Eigen::VectorXd parameters = good;
      parameters[k] = bad;
      EXPECT_EQ(lens_->withParameters(parameters), nullptr) << k << " " << bad;
    }
  }
  Eigen::VectorXd flipped = good;
  flipped[2] = -flipped[2];
  EXPECT_EQ(lens_->withParameters(flipped), nullptr);
  for (double max_theta : {0.0, -1.0, 3.2, 1e9, std::numeric_limits<double>::quiet_NaN()}) {
    if (GetParam().structure.model == "spherical" && max_theta > 1.0) continue;  // cut to pi/2
    EXPECT_EQ(lens_->withParameters(good, max_theta), nullptr) << max_theta;
  }
  ASSERT_NE(lens_->withParameters(good, 0.5 * GetParam().max_theta), nullptr);
  EXPECT_EQ(lens_->withParameters(good, 0.5 * GetParam().max_theta)->maxTheta(),
            0.5 * GetParam().max_theta);
}

// Numbers at random: whatever is accepted is one-to-one and round-trips.
TEST_P(EveryLens, WhatIsAcceptedIsOneToOne) {
  std::mt19937 random(11);
  std::normal_distribution<double> gauss;
  int accepted = 0;
  const Eigen::VectorXd good = lens_->parameters();
  for (int i = 0; i < 300; ++i) {
    Eigen::VectorXd parameters = good;
    const double size = std::pow(10.0, -3.0 + 3.0 * (i % 10) / 10.0);
    for (int k = 2; k < parameters.size(); ++k) {
      parameters[k] += size * gauss(random) * std::max(std::abs(parameters[k]), 0.02);
    }
    const LensPtr lens = lens_->withParameters(parameters);
    if (lens == nullptr) continue;
    ++accepted;
    for (double phi : {0.5, 3.9}) {
      double last = -1.0;
      for (int j = 0; j <= 50; ++j) {
        const Eigen::Vector3d n = direction(lens->maxTheta() * j / 50, phi);
        const auto pixel = lens->project(n);
        ASSERT_TRUE(pixel);
        const auto back = lens->unproject(*pixel);
        ASSERT_TRUE(back) << lens->parameters().transpose() << " / " << n.transpose();
        EXPECT_LT(angleBetween(*back, n), 1e-9) << lens->parameters().transpose();
        const double radius = (*pixel - lens->center()).norm();
        if (!structureOf(*lens).decentring && !structureOf(*lens).affinity) {
          EXPECT_GT(radius, last);
        }
        last = radius;
      }
    }
  }
  EXPECT_GT(accepted, 60);
}

INSTANTIATE_TEST_SUITE_P(AllModels, EveryLens, ::testing::ValuesIn(cases()),
                         [](const auto& info) { return info.param.name; });

// ---------------------------------------------------------------- closed forms

TEST(Spherical, IsTheOrthographicFisheye) {  // Johnson 1997, eqs 4.1-4.4
  constexpr double R = 470.0;
  const LensPtr lens = makeLens("spherical", {0.0, 0.0}, {{"R", {R}}}, 89 * kDegree, "test");
  int compared = 0;
  for (double u = -900; u <= 900; u += 90) {
    for (double v = -900; v <= 900; v += 90) {
      const double n = std::sqrt(u * u + v * v + R * R);
      const auto pixel = lens->project({u, v, R});
      ASSERT_TRUE(pixel);
      EXPECT_NEAR(pixel->x(), R * u / n, 1e-10);
      EXPECT_NEAR(pixel->y(), R * v / n, 1e-10);
      const double h = *lens->surfaceHeight(pixel->x(), pixel->y());
      EXPECT_NEAR(R * pixel->x() / h, u, 1e-8);
      ++compared;
    }
  }
  EXPECT_EQ(compared, 21 * 21);
}

TEST(Quadric, HasTheThesisClosedForms) {  // Johnson 1997, eqs 4.26-4.32, the lens of sec. 4.3
  constexpr double R0 = 2405.0;
  const double a = 1.0 / std::sqrt(3.2215e-4);
  const double b = 1.0 / std::sqrt(3.3610e-4);
  const LensPtr lens = makeLens("quadric", {1530.0, 1018.0}, {{"R0", {R0}}, {"a", {a}}, {"b", {b}}},
                                80 * kDegree, "test");
  int compared = 0;
  for (double u = -4000; u <= 4000; u += 400) {
    for (double v = -4000; v <= 4000; v += 400) {
      const double q = u * u / (a * a) + v * v / (b * b);
      const double t = 2.0 / (1.0 + std::sqrt(1.0 + 4.0 * q / R0));
      const auto pixel = lens->project({u, v, R0});
      ASSERT_TRUE(pixel);
      const double x = pixel->x() - 1530.0;
      const double y = pixel->y() - 1018.0;
      EXPECT_NEAR(x, u * t, 1e-9);
      EXPECT_NEAR(y, v * t, 1e-9);
      const double h = *lens->surfaceHeight(x, y);
      EXPECT_NEAR(h, R0 - x * x / (a * a) - y * y / (b * b), 1e-9);
      EXPECT_NEAR(R0 * x / h, u, 1e-8);
      EXPECT_NEAR(R0 * y / h, v, 1e-8);
      ++compared;
    }
  }
  EXPECT_EQ(compared, 21 * 21);
}

TEST(Quadric, IsStereographicWhenRound) {  // 1/a^2 = 1/(4 R0)
  constexpr double R0 = 300.0;
  const double a = 2.0 * std::sqrt(R0);
  const LensPtr lens =
      makeLens("quadric", {0.0, 0.0}, {{"R0", {R0}}, {"a", {a}}, {"b", {a}}}, 3.0, "test");
  for (int i = 0; i <= 300; ++i) {
    const double theta = 0.01 * i;
    EXPECT_NEAR(lens->project(direction(theta, 0.9))->norm(), 2 * R0 * std::tan(theta / 2),
                1e-9 * (1 + R0 * std::tan(theta / 2)));
  }
}

TEST(Conic, IsTheEnhancedUnifiedCameraModel) {  // Khomutenko et al. 2016
  struct Numbers {
    double f, alpha, beta, max_theta;
  };
  int compared = 0;
  for (const Numbers& k : {Numbers{460.9, 0.5865, 1.1392, 1.9}, Numbers{300.0, 0.3, 0.7, 1.6},
                           Numbers{300.0, 0.5, 1.0, 2.8}, Numbers{200.0, 1.0, 1.0, 1.5}}) {
    const LensPtr lens =
        makeLens("conic", {400.0, 300.0}, {{"f", {k.f}}, {"alpha", {k.alpha}}, {"beta", {k.beta}}},
                 k.max_theta, "test");
    for (const auto& n : field(k.max_theta, 40, 9)) {
      const double d = std::sqrt(k.beta * n.head<2>().squaredNorm() + n.z() * n.z());
      const Eigen::Vector2d expected = Eigen::Vector2d(400.0, 300.0) +
                                       k.f * n.head<2>() / (k.alpha * d + (1.0 - k.alpha) * n.z());
      const auto pixel = lens->project(n);
      ASSERT_TRUE(pixel);
      EXPECT_LT((*pixel - expected).norm(), 1e-8);
      // The surface of design: alpha^2 beta r^2 + (2 alpha - 1) h^2 + 2 (1 - alpha) h = 1, scaled.
      const Eigen::Vector2d xy = *pixel - lens->center();
      const double h = *lens->surfaceHeight(xy.x(), xy.y()) / k.f;
      EXPECT_NEAR(k.alpha * k.alpha * k.beta * xy.squaredNorm() / (k.f * k.f) +
                      (2 * k.alpha - 1) * h * h + 2 * (1 - k.alpha) * h,
                  1.0, 1e-10 * (1.0 + h * h));
      ++compared;
    }
  }
  EXPECT_EQ(compared, 4 * 41 * 9);
}

TEST(Conic, RefusesFieldsBeyondItsEnd) {
  const auto conic = [](double alpha, double beta, double max_theta) {
    return makeLens("conic", {0.0, 0.0}, {{"f", {300.0}}, {"alpha", {alpha}}, {"beta", {beta}}},
                    max_theta, "test");
  };
  EXPECT_NE(conic(0.6, 1.0, 1.9), nullptr);
  EXPECT_THROW(conic(0.6, 1.0, 2.8), InputError);   // stands upright before
  EXPECT_THROW(conic(0.0, 1.0, 1.58), InputError);  // a pinhole ends at 90 degrees
  EXPECT_THROW(conic(-0.1, 1.0, 0.5), InputError);
  EXPECT_THROW(conic(0.5, 0.0, 0.5), InputError);
}

TEST(Asphere, WithoutTermsIsTheConic) {
  const std::map<std::string, std::vector<double>> numbers{
      {"f", {318.0}}, {"alpha", {0.58}}, {"beta", {1.13}}};
  const LensPtr conic = makeLens("conic", {10.0, 20.0}, numbers, 1.9, "test");
  const LensPtr asphere = makeLens("asphere", {10.0, 20.0}, numbers, 1.9, "test");
  for (const auto& n : field(1.9)) {
    EXPECT_LT((*conic->project(n) - *asphere->project(n)).norm(), 1e-10);
  }
}

TEST(Asphere, SagIsConicPlusEvenTerms) {
  const LensPtr conic = makeLens(
      "conic", {0.0, 0.0}, {{"f", {318.0}}, {"alpha", {0.55}}, {"beta", {1.05}}}, 1.9, "test");
  const LensPtr asphere = makeLens("asphere", {0.0, 0.0},
                                   {{"f", {318.0}},
                                    {"alpha", {0.55}},
                                    {"beta", {1.05}},
                                    {"a4", {-0.01}},
                                    {"a6", {2e-3}},
                                    {"a8", {-1e-4}}},
                                   1.8, "test");
  for (double r = 0; r < 500; r += 25) {
    const double rho2 = r * r / (318.0 * 318.0);
    const double extra = 318.0 * rho2 * rho2 * (-0.01 + rho2 * (2e-3 - 1e-4 * rho2));
    ASSERT_TRUE(asphere->surfaceHeight(r, 0.0)) << r;
    EXPECT_NEAR(*asphere->surfaceHeight(r, 0.0), *conic->surfaceHeight(0.0, r) + extra, 1e-9);
  }
}

TEST(Spline, PassesThroughItsKnotsAndIsSmooth) {
  constexpr int kKnots = 10;
  const double span = 100 * kDegree;
  const Eigen::VectorXd radii = wavyRadii(kKnots, 300.0, span);
  const LensPtr lens = makeLens(
      "spline", {0.0, 0.0},
      {{"span", {span}}, {"radii", std::vector<double>(radii.data(), radii.data() + kKnots)}}, span,
      "test");
  for (int i = 1; i <= kKnots; ++i) {
    EXPECT_NEAR(lens->project(direction(span * i / kKnots, 2.0))->norm(), radii[i - 1], 1e-9);
  }
  const auto radius = [&](double theta) { return lens->project(direction(theta, 0.0))->x(); };
  constexpr double kStep = 1e-4;
  const auto second = [&](double theta) {
    return (radius(theta + kStep) - 2 * radius(theta) + radius(theta - kStep)) / (kStep * kStep);
  };
  for (int i = 1; i < kKnots; ++i) {
    const double theta = span * i / kKnots;
    EXPECT_NEAR(second(theta - 2 * kStep), second(theta + 2 * kStep), 0.5) << i;
  }
  // A cubic odd in theta is met exactly.
  std::vector<double> cubic;
  for (int i = 1; i <= kKnots; ++i) {
    const double t = span * i / kKnots;
    cubic.push_back(300.0 * (t - 0.04 * t * t * t));
  }
  const LensPtr exact =
      makeLens("spline", {0.0, 0.0}, {{"span", {span}}, {"radii", cubic}}, span, "test");
  for (int i = 0; i <= 200; ++i) {
    const double t = span * i / 200;
    EXPECT_NEAR(exact->project(direction(t, 0.0))->x(), 300.0 * (t - 0.04 * t * t * t), 1e-9);
  }
}

TEST(Spline, GoesOnStraightBeyondItsSpan) {
  const LensPtr lens = makeLens(structure("spline"), {0.0, 0.0}, 300.0, 1.5);
  const LensPtr wider = lens->withParameters(lens->parameters(), 2.2);
  ASSERT_NE(wider, nullptr);
  EXPECT_NEAR(wider->project(direction(2.1, 0.0))->x(), 300.0 * 2.1, 1e-9);
  EXPECT_EQ(*wider->project(direction(1.2, 1.0)), *lens->project(direction(1.2, 1.0)));
  const LensPtr bent = [&] {
    Eigen::VectorXd p = wider->parameters();
    p.tail(12) = wavyRadii(12, 300.0, 1.5);
    return wider->withParameters(p);
  }();
  ASSERT_NE(bent, nullptr);
  JacobianParams d;
  const Eigen::Vector3d n = direction(1.9, 0.6);
  ASSERT_TRUE(bent->project(n, nullptr, &d));
  for (int k = 2; k < d.cols(); ++k) {
    Eigen::VectorXd p = bent->parameters();
    p[k] += 1e-4;
    EXPECT_LT(((*bent->withParameters(p)->project(n) - *bent->project(n)) / 1e-4 - d.col(k)).norm(),
              1e-5);
  }
  EXPECT_LT(angleBetween(*bent->unproject(*bent->project(n)), n), 1e-9);
}

TEST(Decentring, IsBrownsTangentialTerms) {
  constexpr double kD1 = 2e-3;
  constexpr double kD2 = -1e-3;
  const std::map<std::string, std::vector<double>> plain{
      {"f", {300.0}}, {"alpha", {0.5}}, {"beta", {1.0}}};
  auto with = plain;
  with["d1"] = {kD1};
  with["d2"] = {kD2};
  // Stereographic: sensor coordinates are 2 f tan(theta / 2).
  const LensPtr lens = makeLens("asphere", {0.0, 0.0}, with, 2.0, "test");
  for (const auto& n : field(2.0, 20, 9)) {
    const double x = n.x() / (1 + n.z());
    const double y = n.y() / (1 + n.z());
    const double rr = x * x + y * y;
    const double sine = n.head<2>().norm();
    Eigen::Vector2d angles = n.head<2>();
    if (sine > 0.0) angles *= std::atan2(sine, n.z()) / sine;
    angles += (1 + rr) * Eigen::Vector2d(2 * kD1 * x * y + kD2 * (rr + 2 * x * x),
                                         kD1 * (rr + 2 * y * y) + 2 * kD2 * x * y);
    const double theta = angles.norm();
    Eigen::Vector2d expected = Eigen::Vector2d::Zero();
    if (theta > 0.0) expected = 600.0 * std::tan(0.5 * theta) / theta * angles;
    EXPECT_LT((*lens->project(n) - expected).norm(), 1e-9);
  }
  with["d1"] = {0.2};  // folds over within the field
  EXPECT_THROW(makeLens("asphere", {0.0, 0.0}, with, 2.0, "test"), InputError);
}

TEST(Affinity, IsAspectAndShear) {
  const LensPtr lens = makeLens(
      "quadric", {100.0, 50.0},
      {{"R0", {300.0}}, {"a", {30.0}}, {"b", {30.0}}, {"p", {0.01}}, {"q", {-0.02}}}, 1.5, "test");
  const LensPtr plain =
      makeLens("quadric", {0.0, 0.0}, {{"R0", {300.0}}, {"a", {30.0}}, {"b", {30.0}}}, 1.5, "test");
  const Eigen::Vector3d n(0.3, -0.5, 0.4);
  const Eigen::Vector2d xy = *plain->project(n);
  const Eigen::Vector2d expected(100.0 + 1.01 * xy.x() - 0.02 * xy.y(), 50.0 + xy.y());
  EXPECT_LT((*lens->project(n) - expected).norm(), 1e-10);
}

// ---------------------------------------------------------------- making

TEST(MakeLens, StartsNearTheEquidistantFisheye) {
  for (const std::string& model : lensModelNames()) {
    for (double degrees : {20.0, 60.0, 95.0, 110.0}) {
      LensStructure s;
      s.model = model;
      s.even_terms = 2;
      const LensPtr lens = makeLens(s, {320.0, 240.0}, 200.0, degrees * kDegree);
      ASSERT_NE(lens, nullptr);
      if (model == "spherical" && degrees > 90) {
        EXPECT_NEAR(lens->maxTheta(), 90 * kDegree, 2e-3);
        continue;
      }
      double worst = 0.0;
      for (int i = 0; i <= 100; ++i) {
        const double theta = lens->maxTheta() * i / 100;
        const auto pixel = lens->project(direction(theta, 0.3));
        ASSERT_TRUE(pixel);
        worst = std::max(worst, std::abs((*pixel - lens->center()).norm() - 200.0 * theta));
      }
      EXPECT_LT(worst, model == "spherical" ? 60.0
                       : model == "quadric" ? 30.0
                                            : 4.0)
          << model << " " << degrees;
    }
  }
  // Fields next to 180 degrees to each side start too.
  for (const char* model : {"quadric", "conic", "asphere", "spline"}) {
    EXPECT_NE(makeLens(structure(model), {0.0, 0.0}, 200.0, 3.0), nullptr);
  }
}

TEST(MakeLens, RefusesWhatNoLensIs) {
  const auto message = [](const LensStructure& s, double focal, double max_theta) -> std::string {
    try {
      makeLens(s, {0.0, 0.0}, focal, max_theta);
    } catch (const Error& error) {
      return error.what();
    }
    return "";
  };
  EXPECT_THAT(message(structure("fisheye"), 300, 1.0), HasSubstr("fisheye"));
  EXPECT_THAT(message(structure("conic", false, true), 300, 1.0), HasSubstr("decentring"));
  EXPECT_THAT(message(structure("asphere", false, false, 4), 300, 1.0), HasSubstr("4 even terms"));
  EXPECT_THAT(message(structure("spline", false, false, 0, 3), 300, 1.0), HasSubstr("3 knots"));
  EXPECT_THAT(message(structure("spline", false, false, 0, 33), 300, 1.0), HasSubstr("33 knots"));
  EXPECT_THAT(message(structure("conic"), -1, 1.0), HasSubstr("focal"));
  EXPECT_THAT(message(structure("conic"), std::nan(""), 1.0), HasSubstr("focal"));
  EXPECT_THAT(message(structure("conic"), 300, 3.2), HasSubstr("field"));
  EXPECT_THAT(message(structure("conic"), 300, 0.0), HasSubstr("field"));
}

TEST(MakeLens, NamesWhatIsWrongInAFile) {
  using Named = std::map<std::string, std::vector<double>>;
  const auto message = [](const std::string& model, const Named& named,
                          double max_theta = 1.0) -> std::string {
    try {
      makeLens(model, {0.0, 0.0}, named, max_theta, "wide.yaml");
    } catch (const InputError& error) {
      return error.what();
    }
    return "";
  };
  const Named conic{{"f", {300.0}}, {"alpha", {0.6}}, {"beta", {1.1}}};
  const auto plus = [&](const std::string& name, std::vector<double> values) {
    Named out = conic;
    out[name] = std::move(values);
    return out;
  };
  EXPECT_EQ(message("conic", conic), "");
  EXPECT_THAT(message("banana", conic), HasSubstr("wide.yaml: lens_surface.model: is \"banana\""));
  EXPECT_THAT(message("conic", {{"f", {300.0}}}), HasSubstr("parameters.alpha: is missing"));
  EXPECT_THAT(message("conic", plus("gamma", {1.0})),
              HasSubstr("parameters.gamma: is no parameter"));
  EXPECT_THAT(message("conic", plus("a4", {1.0})), HasSubstr("a4"));
  EXPECT_THAT(message("conic", plus("d1", {1.0})), HasSubstr("decentring"));
  EXPECT_THAT(message("conic", plus("alpha", {1.0, 2.0})), HasSubstr("2 numbers"));
  EXPECT_THAT(message("conic", plus("alpha", {std::nan("")})), HasSubstr("alpha: is nan"));
  EXPECT_THAT(message("conic", plus("f", {-3.0})), HasSubstr("one-to-one"));
  EXPECT_THAT(message("conic", conic, 3.5), HasSubstr("max_theta"));
  EXPECT_THAT(message("asphere", plus("a6", {0.1})), HasSubstr("a4: is missing"));
  EXPECT_THAT(message("spherical", {{"R", {300.0}}}, 1.7), HasSubstr("spherical"));
  EXPECT_THAT(message("spline", {{"span", {1.0}}}), HasSubstr("radii: is missing"));
  EXPECT_THAT(message("spline", {{"radii", {1, 2, 3, 4}}}), HasSubstr("span: is missing"));
  EXPECT_THAT(message("spline", {{"span", {1.0}}, {"radii", {1, 2, 3}}}), HasSubstr("3 numbers"));
  EXPECT_THAT(message("spline", {{"span", {1.0}}, {"radii", {1, 2, 1.5, 4}}}),
              HasSubstr("one-to-one"));
  EXPECT_THAT(message("spline", {{"span", {1.0}}, {"radii", {1, 2, 3, 4}}, {"r1", {1}}}),
              HasSubstr("r1"));
}

TEST(ReducedLens, PixelsCoverSquaresOfTheFullImage) {
  LensStructure structure;
  structure.model = "conic";
  const LensPtr lens = makeLens(structure, {320.3, 239.8}, 200.0, 1.4);
  EXPECT_EQ(reducedLens(lens, 1), lens);
  const LensPtr half = reducedLens(lens, 2), fifth = reducedLens(lens, 5);
  // The first pixel of the half image lies between four of the full one.
  const auto corner = half->unproject({100.0, 80.0});
  const auto full = lens->unproject({200.5, 160.5});
  ASSERT_TRUE(corner && full);
  EXPECT_LT((*corner - *full).norm(), 1e-12);
  for (const LensPtr& reduced : {half, fifth}) {
    const Eigen::Vector3d ray = Eigen::Vector3d(0.4, -0.3, 0.6).normalized();
    Jacobian23 slope;
    const auto pixel = reduced->project(ray, &slope, nullptr);
    ASSERT_TRUE(pixel);
    const auto back = reduced->unproject(*pixel);
    ASSERT_TRUE(back);
    EXPECT_LT((*back - ray).norm(), 1e-9);
    const double step = 1e-6;
    const auto beside = reduced->project(ray + step * Eigen::Vector3d::UnitX());
    ASSERT_TRUE(beside);
    EXPECT_LT(((*beside - *pixel) / step - slope.col(0)).norm(), 1e-2);
  }
  EXPECT_NEAR(*half->surfaceHeight(10, 5), *lens->surfaceHeight(20, 10) / 2, 1e-12);
  EXPECT_THROW(reducedLens(lens, 0), Error);
  EXPECT_THROW(reducedLens(nullptr, 2), Error);
}

}  // namespace
}  // namespace omnister
