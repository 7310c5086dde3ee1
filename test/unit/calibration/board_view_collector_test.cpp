// SPDX-License-Identifier: Apache-2.0
#include "calibration/board/board_view_collector.h"

#include <gtest/gtest.h>

#include <opencv2/imgproc.hpp>

#include "omnister/common/error.h"

namespace omnister {
namespace {

constexpr int kWidth = 640;
constexpr int kHeight = 480;

/// A 7x5 grid of corners, 20 px apart, centred on (u, v).
ViewDetections gridAt(double u, double v) {
  ViewDetections view;
  for (int row = 0; row < 5; ++row)
    for (int col = 0; col < 7; ++col) {
      view.pixels.emplace_back(u + 20.0 * (col - 3), v + 20.0 * (row - 2));
      view.points.emplace_back(0.02 * col, 0.02 * row, 0.0);
    }
  return view;
}

cv::Mat circleImage() {
  cv::Mat image(kHeight, kWidth, CV_8UC1, cv::Scalar(0));
  cv::circle(image, {kWidth / 2, kHeight / 2}, 235, cv::Scalar(128), -1);
  return image;
}

TEST(ViewCollector, TakesStillViewsThatAreNew) {
  using Verdict = ViewCollector::Verdict;
  ViewCollector collector({kWidth, kHeight}, {});
  const cv::Mat image = circleImage();
  EXPECT_EQ(collector.add(image, std::nullopt), Verdict::kNotFound);
  EXPECT_EQ(collector.add(image, gridAt(320, 240)), Verdict::kMoving) << "not seen before";
  EXPECT_EQ(collector.add(image, gridAt(321, 240)), Verdict::kTaken);
  EXPECT_EQ(collector.add(image, gridAt(321, 240)), Verdict::kAlike);
  EXPECT_EQ(collector.add(image, gridAt(350, 240)), Verdict::kMoving);
  EXPECT_EQ(collector.add(image, gridAt(350, 240)), Verdict::kTaken);
  EXPECT_EQ(collector.add(image, std::nullopt), Verdict::kNotFound);
  EXPECT_EQ(collector.add(image, gridAt(400, 240)), Verdict::kMoving) << "lost in between";
  EXPECT_EQ(collector.images(), 8);
  ASSERT_EQ(collector.detections().views.size(), 2u);
  EXPECT_EQ(collector.detections().image_size, cv::Size(kWidth, kHeight));
  EXPECT_EQ(collector.detections().views[1].name, "view_001");
  EXPECT_EQ(collector.detections().views[1].pixels.size(), 35u);
}

TEST(ViewCollector, CoverageCountsCellsInsideTheImageCircleOnly) {
  ViewCollector collector({kWidth, kHeight}, {});
  const cv::Mat image = circleImage();
  EXPECT_EQ(collector.coverage(), 0.0);
  double last = 0.0;
  for (int v = 60; v <= 420; v += 20)
    for (int u = 90; u <= 550; u += 20) {
      if (std::hypot(u - 319.5, v - 239.5) > 220.0) continue;
      collector.add(image, gridAt(u, v));
      collector.add(image, gridAt(u, v));
      EXPECT_GE(collector.coverage(), last);
      last = collector.coverage();
    }
  EXPECT_GT(last, 0.95);
  EXPECT_LE(last, 1.0);
}

TEST(ViewCollector, HintPointsAtTheGap) {
  ViewCollector collector({kWidth, kHeight}, {});
  const cv::Mat image(kHeight, kWidth, CV_8UC1, cv::Scalar(128));
  // Everywhere but in the upper right quarter, which lies at small v.
  for (int v = 10; v < kHeight; v += 20)
    for (int u = 10; u < kWidth; u += 20) {
      if (u > 310 && v < 250) continue;
      ViewDetections view;
      view.pixels.emplace_back(u, v);
      view.points.emplace_back(0.0, 0.0, 0.0);
      collector.add(image, view);
      collector.add(image, view);
    }
  EXPECT_EQ(collector.hint().rfind("upper right", 0), 0u) << collector.hint();
}

TEST(ViewCollector, DrawsCoveredCellsGreenAndGapsRed) {
  ViewCollector collector({kWidth, kHeight}, {});
  const cv::Mat image(kHeight, kWidth, CV_8UC1, cv::Scalar(100));
  collector.add(image, gridAt(150, 240));
  collector.add(image, gridAt(150, 240));
  const cv::Mat picture = collector.draw();
  ASSERT_EQ(picture.type(), CV_8UC3);
  ASSERT_EQ(picture.size(), cv::Size(kWidth, kHeight));
  const auto covered = picture.at<cv::Vec3b>(245, 155);
  EXPECT_GT(covered[1], covered[2]);
  const auto gap = picture.at<cv::Vec3b>(245, 555);
  EXPECT_GT(gap[2], gap[1]);
}

TEST(ViewCollector, WritesWhatToDoAndOutlinesTheCellThatIsWanted) {
  ViewCollector collector({kWidth, kHeight}, {});
  EXPECT_GT(cv::countNonZero(collector.draw({"hold it still"}).reshape(1)), 100)
      << "before any image";
  const cv::Mat image(kHeight, kWidth, CV_8UC1, cv::Scalar(100));
  collector.add(image, gridAt(150, 240));
  collector.add(image, gridAt(150, 240));
  cv::Mat outlined;
  cv::inRange(collector.draw(), cv::Scalar(60, 230, 255), cv::Scalar(60, 230, 255), outlined);
  EXPECT_GT(cv::countNonZero(outlined), 50);
  EXPECT_LT(cv::countNonZero(outlined), kWidth * kHeight / 20);
  const cv::Mat plain = collector.draw();
  const cv::Mat told = collector.draw({"one", "two"});
  const cv::Rect corner(0, 0, kWidth / 3, kHeight / 5);
  EXPECT_GT(cv::norm(plain(corner), told(corner), cv::NORM_INF), 100.0);
  const cv::Rect rest(kWidth / 2, kHeight / 2, kWidth / 2, kHeight / 2);
  EXPECT_EQ(cv::norm(plain(rest), told(rest), cv::NORM_INF), 0.0);
}

TEST(DrawResiduals, MagnifiesEachAndCrossesOutWhatWasNotUsed) {
  Detections detections;
  detections.image_size = {200, 100};
  ViewDetections view;
  view.pixels = {{50.0, 50.0}};
  view.points = {{0.0, 0.0, 0.0}};
  detections.views = {view, view};
  detections.views[1].pixels = {{150.0, 50.0}};
  const cv::Mat picture = drawResiduals(detections, {{{0.3, 0.0}}, {}}, 100.0);
  ASSERT_EQ(picture.size(), cv::Size(200, 100));
  // 0.3 px to the right, a hundred times: green as far as pixel 80.
  EXPECT_GT(picture.at<cv::Vec3b>(50, 78)[1], 150);
  EXPECT_LT(picture.at<cv::Vec3b>(50, 90)[1], 60);
  EXPECT_EQ(picture.at<cv::Vec3b>(50, 150)[1], picture.at<cv::Vec3b>(50, 150)[2]) << "grey";
  EXPECT_GT(picture.at<cv::Vec3b>(50, 150)[1], 60);
}

TEST(ViewCollector, RefusesImagesOfAnotherSize) {
  ViewCollector collector({kWidth, kHeight}, {});
  EXPECT_THROW(collector.add(cv::Mat(10, 10, CV_8UC1), std::nullopt), Error);
  EXPECT_THROW(collector.add(cv::Mat(kHeight, kWidth, CV_8UC3), std::nullopt), Error);
  EXPECT_THROW(ViewCollector({1, 1}, {}), Error);
}

}  // namespace
}  // namespace omnister
