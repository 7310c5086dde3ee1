// SPDX-License-Identifier: Apache-2.0
// Boards drawn by the renderer, so that the truth of every point is known.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <iostream>
#include <map>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "omnister/calibration/detector.h"
#include "omnister/lens/lens_models.h"
#include "rendered_boards.h"

namespace omnister {
namespace {

using test::boardPose;
using test::draw;
using test::Placement;
using test::wideLens;

struct Score {
  int found = 0;    ///< points found
  int visible = 0;  ///< points inside the picture
  double sum = 0.0;
  double worst = 0.0;
  Eigen::Vector2d bias = Eigen::Vector2d::Zero();
  int wrong = 0;  ///< more than 1 px off

  void add(const ViewDetections& view, const LensModel& lens, const Pose& pose) {
    for (std::size_t i = 0; i < view.pixels.size(); ++i) {
      const auto truth = lens.project(pose * view.points[i]);
      const Eigen::Vector2d off =
          truth ? Eigen::Vector2d(view.pixels[i] - *truth) : Eigen::Vector2d(1e3, 1e3);
      if (off.norm() > 1.0) {
        ++wrong;
        continue;
      }
      ++found;
      sum += off.squaredNorm();
      worst = std::max(worst, off.norm());
      bias += off;
    }
  }
  double rms() const { return std::sqrt(sum / std::max(1, found)); }
  Eigen::Vector2d meanOffset() const { return bias / std::max(1, found); }
};

std::ostream& operator<<(std::ostream& out, const Score& score) {
  return out << score.found << " of " << score.visible << " points, " << score.rms() << " px RMS, "
             << score.worst << " worst, offset " << score.meanOffset().transpose() << ", "
             << score.wrong << " wrong";
}

int visiblePoints(const Target& target, const LensModel& lens, const Pose& pose,
                  const cv::Size& size) {
  int count = 0;
  for (const auto& point : targetPoints(target)) {
    const auto pixel = lens.project(pose * point);
    count += pixel && pixel->x() >= 4 && pixel->y() >= 4 && pixel->x() <= size.width - 5 &&
             pixel->y() <= size.height - 5;
  }
  return count;
}

// The order of a symmetric pattern that fits the truth best.
ViewDetections renumbered(const ViewDetections& view, const Target& target, const LensModel& lens,
                          const Pose& pose) {
  const auto points = targetPoints(target);
  if (view.points.size() != points.size()) return view;
  ViewDetections best = view;
  double best_sum = 1e300;
  for (const auto& order : targetSymmetries(target)) {
    ViewDetections other = view;
    double sum = 0.0;
    for (std::size_t i = 0; i < points.size(); ++i) {
      other.points[i] = points[order[i]];
      const auto truth = lens.project(pose * other.points[i]);
      sum += truth ? (*truth - view.pixels[i]).squaredNorm() : 1e6;
    }
    if (sum < best_sum) {
      best_sum = sum;
      best = other;
    }
  }
  return best;
}

// Whole in the picture; edges never along the pixels, where the renderer's samples, and not the
// detector, would say how near an edge can be told.
const std::vector<Placement> kWhole{
    {10, 30, 0.35, 35, 20}, {50, 200, 0.34, -30, 10}, {68, 340, 0.36, 20, 75}};
// Cut off by the picture's rim.
const std::vector<Placement> kCut{{78, 170, 0.26, 0, 8}};

const cv::Size kSize(1280, 960);

struct Outcome {
  Score detected;
  Score guided;
  int boards = 0;
  int all = 0;  ///< points of the boards, in the picture or not
};

Outcome run(const Target& target, const std::vector<Placement>& placements,
            const std::string& save) {
  const LensPtr lens = wideLens(kSize);
  Outcome outcome;
  int index = 0;
  for (const Placement& placement : placements) {
    const Pose pose = boardPose(target, placement);
    const cv::Mat image = draw(target, pose, *lens, kSize);
    if (const char* folder = std::getenv("OMNISTER_SAVE_IMAGES")) {
      cv::imwrite(std::string(folder) + "/" + save + std::to_string(index++) + ".png", image);
    }
    const int visible = visiblePoints(target, *lens, pose, kSize);
    outcome.all += static_cast<int>(targetPoints(target).size());
    outcome.detected.visible += visible;
    outcome.guided.visible += visible;
    const auto view = detectTarget(image, target);
    if (!view) {
      std::cout << "  not found at " << placement.theta_deg << " degrees\n";
      continue;
    }
    ++outcome.boards;
    Score here;
    here.visible = visible;
    const ViewDetections numbered = renumbered(*view, target, *lens, pose);
    here.add(numbered, *lens, pose);
    outcome.detected.add(numbered, *lens, pose);
    std::cout << "  " << placement.theta_deg << " degrees: " << here << '\n';
    const ViewDetections guided = refineGuided(image, target, *lens, numbered);
    Score after;
    after.visible = visible;
    after.add(guided, *lens, pose);
    std::cout << "      guided: " << after << '\n';
    outcome.guided.add(guided, *lens, pose);
  }
  std::cout << "detected: " << outcome.boards << " boards, " << outcome.detected
            << "\nguided:   " << outcome.guided << '\n';
  return outcome;
}

Target make(const std::string& text) { return parseTarget(text, "test"); }

void expectWhole(const Outcome& outcome, std::size_t boards, double detected_rms,
                 double guided_rms) {
  EXPECT_EQ(outcome.boards, static_cast<int>(boards));
  EXPECT_EQ(outcome.detected.wrong, 0);
  EXPECT_EQ(outcome.guided.wrong, 0);
  EXPECT_GE(outcome.detected.found, 0.97 * outcome.detected.visible);
  EXPECT_GE(outcome.guided.found, 0.97 * outcome.guided.visible);
  EXPECT_LT(outcome.detected.rms(), detected_rms);
  EXPECT_LT(outcome.guided.rms(), guided_rms);
  EXPECT_LT(outcome.guided.meanOffset().norm(), 0.015);
}

void expectCut(const Outcome& outcome, double rms, double share) {
  EXPECT_EQ(outcome.boards, static_cast<int>(kCut.size()));
  EXPECT_EQ(outcome.detected.wrong, 0);
  EXPECT_LT(outcome.detected.visible, outcome.all);
  EXPECT_GE(outcome.detected.found, share * outcome.detected.visible);
  EXPECT_LT(outcome.detected.rms(), rms);
  EXPECT_LT(outcome.guided.rms(), rms);
}

TEST(RenderedBoard, Checkerboard) {
  const Target target = make("{type: checkerboard, cols: 8, rows: 6, square_m: 0.03}");
  expectWhole(run(target, kWhole, "checker"), kWhole.size(), 0.03, 0.03);
}

TEST(RenderedBoard, Charuco) {
  const Target target = make(
      "{type: charuco, cols: 8, rows: 6, square_m: 0.035, marker_m: 0.026, dictionary: "
      "DICT_4X4_50}");
  expectWhole(run(target, kWhole, "charuco"), kWhole.size(), 0.03, 0.03);
  expectCut(run(target, kCut, "charuco_cut"), 0.05, 0.9);
}

TEST(RenderedBoard, AprilGrid) {
  const Target target = make("{type: aprilgrid, cols: 4, rows: 4, square_m: 0.05, spacing: 0.3}");
  expectWhole(run(target, kWhole, "april"), kWhole.size(), 0.08, 0.08);
  expectCut(run(target, kCut, "april_cut"), 0.08, 0.8);
}

TEST(RenderedBoard, AprilGridWithJoiningSquares) {
  const Target target = make(
      "{type: aprilgrid, cols: 4, rows: 4, square_m: 0.05, spacing: 0.3, joining_squares: true}");
  expectWhole(run(target, kWhole, "kalibr"), kWhole.size(), 0.03, 0.03);
}

// Kalibr's border of two bits, found by itself and as well as the other; the squares too.
TEST(RenderedBoard, AprilGridWithKalibrsBorder) {
  const std::string board = "{type: aprilgrid, cols: 4, rows: 4, square_m: 0.05, spacing: 0.3";
  const Target target = make(board + ", joining_squares: true, border_bits: 2}");
  expectWhole(run(target, kWhole, "kalibr2"), kWhole.size(), 0.03, 0.03);
  const LensPtr lens = wideLens(kSize);
  for (const char* shown : {", border_bits: 2}", ", border_bits: 2, joining_squares: true}",
                            ", border_bits: 1, joining_squares: true}", ", border_bits: 1}"}) {
    const Target drawn = make(board + shown);
    const Pose pose = boardPose(drawn, kWhole[0]);
    const auto view = detectTarget(draw(drawn, pose, *lens, kSize), make(board + "}"));
    ASSERT_TRUE(view) << shown;
    Score score;
    score.add(*view, *lens, pose);
    EXPECT_EQ(score.found, 64) << shown;
    EXPECT_LT(score.rms(), 0.08) << shown;
  }
}

// Small pictures, tags of 9 to 40 pixels: as many corners with either border.
TEST(RenderedBoard, AprilGridInSmallPictures) {
  const std::vector<Placement> placements = {{10, 30, 0.35, 35, 20},  {50, 200, 0.34, -30, 10},
                                             {68, 340, 0.36, 20, 75}, {78, 170, 0.30, 0, 8},
                                             {30, 100, 0.5, 25, 40},  {0, 0, 0.6, 40, 0}};
  struct Row {
    int side;
    double least;  ///< of all corners, with either border
  };
  for (const Row& row : {Row{512, 0.7}, {1024, 0.85}}) {
    const cv::Size size(row.side, row.side);
    const LensPtr lens = wideLens(size);
    std::map<int, Score> scores;
    for (const int border : {1, 2}) {
      for (const Placement& placement : placements) {
        const Target target = make(
            "{type: aprilgrid, cols: 6, rows: 6, square_m: 0.04, spacing: 0.3, "
            "joining_squares: true, border_bits: " +
            std::to_string(border) + "}");
        const Pose pose = boardPose(target, placement);
        scores[border].visible += 144;
        if (const auto view = detectTarget(draw(target, pose, *lens, size), target)) {
          scores[border].add(*view, *lens, pose);
        }
      }
      std::cout << row.side << " px, border of " << border << ": " << scores[border] << '\n';
      EXPECT_LE(scores[border].wrong, 3);
      EXPECT_GE(scores[border].found, row.least * scores[border].visible);
    }
    EXPECT_GE(scores[2].found, 0.98 * scores[1].found);
    EXPECT_LT(scores[2].rms(), 1.2 * scores[1].rms());
  }
}

// Without a lens, a dot's centroid is not the image of its centre: a tenth of a pixel or two.
TEST(RenderedBoard, Circles) {
  const Target target = make("{type: circles, cols: 7, rows: 6, square_m: 0.035}");
  expectWhole(run(target, kWhole, "circles"), kWhole.size(), 0.2, 0.015);
}

TEST(RenderedBoard, AsymmetricCircles) {
  const Target target =
      make("{type: circles, cols: 4, rows: 9, square_m: 0.028, asymmetric: true}");
  expectWhole(run(target, kWhole, "asym"), kWhole.size(), 0.25, 0.015);
}

}  // namespace
}  // namespace omnister
