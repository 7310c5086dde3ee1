// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/input_region.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "analytic_scene.h"
#include "omnister/common/error.h"
#include "omnister/lens/lens_models.h"
#include "omnister/stereo/range_warp.h"

namespace omnister {
namespace {

TEST(InputRegion, ReadsWholePixelsInsideTheImage) {
  const cv::Size size(40, 30);
  EXPECT_EQ(parseRegion("", size, "roi"), cv::Rect());
  EXPECT_EQ(parseRegion("0,0,40,30", size, "roi"), cv::Rect(0, 0, 40, 30));
  EXPECT_EQ(parseRegion("3,4,5,6", size, "roi"), cv::Rect(3, 4, 5, 6));
  for (const char* bad : {"1,2,3", "1,2,3,4,5", "0,0,41,1", "0,29,1,2", "-1,0,2,2", "0.5,0,2,2",
                          "a,b,c,d", "nan,0,1,1", "0,0,0,1", "1e9,0,1,1"})
    EXPECT_THROW(parseRegion(bad, size, "roi"), Error) << bad;
}

TEST(InputRegion, MaskAndRegionLeaveOutWhatEitherDoes) {
  const cv::Size size(8, 6);
  EXPECT_TRUE(matchingMask({}, {}, size, 1).empty());
  EXPECT_TRUE(matchingMask({}, {}, size, 2).empty());
  cv::Mat mask(size, CV_8UC1, cv::Scalar(1));
  mask.at<uchar>(2, 5) = 0;
  const cv::Mat full = matchingMask(mask, cv::Rect(2, 0, 6, 6), size, 1);
  EXPECT_EQ(cv::countNonZero(full), 35);
  EXPECT_EQ(full.at<uchar>(0, 1), 0);
  EXPECT_EQ(full.at<uchar>(2, 5), 0);
  // A reduced pixel is left out if any part of it is.
  const cv::Mat half = matchingMask(mask, cv::Rect(2, 0, 6, 6), size, 2);
  ASSERT_EQ(half.size(), cv::Size(4, 3));
  EXPECT_EQ(cv::countNonZero(half), 8);
  EXPECT_EQ(half.at<uchar>(1, 2), 0);
}

TEST(InputRegion, ReducedImagesAreMeansOfSquares) {
  cv::Mat image(5, 7, CV_8UC1);
  for (int y = 0; y < 5; ++y)
    for (int x = 0; x < 7; ++x) image.at<uchar>(y, x) = static_cast<uchar>(10 * y + 3 * x);
  EXPECT_EQ(reducedImage(image, 1).data, image.data);
  const cv::Mat half = reducedImage(image, 2);
  ASSERT_EQ(half.size(), cv::Size(3, 2));
  for (int y = 0; y < 2; ++y)
    for (int x = 0; x < 3; ++x)
      EXPECT_NEAR(half.at<uchar>(y, x), 10 * (2 * y + 0.5) + 3 * (2 * x + 0.5), 0.51);
}

TEST(RangeWarp, SeesTheRoomFromWhereTheCameraIsNow) {
  const cv::Size size(180, 150);
  LensStructure structure;
  structure.model = "spline";
  const LensPtr lens = makeLens(structure, {90.2, 74.1}, 58.0, 1.55);
  const auto scene = test::room(1.8, 0.2);
  const Pose T_old_new = test::pose(0.15, -0.05, 0.1, 0.12, {0.2, 1, 0.1});
  cv::Mat old, truth = test::look(scene, *lens, size, T_old_new, 1).range;
  test::look(scene, *lens, size, Pose::Identity(), 1).range.convertTo(old, CV_32F);
  old(cv::Rect(60, 50, 20, 15)).setTo(std::numeric_limits<float>::quiet_NaN());
  old.at<float>(3, 90) = std::numeric_limits<float>::infinity();
  const cv::Mat one = warpRange(old, lens, T_old_new.inverse(), lens, size, 1);
  const cv::Mat many = warpRange(old, lens, T_old_new.inverse(), lens, size, 3);
  int known = 0, right = 0, field = 0;
  for (int y = 0; y < size.height; ++y) {
    for (int x = 0; x < size.width; ++x) {
      const float range = one.at<float>(y, x);
      ASSERT_TRUE(range == many.at<float>(y, x) ||
                  (std::isnan(range) && std::isnan(many.at<float>(y, x))));
      ASSERT_FALSE(std::isinf(range));
      field += !std::isnan(truth.at<double>(y, x));
      if (std::isnan(range) || std::isnan(truth.at<double>(y, x))) continue;
      ++known;
      // Half a pixel of a slanted wall is a few per cent of range here.
      right += std::abs(range / truth.at<double>(y, x) - 1) < 0.05;
    }
  }
  EXPECT_GT(known, 0.75 * field);
  EXPECT_GT(right, 0.97 * known);
  EXPECT_THROW(warpRange(cv::Mat(), lens, T_old_new, lens, size), Error);
  EXPECT_THROW(warpRange(old, nullptr, T_old_new, lens, size), Error);
}

}  // namespace
}  // namespace omnister
