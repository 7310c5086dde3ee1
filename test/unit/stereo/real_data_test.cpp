// SPDX-License-Identifier: Apache-2.0
// The product's functions on real images with known poses. Skipped visibly where the data is not
// there. With OMNISTER_TEST_OUT=FOLDER the clouds and range images are kept there to be looked at.
#include "real_data.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>
#include <iostream>
#include <opencv2/imgproc.hpp>

#include "full_tests.h"
#include "omnister/lens/lens_file.h"
#include "omnister/stereo/cloud.h"
#include "omnister/stereo/matcher.h"
#include "omnister/stereo/plane_fit.h"
#include "stereo/geometry/triangulation.h"

namespace omnister {
namespace {

void keep(const std::string& name, const Cloud& cloud, const cv::Mat& range) {
  const char* folder = std::getenv("OMNISTER_TEST_OUT");
  if (folder == nullptr) return;
  writeCloud(test::fs::path(folder) / (name + ".ply"), cloud);
  writeRange(test::fs::path(folder) / (name + ".tiff"), range);
  cv::Mat inverse, color;
  cv::Mat(255.0 / range).convertTo(inverse, CV_8U, 0.9);
  cv::applyColorMap(inverse, color, cv::COLORMAP_TURBO);
  color.setTo(0, range != range);
  cv::imwrite((test::fs::path(folder) / (name + ".png")).string(), color);
}

double quantile(std::vector<double> values, double share) {
  const auto place = values.begin() + static_cast<std::ptrdiff_t>(share * (values.size() - 1));
  std::nth_element(values.begin(), place, values.end());
  return *place;
}

struct CarCase {
  const char* side;
  double height;     ///< of the camera above the pavement by sparse triangulation [m]
  double tolerance;  ///< [m]
};

class CarFisheye : public ::testing::TestWithParam<CarCase> {};

TEST_P(CarFisheye, PavementIsAPlaneAtTheHeightOfTheCamera) {
  if (!test::fs::exists(test::dataFolder("planesweep_car_fisheye"))) {
    GTEST_SKIP() << "no ../shared/data/planesweep_car_fisheye";
  }
  const test::CarSequence car = test::readCarSequence(GetParam().side);
  std::cout << "lens rms " << car.lens.rms_px << " px, max " << car.lens.max_px << " px\n";
  if (const char* folder = std::getenv("OMNISTER_TEST_OUT")) {
    LensFile file;
    file.image_size = car.size;
    file.lens = car.lens.lens;
    writeLensFile(test::fs::path(folder) / (std::string(GetParam().side) + ".yaml"), file);
    for (std::size_t i = 0; i + 1 < car.images.size(); ++i) {
      std::cout << car.images[i] << ' ' << formatPose(car.T_ref_disp(i, i + 1)) << '\n';
    }
  }
  std::vector<double> heights, densities, errors;
  for (std::size_t i = 0; i + 1 < car.images.size(); i += 4) {
    StereoGeometry geometry;
    geometry.reference_lens = car.lens.lens;
    geometry.reference_size = car.size;
    geometry.displaced.push_back({car.lens.lens, car.size, car.T_ref_disp(i, i + 1)});
    MatcherOptions options;
    options.min_range = 0.6;
    const cv::Mat reference = car.image(i);
    const MatchResult match =
        makeMatcher("sweep", geometry, options)->match(reference, {car.image(i + 1)});
    const Cloud cloud = makeCloud(match, *car.lens.lens, reference);
    keep(std::string("car_") + GetParam().side + std::to_string(i), cloud, match.range);
    const cv::Rect pavement(250, 300, 750, 400);
    const PlaneFit fit = fitPlane(cloud.xyz(pavement));
    std::cout << GetParam().side << ' ' << i << ": baseline "
              << geometry.displaced[0].T_ref_disp.translation().transpose() << ", height "
              << fit.distance << " m, rms " << fit.all.rms << " m, inliers " << fit.all.inliers
              << " of " << fit.all.points << " of " << pavement.area() << ", median range error "
              << 100.0 * fit.all.median_range_error << " %, "
              << match.statistics.seconds.at("total") << " s\n";
    heights.push_back(fit.distance);
    densities.push_back(static_cast<double>(fit.all.points) / pavement.area());
    errors.push_back(fit.all.median_range_error);
  }
  ASSERT_GE(heights.size(), 3u);
  EXPECT_NEAR(quantile(heights, 0.5), GetParam().height, GetParam().tolerance);
  EXPECT_GT(quantile(densities, 0.5), 0.75);
  EXPECT_LT(quantile(errors, 0.5), 0.01);
}

// What a stage is for: more positions of the one camera, all matched at once.
TEST_P(CarFisheye, MorePositionsTightenThePavement) {
  if (!test::fs::exists(test::dataFolder("planesweep_car_fisheye"))) {
    GTEST_SKIP() << "no ../shared/data/planesweep_car_fisheye";
  }
  const test::CarSequence car = test::readCarSequence(GetParam().side);
  const std::size_t middle = 2;
  const cv::Mat reference = car.image(middle);
  const cv::Rect pavement(250, 300, 750, 400);
  const auto measure = [&](const std::vector<std::size_t>& others) {
    StereoGeometry geometry;
    geometry.reference_lens = car.lens.lens;
    geometry.reference_size = car.size;
    std::vector<cv::Mat> displaced;
    for (std::size_t other : others) {
      geometry.displaced.push_back({car.lens.lens, car.size, car.T_ref_disp(middle, other)});
      displaced.push_back(car.image(other));
    }
    MatcherOptions options;
    options.min_range = 0.6;
    const MatchResult match = makeMatcher("sweep", geometry, options)->match(reference, displaced);
    const PlaneFit fit = fitPlane(makeCloud(match, *car.lens.lens, reference).xyz(pavement));
    std::cout << GetParam().side << ", " << others.size() + 1 << " frames: height " << fit.distance
              << " m, rms " << fit.all.rms << " m, median range error "
              << 100.0 * fit.all.median_range_error << " %, " << fit.all.points << " of "
              << pavement.area() << '\n';
    return fit;
  };
  const PlaneFit two = measure({middle + 1});
  const PlaneFit three = measure({middle - 1, middle + 1});
  const PlaneFit five = measure({middle - 2, middle - 1, middle + 1, middle + 2});
  // One more frame, from behind, is no promise of a tighter plane; four are.
  for (const PlaneFit& fit : {two, three, five})
    EXPECT_NEAR(fit.distance, GetParam().height, GetParam().tolerance);
  EXPECT_LT(five.all.median_range_error, 0.9 * two.all.median_range_error);
  EXPECT_GT(five.all.points, 0.99 * two.all.points);
}

INSTANTIATE_TEST_SUITE_P(Recorded, CarFisheye,
                         ::testing::Values(CarCase{"left", 0.932, 0.03},
                                           CarCase{"right", 0.887, 0.015}),
                         [](const auto& info) { return info.param.side; });

// The truth is the plane through the triangulated corners of the board: corners are located to a
// few hundredths of a pixel, far better than a dense match.
TEST(BoardRig, RangeOnTheBoardIsThatOfItsPlane) {
  if (!test::fs::exists(test::dataFolder("opencv_jy_stereo"))) {
    GTEST_SKIP() << "no ../shared/data/opencv_jy_stereo";
  }
  const test::BoardRig rig = test::readBoardRig();
  std::cout << "lens rms " << rig.left.rms_px << ", " << rig.right.rms_px << " px\n";
  ASSERT_EQ(rig.left_corners.size(), 34u);
  ASSERT_EQ(rig.right_corners.size(), 34u);
  StereoGeometry geometry;
  geometry.reference_lens = rig.left.lens;
  geometry.reference_size = rig.size;
  geometry.displaced.push_back({rig.right.lens, rig.size, rig.T_left_right});
  MatcherOptions options;
  options.min_range = 0.15;
  options.max_range = 5.0;
  const auto matcher = makeMatcher("sweep", geometry, options);
  const bool full = test::fullTests();
  std::vector<double> medians, coverages;
  for (std::size_t i = 0; i < rig.left_corners.size(); i += full ? 1 : 7) {
    cv::Mat points(1, static_cast<int>(rig.left_corners[i].size()), CV_32FC3);
    std::vector<cv::Point2f> corners;
    for (std::size_t k = 0; k < rig.left_corners[i].size(); ++k) {
      const auto a = rig.left.lens->unproject(rig.left_corners[i][k]);
      const auto b = rig.right.lens->unproject(rig.right_corners[i][k]);
      ASSERT_TRUE(a && b);
      const auto point = triangulate(*a, *b, rig.T_left_right);
      ASSERT_TRUE(point);
      points.at<cv::Vec3f>(0, static_cast<int>(k)) =
          cv::Vec3f(static_cast<float>(point->point.x()), static_cast<float>(point->point.y()),
                    static_cast<float>(point->point.z()));
      corners.emplace_back(static_cast<float>(rig.left_corners[i][k].x()),
                           static_cast<float>(rig.left_corners[i][k].y()));
    }
    const PlaneFit board = fitPlane(points);
    const cv::Mat reference = cv::imread(rig.left_images[i], cv::IMREAD_GRAYSCALE);
    const cv::Mat displaced = cv::imread(rig.right_images[i], cv::IMREAD_GRAYSCALE);
    const MatchResult match = matcher->match(reference, {displaced});
    keep("board" + std::to_string(i), makeCloud(match, *rig.left.lens, reference), match.range);
    // Straight edges of the board bend in the image; its corners' hull is inside it all the same.
    cv::Mat inside(rig.size, CV_8UC1, cv::Scalar(0));
    std::vector<cv::Point2f> hull_points;
    cv::convexHull(corners, hull_points);
    std::vector<cv::Point> hull(hull_points.begin(), hull_points.end());
    cv::fillConvexPoly(inside, hull, 255);
    std::vector<double> errors, signs;
    for (int v = 0; v < rig.size.height; ++v) {
      for (int u = 0; u < rig.size.width; ++u) {
        const float range = match.range.at<float>(v, u);
        if (inside.at<uchar>(v, u) == 0 || !std::isfinite(range)) continue;
        const auto ray = rig.left.lens->unproject({double(u), double(v)});
        const double truth = -board.distance / board.normal.dot(*ray);
        errors.push_back(std::abs(range / truth - 1.0));
        signs.push_back(range / truth - 1.0);
      }
    }
    ASSERT_FALSE(errors.empty());
    medians.push_back(quantile(errors, 0.5));
    coverages.push_back(static_cast<double>(errors.size()) / cv::countNonZero(inside));
    std::cout << "pair " << i << ": board at " << board.distance << " m, corners' rms "
              << 1e3 * board.all.rms << " mm, coverage " << coverages.back()
              << ", range error median " << 100.0 * medians.back() << " % (signed "
              << 100.0 * quantile(signs, 0.5) << "), 90 % below " << 100.0 * quantile(errors, 0.9)
              << " %, " << match.statistics.seconds.at("total") << " s\n";
  }
  std::cout << "median of medians " << 100.0 * quantile(medians, 0.5) << " %, worst "
            << 100.0 * quantile(medians, 1.0) << " %, coverage " << quantile(coverages, 0.5)
            << '\n';
  EXPECT_LT(quantile(medians, 0.5), 0.005);
  EXPECT_GT(quantile(coverages, 0.5), 0.8);
}

}  // namespace
}  // namespace omnister
