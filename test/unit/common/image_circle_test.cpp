// SPDX-License-Identifier: Apache-2.0
#include "omnister/common/image_circle.h"

#include <gtest/gtest.h>

#include <cmath>
#include <opencv2/imgproc.hpp>

namespace omnister {
namespace {

/// A picture inside a disc, black with a little noise around it.
cv::Mat discPicture(cv::Size size, const Eigen::Vector2d& center, double radius,
                    int type = CV_8UC1) {
  cv::RNG random(7);
  cv::Mat image(size, CV_32FC1);
  for (int row = 0; row < size.height; ++row) {
    for (int col = 0; col < size.width; ++col) {
      const double r = (Eigen::Vector2d(col, row) - center).norm();
      const double scene = 120 + 60 * std::sin(col / 17.0) * std::cos(row / 23.0);
      const double inside = 1.0 / (1.0 + std::exp((r - radius) / 0.8));
      image.at<float>(row, col) = static_cast<float>(6 + scene * inside + random.gaussian(2.0));
    }
  }
  cv::Mat out;
  image.convertTo(out, type, type == CV_16UC1 ? 200.0 : 1.0);
  return out;
}

TEST(ImageCircle, IsFoundWhereTheLensLeavesADisc) {
  struct Case {
    cv::Size size;
    Eigen::Vector2d center;
    double radius;
  };
  // Whole within the image, cut at top and bottom, and cut on all sides but in the corners.
  for (const Case& c : {Case{{1280, 960}, {640, 470}, 430},
                        {{1280, 800}, {655, 390}, 600},
                        {{512, 512}, {250, 262}, 280}}) {
    for (const int type : {CV_8UC1, CV_16UC1}) {
      const auto circle = findImageCircle({discPicture(c.size, c.center, c.radius, type)});
      ASSERT_TRUE(circle) << c.radius;
      EXPECT_LT((circle->center - c.center).norm(), 0.02 * c.radius);
      EXPECT_NEAR(circle->radius, c.radius, 0.015 * c.radius);
    }
  }
}

TEST(ImageCircle, IsNotFoundWhereThereIsNone) {
  EXPECT_FALSE(findImageCircle({discPicture({640, 480}, {320, 240}, 900)}));
  EXPECT_FALSE(findImageCircle({cv::Mat(480, 640, CV_8UC1, cv::Scalar(0))}));
  EXPECT_FALSE(findImageCircle({cv::Mat(480, 640, CV_8UC1, cv::Scalar(90))}));
  EXPECT_FALSE(findImageCircle({}));
  // Dark above, a bright rectangle, dark sides of a room.
  cv::Mat above(480, 640, CV_8UC1, cv::Scalar(100));
  above.rowRange(0, 200).setTo(2);
  EXPECT_FALSE(findImageCircle({above}));
  cv::Mat window(480, 640, CV_8UC1, cv::Scalar(2));
  window(cv::Rect(150, 100, 340, 280)).setTo(200);
  EXPECT_FALSE(findImageCircle({window}));
}

// What is dark in one picture is bright in another; the surround is dark in all.
TEST(ImageCircle, SeveralPicturesTellASceneFromTheSurround) {
  const cv::Size size(640, 480);
  cv::Mat left = discPicture(size, {320, 240}, 300);
  cv::Mat right = left.clone();
  left.colRange(0, 300).setTo(3);
  right.colRange(340, 640).setTo(3);
  const auto circle = findImageCircle({left, right});
  ASSERT_TRUE(circle);
  EXPECT_NEAR(circle->radius, 300, 6);
}

TEST(ImageCircle, MaskLeavesARim) {
  ImageCircle circle;
  circle.center = {50, 40};
  circle.radius = 30;
  const cv::Mat mask = circleMask(circle, {100, 80}, 2.0);
  EXPECT_EQ(mask.at<uchar>(40, 77), 255);
  EXPECT_EQ(mask.at<uchar>(40, 79), 0);
  EXPECT_NEAR(cv::countNonZero(mask), M_PI * 28 * 28, 60);
}

}  // namespace
}  // namespace omnister
