// SPDX-License-Identifier: Apache-2.0
#include "omnister/view/epipolar_overlay.h"

#include <gmock/gmock.h>

#include <cmath>
#include <limits>
#include <memory>
#include <opencv2/core.hpp>

#include "../sim/equidistant_lens.h"
#include "omnister/common/error.h"

namespace omnister {
namespace {

/// Two black images of a camera that moved to the right and turned a little.
class EpipolarOverlay : public testing::Test {
 protected:
  EpipolarOverlay() {
    geometry_.reference_lens =
        std::make_shared<test::EquidistantLens>(Eigen::Vector2d(199.5, 149.5), 110.0, 1.6);
    geometry_.reference_size = {400, 300};
    Pose pose = Pose::Identity();
    pose.translate(Eigen::Vector3d(0.3, 0.02, 0.05));
    pose.rotate(Eigen::AngleAxisd(0.05, Eigen::Vector3d::UnitY()));
    geometry_.displaced.push_back({geometry_.reference_lens, geometry_.reference_size, pose});
    options_.min_range = 0.6;
    options_.max_range = 20.0;
    const cv::Mat nothing(geometry_.reference_size, CV_32FC1,
                          cv::Scalar(std::numeric_limits<float>::quiet_NaN()));
    result_.range = nothing.clone();
    result_.sigma = nothing.clone();
    result_.score = nothing.clone();
  }
  Eigen::Vector2d pixelOf(const Eigen::Vector3d& point) const {
    return *geometry_.reference_lens->project(point);
  }
  Eigen::Vector2d displacedPixelOf(const Eigen::Vector3d& point) const {
    const auto& other = geometry_.displaced.front();
    return *other.lens->project(other.T_ref_disp.inverse() * point);
  }
  cv::Mat draw(const std::vector<cv::Point2d>& pixels) const {
    const cv::Mat black(geometry_.reference_size, CV_8UC3, cv::Scalar::all(0));
    return drawEpipolarOverlay(black, black, geometry_, options_, result_, pixels);
  }
  /// Pixels drawn upon around a place of the right image.
  static int inkAt(const cv::Mat& picture, const Eigen::Vector2d& pixel, int radius,
                   int offset = 400) {
    const cv::Rect around(static_cast<int>(std::lround(pixel.x())) + offset - radius,
                          static_cast<int>(std::lround(pixel.y())) - radius, 2 * radius + 1,
                          2 * radius + 1);
    cv::Mat grey;
    cv::extractChannel(picture(around & cv::Rect({0, 0}, picture.size())), grey, 1);
    return cv::countNonZero(grey > 40);
  }

  StereoGeometry geometry_;
  MatcherOptions options_;
  MatchResult result_;
};

TEST_F(EpipolarOverlay, TheCurveGoesThroughWhereThePointWouldBeAtAnyRangeWithinTheLimits) {
  const Eigen::Vector3d ray = Eigen::Vector3d(-0.5, 0.4, 1.0).normalized();
  const Eigen::Vector2d pixel = pixelOf(ray);
  const cv::Mat picture = draw({{pixel.x(), pixel.y()}});
  ASSERT_EQ(picture.size(), cv::Size(800, 300));
  int checked = 0;
  for (const double range : {0.62, 0.8, 1.0, 1.5, 3.0, 8.0, 19.0}) {
    EXPECT_GT(inkAt(picture, displacedPixelOf(range * ray), 1), 0) << range;
    ++checked;
  }
  EXPECT_EQ(checked, 7);
  EXPECT_EQ(inkAt(picture, displacedPixelOf(0.4 * ray), 2), 0) << "nearer than the limit";
  EXPECT_GT(inkAt(picture, pixel, 4, 0), 4) << "the pixel itself, on the left";
}

TEST_F(EpipolarOverlay, AMatchIsMarkedInBothImages) {
  const Eigen::Vector3d ray = Eigen::Vector3d(0.3, -0.2, 1.0).normalized();
  Eigen::Vector2d pixel = pixelOf(ray);
  pixel = {std::round(pixel.x()), std::round(pixel.y())};
  const Eigen::Vector3d exact = *geometry_.reference_lens->unproject(pixel);
  const cv::Mat without = draw({{pixel.x(), pixel.y()}});
  const cv::Point at(static_cast<int>(pixel.x()), static_cast<int>(pixel.y()));
  result_.range.at<float>(at) = 2.0F;
  result_.sigma.at<float>(at) = 0.01F;
  result_.score.at<float>(at) = 0.9F;
  const cv::Mat with = draw({{pixel.x(), pixel.y()}});
  const Eigen::Vector2d match = displacedPixelOf(2.0 * exact);
  EXPECT_GT(inkAt(with, match, 4), inkAt(without, match, 4) + 4) << "the cross";
  // The curve of the match goes back through the pixel, along the baseline's direction.
  int ink = 0, ink_before = 0;
  for (const double range : {0.7, 1.0, 4.0, 15.0}) {
    const auto& other = geometry_.displaced.front();
    const Eigen::Vector3d seen = (other.T_ref_disp.inverse() * (2.0 * exact)).normalized();
    const Eigen::Vector2d back = pixelOf(other.T_ref_disp * (range * seen));
    ink += inkAt(with, back, 1, 0) > 0 ? 1 : 0;
    ink_before += inkAt(without, back, 1, 0) > 0 ? 1 : 0;
  }
  EXPECT_EQ(ink, 4);
  EXPECT_LT(ink_before, 4);
}

TEST_F(EpipolarOverlay, PixelsOutsideTheFieldOrTheImageHarmNothing) {
  EXPECT_NO_THROW(draw({{-5, -5}, {1e9, 1e9}, {0, 0}, {399, 299}, {199.5, 149.5}}));
  EXPECT_NO_THROW(draw({}));
  EXPECT_NO_THROW(draw(defaultPixels(geometry_.reference_size)));
  const cv::Mat small(10, 10, CV_8UC3, cv::Scalar::all(0));
  EXPECT_THROW(drawEpipolarOverlay(small, small, geometry_, options_, result_, {}), Error);
}

TEST(ParsePixels, ReadsPairsAndNamesWhatItRefuses) {
  EXPECT_THAT(parsePixels("1 2; 3.5,4 ;", "x"),
              testing::ElementsAre(cv::Point2d(1, 2), cv::Point2d(3.5, 4)));
  EXPECT_THAT(parsePixels("", "x"), testing::IsEmpty());
  EXPECT_THAT(parsePixels(" ; ; ", "x"), testing::IsEmpty());
  for (const char* bad : {"1", "1 2 3", "a b", "nan 1", "1 2; 3"}) {
    try {
      parsePixels(bad, "~pixels");
      ADD_FAILURE() << bad;
    } catch (const InputError& error) {
      EXPECT_THAT(error.what(), testing::HasSubstr("~pixels"));
    }
  }
  std::string many;
  for (int i = 0; i < 65; ++i) many += "1 2;";
  EXPECT_THROW(parsePixels(many, "x"), InputError);
}

}  // namespace
}  // namespace omnister
