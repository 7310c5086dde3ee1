// SPDX-License-Identifier: Apache-2.0
#include "tools/target/target_print.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <opencv2/imgproc.hpp>

#include "omnister/calibration/detector.h"
#include "omnister/common/error.h"
#include "tools/cli/command_line.h"

namespace omnister::tools {
namespace {

namespace fs = std::filesystem;
using ::testing::HasSubstr;

// What is drawn is found, at the places where its TARGET.yaml has it: type, code, size and order
// agree.
TEST(TargetPrint, DrawnBoardsAreFoundWhereTheyShouldBe) {
  const std::string boards[] = {
      "{type: checkerboard, cols: 8, rows: 6, square_m: 0.0244}",
      "{type: checkerboard, cols: 8, rows: 5, square_m: 0.0244}",
      "{type: circles, cols: 7, rows: 5, square_m: 0.03}",
      "{type: circles, cols: 4, rows: 11, square_m: 0.018, asymmetric: true}",
      "{type: charuco, cols: 7, rows: 5, square_m: 0.034, marker_m: 0.025, dictionary: "
      "DICT_4X4_50}",
      "{type: charuco, cols: 5, rows: 6, square_m: 0.034, marker_m: 0.025, dictionary: "
      "DICT_5X5_100, "
      "legacy: true}",
      "{type: charuco, cols: 5, rows: 6, square_m: 0.034, marker_m: 0.025, dictionary: "
      "DICT_APRILTAG_36h11}",
      "{type: aprilgrid, cols: 5, rows: 4, square_m: 0.03, spacing: 0.3}",
      "{type: aprilgrid, cols: 4, rows: 4, square_m: 0.03, spacing: 0.25, dictionary: tag25h9, "
      "joining_squares: true}",
  };
  constexpr double kPixelsPerMm = 4.0;
  int found = 0;
  for (const std::string& text : boards) {
    const Target target = parseTarget(text, "board");
    const Layout layout = layOut(target, parsePage("a4"));
    // No lens is as sharp as the drawing, whose edges along the pixels show their place in one
    // grey.
    cv::Mat image;
    cv::GaussianBlur(drawImage(layout, kPixelsPerMm), image, {}, 0.8);
    const auto view = detectTarget(image, target);
    ASSERT_TRUE(view.has_value()) << text;
    EXPECT_EQ(view->pixels.size(), targetPoints(target).size()) << text;
    const TargetArtwork art = targetArtwork(target);
    double worst = 0.0;
    for (std::size_t i = 0; i < view->pixels.size(); ++i) {
      const Eigen::Vector2d mm = 1e3 * (view->points[i].head<2>() - art.min) +
                                 Eigen::Vector2d(layout.left_mm, layout.top_mm);
      // Drawings count pixels from their edges, pictures from their centres.
      const Eigen::Vector2d pixel = kPixelsPerMm * mm - Eigen::Vector2d::Constant(0.5);
      worst = std::max(worst, (view->pixels[i] - pixel).norm());
    }
    EXPECT_LT(worst, 0.06) << text;
    ++found;
  }
  EXPECT_EQ(found, 9);
}

TEST(TargetPrint, PagesHaveTheirTrueSize) {
  const Target target =
      parseTarget("{type: checkerboard, cols: 8, rows: 6, square_m: 0.02}", "board");
  const Layout layout = layOut(target, parsePage("300x200"));
  EXPECT_NEAR(layout.width_mm, 180.0, 1e-9);
  EXPECT_NEAR(layout.height_mm, 140.0, 1e-9);
  EXPECT_EQ(layout.bar_mm, 100.0);
  const std::string pdf = drawPdf(layout);
  EXPECT_THAT(pdf.substr(0, 5), "%PDF-");
  EXPECT_THAT(pdf, HasSubstr("%%EOF"));
  // 300 mm are 850.39 points, 200 mm 566.93.
  EXPECT_THAT(pdf, HasSubstr("/MediaBox [ 0 0 850.393701 566.929134 ]"));
  const std::string svg = drawSvg(layout);
  EXPECT_THAT(svg, HasSubstr("width=\"850.393701pt\" height=\"566.929134pt\""));
}

TEST(TargetPrint, TurnsThePageWhereThatIsWhatItTakes) {
  const Target target =
      parseTarget("{type: checkerboard, cols: 8, rows: 6, square_m: 0.0244}", "board");
  const Layout layout = layOut(target, parsePage("a4"));
  EXPECT_EQ(layout.page.width_mm, 297.0);
  EXPECT_EQ(layout.page.height_mm, 210.0);
}

std::string refusal(const std::string& target, const std::string& page) {
  try {
    layOut(parseTarget(target, "board"), parsePage(page));
  } catch (const InputError& error) {
    return error.what();
  }
  return "";
}

TEST(TargetPrint, WhatDoesNotFitSaysWhatWould) {
  const std::string board = "{type: checkerboard, cols: 8, rows: 6, square_m: 0.03}";
  const std::string message = refusal(board, "a4");
  EXPECT_THAT(message, HasSubstr("270 x 210 mm and does not fit on a4 (210 x 297 mm)"));
  EXPECT_THAT(message, HasSubstr("--page tabloid or --square-mm "));
  const double square = std::stod(message.substr(message.find("--square-mm ") + 12));
  const auto with = [](double mm) {
    return "{type: checkerboard, cols: 8, rows: 6, square_m: " + std::to_string(mm / 1000) + "}";
  };
  EXPECT_EQ(refusal(with(square), "a4"), "");
  EXPECT_NE(refusal(with(square + 0.2), "a4"), "");
  EXPECT_THAT(refusal("{type: checkerboard, cols: 8, rows: 6, square_m: 3}", "a4"),
              HasSubstr("expected --square-mm"));
  for (const std::string page : {"a9", "", "10x10", "210", "axb", "-1x300", "nanx300", "1e9x3"}) {
    EXPECT_THAT(refusal(board, page), HasSubstr("expected a0 to a4")) << page;
  }
}

class TargetCommand : public ::testing::Test {
 protected:
  void SetUp() override {
    folder_ = fs::path(::testing::TempDir()) / "omnister_target_test";
    fs::remove_all(folder_);
    fs::create_directories(folder_);
  }
  void TearDown() override { fs::remove_all(folder_); }
  int run(std::vector<std::string> arguments) const {
    std::vector<const char*> argv{"omnister", "target", "--json"};
    for (const std::string& argument : arguments) argv.push_back(argument.c_str());
    return runCommandLine(static_cast<int>(argv.size()), argv.data());
  }
  std::string file(const std::string& name) const { return (folder_ / name).string(); }
  fs::path folder_;
};

TEST_F(TargetCommand, WritesTheDrawingAndItsYaml) {
  EXPECT_EQ(run({"--type", "checkerboard", "--cols", "8", "--rows", "6", "--square-mm", "24.4",
                 "--out", file("board.pdf")}),
            0);
  EXPECT_TRUE(fs::exists(file("board.pdf")));
  std::ifstream yaml(file("board.yaml"));
  std::string text;
  std::getline(yaml, text);
  EXPECT_EQ(text, "{type: checkerboard, cols: 8, rows: 6, square_m: 0.0244}");
  EXPECT_EQ(run({"--type", "charuco", "--cols", "12", "--rows", "9", "--square-mm", "20", "--page",
                 "a3", "--out", file("c.svg"), "--yaml", file("own.yaml")}),
            0);
  EXPECT_EQ(readTarget(file("own.yaml")).dictionary, "DICT_4X4_100");
  EXPECT_EQ(readTarget(file("own.yaml")).marker_m, 0.015);
}

TEST_F(TargetCommand, RefusalsWriteNothing) {
  const std::vector<std::string> board{"--type", "checkerboard", "--cols", "8", "--rows", "6"};
  const auto with = [&](std::vector<std::string> more) {
    more.insert(more.begin(), board.begin(), board.end());
    return run(more);
  };
  EXPECT_EQ(with({"--square-mm", "240", "--out", file("a.pdf")}), 1);
  EXPECT_EQ(with({"--square-mm", "-1", "--out", file("a.pdf")}), 1);
  EXPECT_EQ(with({"--square-mm", "nan", "--out", file("a.pdf")}), 1);
  EXPECT_EQ(with({"--square-mm", "20", "--out", file("a.png")}), 1);
  EXPECT_EQ(with({"--square-mm", "20", "--out", file("a.pdf"), "--yaml", file("a.pdf")}), 1);
  EXPECT_EQ(with({"--square-mm", "20", "--out", file("absent/a.pdf")}), 1);
  EXPECT_EQ(with({"--square-mm", "20"}), 2);
  EXPECT_EQ(with({"--square-mm", "20", "--out", file("a.pdf"), "--type", "hexagons"}), 2);
  EXPECT_TRUE(fs::is_empty(folder_));
}

}  // namespace
}  // namespace omnister::tools
