// SPDX-License-Identifier: Apache-2.0
#include "omnister/view/view.h"

#include <gtest/gtest.h>

#include <cmath>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>
#include <random>
#include <string>

#include "../sim/equidistant_lens.h"
#include "omnister/common/error.h"
#include "omnister/lens/lens_models.h"
#include "omnister/sim/renderer.h"

namespace omnister {
namespace {

using test::EquidistantLens;

constexpr double kDegree = M_PI / 180.0;

TEST(ViewRotation, PanTurnsRightTiltDownRollClockwise) {
  const Eigen::Vector3d ahead = Eigen::Vector3d::UnitZ();
  EXPECT_TRUE(
      (viewRotation(0.3, 0, 0) * ahead).isApprox(Eigen::Vector3d(std::sin(0.3), 0, std::cos(0.3))));
  EXPECT_TRUE(
      (viewRotation(0, 0.3, 0) * ahead).isApprox(Eigen::Vector3d(0, std::sin(0.3), std::cos(0.3))));
  // Clockwise: the view's right edge sinks.
  EXPECT_TRUE((viewRotation(0, 0, 0.3) * Eigen::Vector3d::UnitX())
                  .isApprox(Eigen::Vector3d(std::cos(0.3), std::sin(0.3), 0)));
  // Tilt after pan: the horizon stays level.
  EXPECT_NEAR((viewRotation(0.7, 0.4, 0) * Eigen::Vector3d::UnitX()).y(), 0.0, 1e-15);
}

TEST(View, SphericalLensGivesTheEquationsOfOmniview) {
  // Johnson 1997, eqs 2.11 and 2.12, written out.
  const double R = 400.0;
  const Eigen::Vector2d center(399.5, 401.25);
  const LensPtr lens = makeLens("spherical", center, {{"R", {R}}}, 85 * kDegree, "test");
  std::mt19937 random(7);
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  int compared = 0;
  for (int view = 0; view < 40; ++view) {
    const double beta = 0.7 * std::abs(uniform(random));
    const double delta = M_PI * uniform(random);
    const double theta = M_PI * uniform(random);
    const double m = 1.0 + 0.6 * uniform(random);
    ViewGeometry geometry;
    geometry.size = {301, 201};
    geometry.focal_px = m * R;
    geometry.rotation = omniviewRotation(beta, delta, theta);
    const double A =
        std::cos(theta) * std::cos(delta) - std::sin(theta) * std::sin(delta) * std::cos(beta);
    const double B =
        std::sin(theta) * std::cos(delta) + std::cos(theta) * std::sin(delta) * std::cos(beta);
    const double C =
        std::cos(theta) * std::sin(delta) + std::sin(theta) * std::cos(delta) * std::cos(beta);
    const double D =
        std::sin(theta) * std::sin(delta) - std::cos(theta) * std::cos(delta) * std::cos(beta);
    for (int k = 0; k < 50; ++k) {
      const double u = 150 * uniform(random);
      const double v = 100 * uniform(random);
      const double length = std::sqrt(u * u + v * v + m * m * R * R);
      const Eigen::Vector2d wanted =
          center + R / length *
                       Eigen::Vector2d(u * A - v * B + m * R * std::sin(beta) * std::sin(delta),
                                       u * C - v * D - m * R * std::sin(beta) * std::cos(delta));
      const auto ray = viewRay(geometry, Eigen::Vector2d(150 + u, 100 + v));
      ASSERT_TRUE(ray);
      const auto pixel = lens->project(*ray);
      if (!pixel) continue;
      EXPECT_LT((*pixel - wanted).norm(), 1e-9);
      ++compared;
    }
  }
  EXPECT_GT(compared, 1900);
}

TEST(View, RaysAndPixelsAreInverse) {
  for (const auto& [projection, hfov] :
       {std::pair{Projection::kPinhole, 110.0}, std::pair{Projection::kCylindrical, 300.0},
        std::pair{Projection::kEquirectangular, 360.0}}) {
    const ViewGeometry geometry =
        makeViewGeometry(projection, {640, 240}, hfov * kDegree, viewRotation(0.4, -0.8, 2.0));
    int checked = 0;
    for (int y = 0; y < 240; y += 7) {
      for (int x = 0; x < 640; x += 7) {
        const auto ray = viewRay(geometry, Eigen::Vector2d(x, y));
        ASSERT_TRUE(ray);
        EXPECT_NEAR(ray->norm(), 1.0, 1e-12);
        const auto pixel = viewPixel(geometry, *ray);
        ASSERT_TRUE(pixel);
        EXPECT_LT((*pixel - Eigen::Vector2d(x, y)).norm(), 1e-8);
        ++checked;
      }
    }
    EXPECT_EQ(checked, 35 * 92);
  }
}

TEST(View, FieldSpansTheOuterEdgesOfThePixels) {
  const Eigen::Matrix3d ahead = Eigen::Matrix3d::Identity();
  const auto pinhole = makeViewGeometry(Projection::kPinhole, {100, 50}, 90 * kDegree, ahead);
  const Eigen::Vector3d edge = *viewRay(pinhole, Eigen::Vector2d(99.5, 24.5));
  EXPECT_NEAR(std::atan2(edge.x(), edge.z()), 45 * kDegree, 1e-12);
  const auto whole = makeViewGeometry(Projection::kEquirectangular, {360, 180}, 2 * M_PI, ahead);
  const Eigen::Vector3d pole = *viewRay(whole, Eigen::Vector2d(17, 179.5));
  EXPECT_NEAR(pole.y(), 1.0, 1e-12);
  EXPECT_FALSE(viewRay(whole, Eigen::Vector2d(17, 180.0)));
}

TEST(View, ShowsWhatAPinholeCameraTurnedSoWouldSee) {
  // The same scene once through the wide lens and this view, once rendered by a pinhole lens in
  // place.
  const auto scene = sim::readScene(std::string(OMNISTER_SOURCE_DIR) + "/config/scenes/room.yaml");
  const cv::Size wide_size(1200, 1000);
  const EquidistantLens wide({599.5, 499.5}, 330.0, 1.6);
  class Pinhole : public EquidistantLens {
   public:
    using EquidistantLens::EquidistantLens;
    std::optional<Eigen::Vector3d> unproject(const Eigen::Vector2d& pixel,
                                             Jacobian32*) const override {
      return Eigen::Vector3d((pixel.x() - 99.5) / 200.0, (pixel.y() - 79.5) / 200.0, 1.0)
          .normalized();
    }
  };
  const Pinhole pinhole({99.5, 79.5}, 200.0, 1.0);
  const cv::Mat image = sim::render(*scene, wide, wide_size, Pose::Identity()).image;
  double last = 0.0;
  for (const Eigen::Vector3d& angles :
       {Eigen::Vector3d(0, 0, 0), Eigen::Vector3d(-35, 20, 10), Eigen::Vector3d(50, -15, -70)}) {
    ViewGeometry geometry;
    geometry.size = {200, 160};
    geometry.focal_px = 200.0;
    geometry.rotation =
        viewRotation(angles.x() * kDegree, angles.y() * kDegree, angles.z() * kDegree);
    const View view(wide, wide_size, geometry);
    Pose pose = Pose::Identity();
    pose.linear() = geometry.rotation;
    const cv::Mat truth = sim::render(*scene, pinhole, geometry.size, pose).image;
    const cv::Mat seen = view.render(image);
    EXPECT_EQ(cv::countNonZero(view.mask()), 200 * 160);
    const double difference = cv::norm(seen, truth, cv::NORM_L1) / (3.0 * 200 * 160);
    cv::Mat shifted;
    cv::warpAffine(truth, shifted, cv::Matx23d(1, 0, 1, 0, 1, 0), truth.size());
    const double one_pixel_off = cv::norm(seen, shifted, cv::NORM_L1) / (3.0 * 200 * 160);
    EXPECT_LT(difference, 8.0);
    EXPECT_LT(difference, 0.6 * one_pixel_off);
    EXPECT_NE(difference, last);
    last = difference;
  }
}

TEST(View, SmoothsWhereItShrinks) {
  // A checker of two pixels a square, shown four times smaller: grey, not a moire.
  const EquidistantLens lens({399.5, 399.5}, 800.0, 0.6);
  cv::Mat image(800, 800, CV_8UC1);
  for (int y = 0; y < 800; ++y) {
    for (int x = 0; x < 800; ++x) image.at<uchar>(y, x) = ((x / 2 + y / 2) & 1) != 0 ? 255 : 0;
  }
  ViewGeometry geometry;
  geometry.size = {120, 120};
  geometry.focal_px = 190.0;
  const auto deviation = [&](bool anti_alias) {
    const cv::Mat seen = View(lens, image.size(), geometry, anti_alias).render(image);
    cv::Scalar mean, sigma;
    cv::meanStdDev(seen, mean, sigma);
    EXPECT_NEAR(mean[0], 127.5, 4.0);
    return sigma[0];
  };
  EXPECT_GT(deviation(false), 40.0);
  EXPECT_LT(deviation(true), 8.0);
}

TEST(View, MaskAndBlackOutsideTheField) {
  const EquidistantLens lens({99.5, 99.5}, 60.0, 1.5);
  const auto geometry = makeViewGeometry(Projection::kEquirectangular, {360, 180}, 2 * M_PI,
                                         Eigen::Matrix3d::Identity());
  const View view(lens, {200, 200}, geometry);
  for (const int type : {CV_8UC1, CV_8UC3, CV_16UC1, CV_32FC1}) {
    const cv::Mat seen = view.render(cv::Mat(200, 200, type, cv::Scalar::all(100)));
    ASSERT_EQ(seen.type(), type);
    cv::Mat reused(seen.size(), type, cv::Scalar::all(77));
    const uchar* const data = reused.data;
    view.render(cv::Mat(200, 200, type, cv::Scalar::all(100)), reused);
    EXPECT_EQ(reused.data, data) << "drawn in place";
    EXPECT_EQ(cv::norm(reused, seen, cv::NORM_INF), 0.0);
    cv::Mat channel, bytes;
    cv::extractChannel(seen, channel, 0);
    channel.convertTo(bytes, CV_8U);
    EXPECT_EQ(cv::norm(bytes, view.mask() / 255 * 100, cv::NORM_INF), 0.0) << type;
  }
  int inside = 0;
  for (int y = 0; y < 180; ++y) {
    for (int x = 0; x < 360; ++x) {
      const double theta = std::acos(viewRay(geometry, Eigen::Vector2d(x, y))->z());
      if (std::abs(theta - 1.5) < 0.02) continue;
      EXPECT_EQ(view.mask().at<uchar>(y, x) != 0, theta < 1.5);
      ++inside;
    }
  }
  EXPECT_GT(inside, 60000);
}

TEST(View, RefusesWhatMakesNoSense) {
  const Eigen::Matrix3d ahead = Eigen::Matrix3d::Identity();
  EXPECT_THROW(makeViewGeometry(Projection::kPinhole, {10, 10}, M_PI, ahead), Error);
  EXPECT_THROW(makeViewGeometry(Projection::kPinhole, {10, 10}, std::nan(""), ahead), Error);
  EXPECT_THROW(makeViewGeometry(Projection::kEquirectangular, {10, 10}, 7.0, ahead), Error);
  EXPECT_THROW(makeViewGeometry(Projection::kPinhole, {0, 10}, 1.0, ahead), Error);
  EXPECT_THROW(projectionOf("fisheye"), Error);
  const EquidistantLens lens({99.5, 99.5}, 60.0, 1.5);
  const View view(lens, {200, 200}, ViewGeometry());
  EXPECT_THROW(view.render(cv::Mat::zeros(100, 200, CV_8UC1)), Error);
  EXPECT_THROW(view.render(cv::Mat::zeros(200, 200, CV_64FC1)), Error);
}

TEST(DepthView, OfASphereIsTheCosineAndThePanoramasTheRange) {
  const EquidistantLens lens({199.5, 149.5}, 110.0, 95 * kDegree);
  const cv::Mat range(300, 400, CV_32FC1, cv::Scalar(3.0));
  const ViewGeometry pinhole =
      makeViewGeometry(Projection::kPinhole, {160, 120}, 80 * kDegree, viewRotation(0.4, 0.1, 0.2));
  const cv::Mat depth = DepthView(lens, {400, 300}, pinhole).render(range);
  int compared = 0;
  for (int y = 0; y < depth.rows; ++y)
    for (int x = 0; x < depth.cols; ++x) {
      const Eigen::Vector3d at((x - 79.5) / pinhole.focal_px, (y - 59.5) / pinhole.focal_px, 1.0);
      ASSERT_NEAR(depth.at<float>(y, x), 3.0 / at.norm(), 1e-5);
      ++compared;
    }
  EXPECT_EQ(compared, 160 * 120);
  const cv::Mat panorama = DepthView(lens, {400, 300},
                                     makeViewGeometry(Projection::kEquirectangular, {180, 90},
                                                      2 * M_PI, Eigen::Matrix3d::Identity()))
                               .render(range);
  EXPECT_EQ(panorama.at<float>(45, 90), 3.0F);
  EXPECT_TRUE(std::isnan(panorama.at<float>(45, 0))) << "behind the camera";
  EXPECT_THROW(DepthView(lens, {400, 300}, pinhole).render(range.t()), Error);
}

}  // namespace
}  // namespace omnister
