// SPDX-License-Identifier: Apache-2.0
#include "omnister/sim/renderer.h"

#include <gtest/gtest.h>

#include <cmath>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>
#include <string>
#include <vector>

#include "equidistant_lens.h"
#include "omnister/calibration/target.h"
#include "omnister/common/error.h"

namespace omnister::sim {
namespace {

using test::EquidistantLens;

const cv::Size kSize(320, 240);
/// 200 degrees across the image's diagonal; 160 across its width.
const EquidistantLens kLens({159.3, 120.4}, 115.0, 1.745);

ScenePtr room() { return readScene(std::string(OMNISTER_SOURCE_DIR) + "/config/scenes/room.yaml"); }

RenderOptions samples(int supersampling, bool color = true) {
  RenderOptions options;
  options.supersampling = supersampling;
  options.color = color;
  return options;
}

RenderOptions samples(int supersampling, double noise, double vignetting, bool color = true) {
  RenderOptions options = samples(supersampling, color);
  options.noise_sigma = noise;
  options.vignetting = vignetting;
  return options;
}

ScenePtr solidPlane(const std::string& plane) {
  return parseScene(
      "version: 1\nambient: 1\nbackground: [0, 0, 0]\n"
      "textures: {white: {type: solid, color: [200, 200, 200]}}\nobjects: [" +
          plane + "]\n",
      "test.yaml");
}

Pose obliquePose() {
  Pose pose = Pose::Identity();
  pose.translation() = Eigen::Vector3d(0.2, -0.1, 0.3);
  pose.linear() =
      Eigen::AngleAxisd(0.4, Eigen::Vector3d(0.3, -1, 0.2).normalized()).toRotationMatrix();
  return pose;
}

TEST(Renderer, RangeIsExactAlongTheRayOfEachPixel) {
  const auto scene = room();
  const Pose pose = obliquePose();
  const Rendering rendering = render(*scene, kLens, kSize, pose, samples(2));
  int inside = 0;
  int exact = 0;
  for (int y = 0; y < kSize.height; ++y) {
    for (int x = 0; x < kSize.width; ++x) {
      const auto ray = kLens.unproject(Eigen::Vector2d(x, y));
      const float range = rendering.range.at<float>(y, x);
      if (!ray) {
        ASSERT_TRUE(std::isnan(range));
        ASSERT_EQ(rendering.image.at<cv::Vec3b>(y, x), cv::Vec3b(0, 0, 0));
        continue;
      }
      ++inside;
      const auto truth = scene->rangeAlong(pose.translation(), pose.linear() * *ray);
      ASSERT_TRUE(truth);  // a closed room
      if (std::abs(range / *truth - 1.0) < 2e-5) ++exact;
    }
  }
  EXPECT_GT(inside, 60000);
  // A ray along an edge may fall to either side.
  EXPECT_GE(exact, inside - 5);
}

TEST(Renderer, RaysBehindTheCameraSeeWhatStandsThere) {
  const EquidistantLens lens({160, 120}, 60.0, 2.2);
  const auto scene = solidPlane("{type: plane, position: [0, 0, -1], texture: white}");
  const Rendering rendering = render(*scene, lens, kSize, Pose::Identity());
  int seen = 0;
  for (int y = 0; y < kSize.height; ++y) {
    for (int x = 0; x < kSize.width; ++x) {
      const auto ray = lens.unproject(Eigen::Vector2d(x, y));
      if (!ray || ray->z() > -0.02) continue;
      EXPECT_NEAR(rendering.range.at<float>(y, x) * -ray->z(), 1.0, 1e-5);
      ++seen;
    }
  }
  EXPECT_GT(seen, 10000);
}

TEST(Renderer, PixelsAreMeansOverTheirArea) {
  // A slanted edge of a white half plane before black: a pixel's brightness is the share that the
  // edge leaves of it, so a row's sum tells where the edge crosses.
  const EquidistantLens lens({40.0, 30.0}, 4000.0, 0.02);  // nearly a pinhole
  const auto scene = solidPlane(
      "{type: plane, position: [-100, 0, 1], rotation: [0, 0, 5], size: [200, 300], texture: "
      "white}");
  const Rendering rendering = render(*scene, lens, {81, 61}, Pose::Identity(), samples(8, false));
  // The rectangle's right border: x cos 5 + y sin 5 = 100 - 100 cos 5 in metres, z = 1.
  const double c = std::cos(5 * M_PI / 180);
  const double s = std::sin(5 * M_PI / 180);
  for (int y = 5; y <= 55; ++y) {
    const double edge = 40.0 + ((100 - 100 * c) * 4000.0 - (y - 30.0) * s) / c;
    if (edge < 2 || edge > 78) continue;
    double sum = 0.0;
    for (int x = 0; x < 81; ++x) sum += rendering.image.at<std::uint8_t>(y, x) / 200.0;
    EXPECT_NEAR(sum - 0.5, edge, 0.05) << y;
  }
}

TEST(Renderer, BoardsAreDrawnToAFewThousandthsOfAPixel) {
  // Each pixel against the mean of 24 x 24 rays through the lens model itself.
  const auto scene = parseScene(
      "version: 1\nambient: 1\ntextures: {}\nobjects:\n"
      "  - {type: board, target: {type: checkerboard, cols: 9, rows: 7, square_m: 0.08},\n"
      "     position: [-0.37, -0.22, 0.52], rotation: [18, -14, 8], margin: 0.1, dark: 0,\n"
      "     light: 250}\n",
      "test.yaml");
  const EquidistantLens lens({319.6, 239.2}, 230.0, 1.6);
  const Pose T_board_camera = scene->boards()[0].T_world_board.inverse();
  const auto white = [&](double u, double v) {
    const Eigen::Vector3d ray = T_board_camera.linear() * *lens.unproject(Eigen::Vector2d(u, v));
    const Eigen::Vector3d at =
        T_board_camera.translation() - T_board_camera.translation().z() / ray.z() * ray;
    const double col = std::floor(at.x() / 0.08);
    const double row = std::floor(at.y() / 0.08);
    const bool pattern = col >= -1 && col < 9 && row >= -1 && row < 7;
    return !pattern || (static_cast<int>(col + row) & 1) != 0;
  };
  for (const bool adaptive : {false, true}) {
    RenderOptions options = samples(4, false);
    options.adaptive = adaptive;
    const Rendering rendering = render(*scene, lens, {640, 480}, Pose::Identity(), options);
    int edges = 0;
    Eigen::Vector2d shift = Eigen::Vector2d::Zero();
    double steepness = 0.0;
    double worst = 0.0;
    double square = 0.0;
    // Around every third corner: how far would the pattern have to move to explain the differences?
    const auto points = targetPoints(scene->boards()[0].target);
    for (std::size_t i = 0; i < points.size(); i += 3) {
      const Eigen::Vector2d corner = *lens.project(scene->boards()[0].T_world_board * points[i]);
      for (int y = static_cast<int>(corner.y()) - 6; y <= corner.y() + 6; ++y) {
        for (int x = static_cast<int>(corner.x()) - 6; x <= corner.x() + 6; ++x) {
          int lit = 0;
          for (int k = 0; k < 24 * 24; ++k) {
            lit += white(x + (k % 24 + 0.5) / 24 - 0.5, y + (k / 24 + 0.5) / 24 - 0.5) ? 1 : 0;
          }
          if (lit == 0 || lit == 24 * 24) continue;
          ++edges;
          const auto grey = [&](int dx, int dy) {
            return static_cast<double>(rendering.image.at<std::uint8_t>(y + dy, x + dx));
          };
          const double error = grey(0, 0) - 250.0 * lit / (24.0 * 24.0);
          const Eigen::Vector2d slope((grey(1, 0) - grey(-1, 0)) / 2,
                                      (grey(0, 1) - grey(0, -1)) / 2);
          shift += error * slope;
          steepness += 0.5 * slope.squaredNorm();
          worst = std::max(worst, std::abs(error));
          square += error * error;
        }
      }
    }
    EXPECT_GT(edges, 400);
    EXPECT_LT((shift / steepness).norm(), 0.003) << "px, of the pattern as a whole";
    EXPECT_LT(std::sqrt(square / edges), 2.5) << "grey levels of 250";
    EXPECT_LT(worst, 16.0);
  }
}

TEST(Renderer, DotsHaveTheirCentresAndAreas) {
  const auto scene = parseScene(
      "version: 1\nambient: 1\ntextures: {}\nobjects:\n"
      "  - {type: board, target: {type: circles, cols: 5, rows: 4, square_m: 0.1, dot_m: 0.06},\n"
      "     position: [-0.2, -0.15, 1], dark: 0, light: 250}\n",
      "test.yaml");
  const EquidistantLens lens({160.3, 120.1}, 300.0, 0.9);
  const Rendering rendering = render(*scene, lens, kSize, Pose::Identity(), samples(4, false));
  // The dot at the board's frame plus (2, 1) spacings lies at (0, -0.05, 1).
  const Eigen::Vector2d middle = *lens.project({0.0, -0.05, 1.0});
  const cv::Rect window(static_cast<int>(middle.x()) - 13, static_cast<int>(middle.y()) - 13, 27,
                        27);
  double area = 0.0;
  Eigen::Vector2d center = Eigen::Vector2d::Zero();
  for (int y = window.y; y < window.y + window.height; ++y) {
    for (int x = window.x; x < window.x + window.width; ++x) {
      const double black = 1.0 - rendering.image.at<std::uint8_t>(y, x) / 250.0;
      area += black;
      center += black * Eigen::Vector2d(x, y);
    }
  }
  EXPECT_NEAR(area / (M_PI * std::pow(0.03 * 300.0, 2)), 1.0, 0.02);
  EXPECT_LT((center / area - middle).norm(), 0.02);
}

TEST(Renderer, FramesDoNotDependOnThreads) {
  const auto scene = room();
  RenderOptions options = samples(2, 3.0, 0.5);
  options.threads = 1;
  const Rendering one = Renderer(kLens, kSize, 1).render(*scene, obliquePose(), options);
  options.threads = 2;
  const Rendering two = Renderer(kLens, kSize, 2).render(*scene, obliquePose(), options);
  EXPECT_EQ(cv::norm(one.image, two.image, cv::NORM_INF), 0.0);
  EXPECT_EQ(cv::countNonZero((one.range != two.range) & (one.range == one.range)), 0);
}

TEST(Renderer, NoiseHasItsSigmaAndFollowsTheSeed) {
  const auto scene = solidPlane("{type: plane, position: [0, 0, 1], texture: white}");
  const EquidistantLens lens({160, 120}, 400.0, 0.6);
  const Renderer renderer(lens, kSize);
  const auto image = [&](std::uint64_t seed, double sigma) {
    RenderOptions options = samples(1, sigma, 0.0);
    options.seed = seed;
    cv::Mat result;
    renderer.render(*scene, Pose::Identity(), options).image.convertTo(result, CV_32F);
    return result;
  };
  const cv::Mat clean = image(1, 0.0);
  const cv::Mat noisy = image(1, 5.0);
  cv::Scalar mean, deviation;
  cv::meanStdDev(noisy - clean, mean, deviation);
  for (int c = 0; c < 3; ++c) {
    EXPECT_NEAR(mean[c], 0.0, 0.05);
    EXPECT_NEAR(deviation[c], std::sqrt(25.0 + 1.0 / 12.0), 0.05);
  }
  EXPECT_EQ(cv::norm(noisy, image(1, 5.0), cv::NORM_INF), 0.0);
  cv::meanStdDev(noisy - image(2, 5.0), mean, deviation);
  EXPECT_NEAR(deviation[0], 5.0 * std::sqrt(2.0), 0.1);
}

TEST(Renderer, VignettingIsTheFourthPowerOfTheCosine) {
  const auto scene =
      solidPlane("{type: box, position: [0, 0, 0], size: [4, 4, 4], texture: white}");
  const Rendering rendering =
      render(*scene, kLens, kSize, Pose::Identity(), samples(1, 0.0, 1.0, false));
  int checked = 0;
  for (int y = 0; y < kSize.height; y += 3) {
    for (int x = 0; x < kSize.width; x += 3) {
      const auto ray = kLens.unproject(Eigen::Vector2d(x, y));
      if (!ray) continue;
      const double wanted = 200.0 * std::max(std::pow(std::max(ray->z(), 0.0), 4), 0.05);
      EXPECT_NEAR(rendering.image.at<std::uint8_t>(y, x), wanted, 0.51);
      ++checked;
    }
  }
  EXPECT_GT(checked, 6000);
}

TEST(Renderer, AdaptiveFramesAreHardlyDifferent) {
  const auto scene = room();
  RenderOptions options = samples(3);
  const Rendering full = render(*scene, kLens, kSize, Pose::Identity(), options);
  options.adaptive = true;
  const Rendering adaptive = render(*scene, kLens, kSize, Pose::Identity(), options);
  const double pixels = kSize.area() * 3.0;
  EXPECT_LT(cv::norm(full.image, adaptive.image, cv::NORM_L1) / pixels, 5.0);
  EXPECT_EQ(cv::countNonZero((full.range != adaptive.range) & (full.range == full.range)), 0);
}

TEST(Renderer, TexturesFadeInsteadOfAliasing) {
  const auto scene = [](double distance) {
    return parseScene(
        "version: 1\nambient: 1\ntextures: {t: {type: noise, scale: 0.05, octaves: 4, "
        "colors: [[0, 0, 0], [250, 250, 250]]}}\nobjects: [{type: plane, position: "
        "[0, 0, " +
            std::to_string(distance) + "], texture: t}]\n",
        "test.yaml");
  };
  const EquidistantLens lens({160, 120}, 300.0, 0.2);
  const auto deviation = [&](double distance) {
    const Rendering rendering =
        render(*scene(distance), lens, kSize, Pose::Identity(), samples(1, false));
    cv::Scalar mean, sigma;
    cv::meanStdDev(rendering.image, mean, sigma, rendering.range == rendering.range);
    EXPECT_NEAR(mean[0], 125.0, 12.0);
    return sigma[0];
  };
  EXPECT_GT(deviation(0.5), 40.0);
  EXPECT_LT(deviation(40.0), 1.0);
}

TEST(Renderer, RefusesWhatMakesNoSense) {
  const auto scene = solidPlane("{type: plane, position: [0, 0, 1], texture: white}");
  EXPECT_THROW(render(*scene, kLens, {0, 10}, Pose::Identity()), Error);
  EXPECT_THROW(render(*scene, kLens, {1 << 20, 1 << 20}, Pose::Identity()), Error);
  EXPECT_THROW(render(*scene, kLens, kSize, Pose::Identity(), samples(0)), Error);
  EXPECT_THROW(render(*scene, kLens, kSize, Pose::Identity(), samples(1, std::nan(""), 0.0)),
               Error);
  EXPECT_THROW(render(*scene, kLens, kSize, Pose::Identity(), samples(1, 0.0, 2.0)), Error);
  Pose broken = Pose::Identity();
  broken.translation().x() = std::nan("");
  EXPECT_THROW(render(*scene, kLens, kSize, broken), Error);
  const Rendering tiny = render(*scene, kLens, {1, 1}, Pose::Identity());
  EXPECT_EQ(tiny.image.size(), cv::Size(1, 1));
}

}  // namespace
}  // namespace omnister::sim
