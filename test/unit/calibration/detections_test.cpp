// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/detections.h"

#include <gmock/gmock.h>

#include "omnister/common/error.h"

namespace omnister {
namespace {

using ::testing::HasSubstr;

constexpr const char* kHeader = "view,u_px,v_px,x_m,y_m,z_m\n";
const cv::Size kSize(640, 480);

std::string refusal(const std::string& text, cv::Size size = kSize) {
  try {
    parseDetections(text, "corners.csv", size);
  } catch (const InputError& error) {
    return error.what();
  }
  return "accepted";
}

TEST(DetectionsCsv, ComesBackAsWritten) {
  Detections detections;
  detections.image_size = kSize;
  for (const char* name : {"a.png", "0", "b"}) {
    ViewDetections& view = detections.views.emplace_back();
    view.name = name;
    for (int i = 0; i < 6; ++i) {
      view.pixels.emplace_back(1.0 / 3.0 + i, 100.0 - 0.1 * i);
      view.points.emplace_back(0.0244 * i, 1e-17 * i, -0.5);
    }
  }
  const Detections back = parseDetections(formatDetections(detections), "x", kSize);
  ASSERT_EQ(back.views.size(), 3u);
  for (std::size_t v = 0; v < 3; ++v) {
    EXPECT_EQ(back.views[v].name, detections.views[v].name);
    EXPECT_EQ(back.views[v].pixels, detections.views[v].pixels);
    EXPECT_EQ(back.views[v].points, detections.views[v].points);
  }
}

TEST(DetectionsCsv, KeepsOrderOfFirstAppearanceAndToleratesLineEnds) {
  const Detections d = parseDetections(
      "\xEF\xBB\xBFview,u_px,v_px,x_m,y_m,z_m\r\nb,1,2,0,0,0\r\n\r\n a , 3,4,0,0,0\r\nb,5,6,1,0,0",
      "x", kSize);
  ASSERT_EQ(d.views.size(), 2u);
  EXPECT_EQ(d.views[0].name, "b");
  EXPECT_EQ(d.views[1].name, "a");
  ASSERT_EQ(d.views[0].pixels.size(), 2u);
  EXPECT_EQ(d.views[0].pixels[1], Eigen::Vector2d(5, 6));
}

TEST(DetectionsCsv, NamesLineColumnAndExpectation) {
  const std::string h = kHeader;
  EXPECT_THAT(refusal(""), HasSubstr("line 1"));
  EXPECT_THAT(refusal("u,v\n"), HasSubstr("expected the header view,u_px,v_px,x_m,y_m,z_m"));
  EXPECT_THAT(refusal(h), HasSubstr("no corner"));
  EXPECT_THAT(refusal(h + "0,1,2,0,0\n"), HasSubstr("line 2: has 5 fields, expected 6"));
  EXPECT_THAT(refusal(h + "0,1,2,0,0,0,0\n"), HasSubstr("7 fields"));
  EXPECT_THAT(refusal(h + "0,1,2,0,0,0\n0,nan,2,1,0,0\n"),
              AllOf(HasSubstr("line 3, column u_px"), HasSubstr("'nan'"), HasSubstr("finite")));
  EXPECT_THAT(refusal(h + "0,1,x2,0,0,0\n"), HasSubstr("line 2, column v_px"));
  EXPECT_THAT(refusal(h + "0,1,2,0,inf,0\n"), HasSubstr("column y_m"));
  EXPECT_THAT(refusal(h + "0,1,2,1e30,0,0\n"), HasSubstr("1e9"));
  EXPECT_THAT(refusal(h + ",1,2,0,0,0\n"), HasSubstr("column view"));
  EXPECT_THAT(refusal(h + "0,640,2,0,0,0\n"), HasSubstr("outside the image of 640x480"));
  EXPECT_THAT(refusal(h + "0,1,-0.6,0,0,0\n"), HasSubstr("line 2, column v_px"));
  EXPECT_THAT(refusal(h + "0,1,2,0,0,0\n1,1,2,0,0,0\n0,3,4,0,0,0\n"),
              AllOf(HasSubstr("line 4"), HasSubstr("repeats a board point")));
  EXPECT_THAT(refusal(h + "0,1,2,0,0,0\n", cv::Size(0, 0)), HasSubstr("image size"));
  EXPECT_THAT(refusal(h + std::string("0\x01\x1b,bad,2,0,0,0\n")), HasSubstr("column u_px"));
  // The border pixel's own area still counts as inside.
  EXPECT_EQ(refusal(h + "0,639.5,-0.5,0,0,0\n"), "accepted");
}

TEST(DetectionsCsv, NamesWithCommasDoNotBreakRows) {
  Detections detections;
  detections.image_size = kSize;
  ViewDetections& view = detections.views.emplace_back();
  view.name = "a,b\nc.png";
  view.pixels.emplace_back(1, 2);
  view.points.emplace_back(0, 0, 0);
  const Detections back = parseDetections(formatDetections(detections), "x", kSize);
  ASSERT_EQ(back.views.size(), 1u);
  EXPECT_EQ(back.views[0].name, "a_b_c.png");
}

}  // namespace
}  // namespace omnister
