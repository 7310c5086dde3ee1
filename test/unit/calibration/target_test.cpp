// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/target.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <set>

#include "omnister/common/error.h"

namespace omnister {
namespace {

using ::testing::HasSubstr;

std::string refusal(const std::string& text) {
  try {
    parseTarget(text, "board.yaml");
  } catch (const InputError& error) {
    return error.what();
  }
  return "";
}

const std::string kBoards[] = {
    "{type: checkerboard, cols: 8, rows: 6, square_m: 0.0244}\n",
    "{type: circles, cols: 7, rows: 5, square_m: 0.03}\n",
    "{type: circles, cols: 4, rows: 11, square_m: 0.02, asymmetric: true, dot_m: 0.015}\n",
    "{type: charuco, cols: 7, rows: 5, square_m: 0.04, marker_m: 0.03, dictionary: DICT_4X4_50}\n",
    "{type: charuco, cols: 5, rows: 6, square_m: 0.04, marker_m: 0.03, dictionary: "
    "DICT_APRILTAG_36h11, legacy: true}\n",
    "{type: aprilgrid, cols: 6, rows: 6, square_m: 0.088, spacing: 0.3, dictionary: tag36h11}\n",
    "{type: aprilgrid, cols: 3, rows: 2, square_m: 0.1, spacing: 0.25, dictionary: tag25h9, "
    "joining_squares: true}\n",
    "{type: aprilgrid, cols: 6, rows: 6, square_m: 0.088, spacing: 0.3, dictionary: tag36h11, "
    "joining_squares: true, border_bits: 2}\n",
};

TEST(Target, FormatsWhatItParses) {
  int round_trips = 0;
  for (const std::string& text : kBoards) {
    EXPECT_EQ(formatTarget(parseTarget(text, "board.yaml")), text);
    ++round_trips;
  }
  EXPECT_EQ(round_trips, 8);
}

TEST(Target, ReadsKalibrsTargetFiles) {
  const std::pair<std::string, std::string> cases[] = {
      {"target_type: 'aprilgrid' #gridtype\ntagCols: 6               #number of apriltags\n"
       "tagRows: 5\ntagSize: 0.088           #size [m]\ntagSpacing: 0.3\n",
       "{type: aprilgrid, cols: 6, rows: 5, square_m: 0.088, spacing: 0.3, dictionary: tag36h11, "
       "joining_squares: true}\n"},
      // Basalt's, and old ones of Kalibr.
      {"{\"tagCols\": 6, \"tagRows\": 6, \"tagSize\": 0.088, \"tagSpacing\": 0.3}",
       "{type: aprilgrid, cols: 6, rows: 6, square_m: 0.088, spacing: 0.3, dictionary: tag36h11, "
       "joining_squares: true}\n"},
      {"target_type: aprilgrid\ntagCols: 6\ntagRows: 6\ntagSize: 8.8e-2\ntagSpacing: 0.3\n"
       "codeOffset: 0\n",
       "{type: aprilgrid, cols: 6, rows: 6, square_m: 0.088, spacing: 0.3, dictionary: tag36h11, "
       "joining_squares: true}\n"},
      {"target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\n"
       "colSpacingMeters: 0.06\n",
       "{type: checkerboard, cols: 6, rows: 7, square_m: 0.06}\n"},
      {"target_type: 'circlegrid'\ntargetCols: 4\ntargetRows: 11\nspacingMeters: 0.02\n"
       "asymmetricGrid: True\n",
       "{type: circles, cols: 4, rows: 11, square_m: 0.02, asymmetric: true}\n"},
      {"target_type: 'circlegrid'\ntargetCols: 6\ntargetRows: 7\nspacingMeters: 0.02\n"
       "asymmetricGrid: False\n",
       "{type: circles, cols: 6, rows: 7, square_m: 0.02}\n"},
  };
  int read = 0;
  for (const auto& [text, ours] : cases) {
    EXPECT_EQ(formatTarget(parseTarget(text, "kalibr.yaml")), ours) << text;
    ++read;
  }
  EXPECT_EQ(read, 6);
}

TEST(Target, DrawsTheBorderThatItSays) {
  const auto ink = [](const std::string& more) {
    return targetArtwork(parseTarget(
        "{type: aprilgrid, cols: 2, rows: 2, square_m: 1, spacing: 0.3" + more + "}", "b"));
  };
  const auto black = [](const TargetArtwork& artwork, double x, double y) {
    return std::any_of(artwork.rectangles.begin(), artwork.rectangles.end(), [&](const auto& r) {
      return x > r.x && y > r.y && x < r.x + r.width && y < r.y + r.height;
    });
  };
  // Two of ten cells on either side against one of eight: what is black all the way along the top.
  const auto depth = [&](const TargetArtwork& artwork) {
    for (double y = 0.005; y < 1.0; y += 0.01) {
      for (double x = 0.01; x < 1.0; x += 0.02) {
        if (!black(artwork, x, y)) return y;
      }
    }
    return 1.0;
  };
  EXPECT_NEAR(depth(ink(", border_bits: 2")), 0.2, 0.011);
  EXPECT_NEAR(depth(ink(", border_bits: 1")), 0.125, 0.011);
  EXPECT_NEAR(depth(ink("")), 0.125, 0.011);
}

TEST(Target, ReadsTheDocumentedExample) {
  const Target target =
      parseTarget("type: checkerboard\ncols: 8\nrows: 6\nsquare_m: 2.44e-2\n", "b");
  EXPECT_EQ(target.type, TargetType::kCheckerboard);
  EXPECT_EQ(target.cols, 8);
  EXPECT_EQ(target.rows, 6);
  EXPECT_EQ(target.square_m, 0.0244);
}

TEST(Target, RefusalsNameSourceKeyValueAndExpectation) {
  const std::pair<std::string, std::string> cases[] = {
      {"", "expected a target such as"},
      {"[1, 2]", "expected a target such as"},
      {"{type: checkerboard, cols: 8", "is not YAML"},
      {"{type: checkerboard, cols: 8, rows: 6, square_m: 1}\n---\n# another\n{rows: 7}",
       "line 4: begins another"},
      {"{cols: 8, rows: 6, square_m: 1}", "type: is missing"},
      {"{type: chessboard, cols: 8, rows: 6, square_m: 1}", "'chessboard', expected checkerboard,"},
      {"{type: checkerboard, rows: 6, square_m: 1}", "cols: is missing"},
      {"{type: checkerboard, cols: 8.5, rows: 6, square_m: 1}", "cols: is '8.5', expected a whole"},
      {"{type: checkerboard, cols: nan, rows: 6, square_m: 1}", "cols: is 'nan'"},
      {"{type: checkerboard, cols: 1e300, rows: 6, square_m: 1}", "cols: is '1e300'"},
      {"{type: checkerboard, cols: 2, rows: 6, square_m: 1}", "from 3 to 100"},
      {"{type: checkerboard, cols: 8, rows: 101, square_m: 1}", "rows: is 101"},
      {"{type: checkerboard, cols: 8, rows: 6, square_m: 0}", "square_m: is 0, expected a length"},
      {"{type: checkerboard, cols: 8, rows: 6, square_m: -1}", "square_m: is -1"},
      {"{type: checkerboard, cols: 8, rows: 6, square_m: nan}", "square_m: is nan"},
      {"{type: checkerboard, cols: 8, rows: 6, square_m: inf}", "square_m: is inf"},
      {"{type: checkerboard, cols: 8, rows: 6, square_m: ten}",
       "square_m: is 'ten', expected a num"},
      {"{type: checkerboard, cols: 8, rows: 6, square_m: [1]}", "square_m: is not a single value"},
      {"{type: checkerboard, cols: 8, rows: 6, square_m: 1, colour: 2}", "colour: is not a key of"},
      {"{type: checkerboard, cols: 8, cols: 8, rows: 6, square_m: 1}", "cols: stands there twice"},
      {"{type: checkerboard, cols: 8, rows: 6, square_m: 1, spacing: 2}", "spacing: is not a key"},
      {"{[1]: checkerboard}", "key that is not a word"},
      {"{type: circles, cols: 4, rows: 5, square_m: 1, asymmetric: maybe}",
       "expected true or false"},
      {"{type: circles, cols: 4, rows: 5, square_m: 1, dot_m: 1}", "dot_m: is 1, expected less"},
      {"{type: charuco, cols: 4, rows: 5, square_m: 1, dictionary: DICT_4X4_50}",
       "marker_m: is mis"},
      {"{type: charuco, cols: 4, rows: 5, square_m: 1, marker_m: 2, dictionary: DICT_4X4_50}",
       "marker_m: is 2, expected less than square_m, 1"},
      {"{type: charuco, cols: 4, rows: 5, square_m: 1, marker_m: .5, dictionary: DICT_3X3}",
       "'DICT_3X3', expected one of DICT_{4X4"},
      {"{type: charuco, cols: 20, rows: 20, square_m: 1, marker_m: .5, dictionary: DICT_4X4_50}",
       "has 50 markers, but the board needs 200"},
      {"{type: aprilgrid, cols: 6, rows: 6, square_m: 1, spacing: 0}", "spacing: is 0"},
      {"{type: aprilgrid, cols: 6, rows: 6, square_m: 1, spacing: .3, dictionary: tag99}",
       "'tag99', expected one of tag36h11"},
      {"{type: aprilgrid, cols: 6, rows: 6, square_m: 1, spacing: .3, dictionary: tag16h5}",
       "has 30 tags, but the board needs 36"},
      {"{type: aprilgrid, cols: 6, rows: 6, square_m: 1, spacing: .3, border_bits: 3}",
       "border_bits: is 3, expected a whole number from 1 to 2"},
      {"{target_type: aprilgrid, tagCols: 6, tagRows: 6, tagSize: 0.1}", "tagSpacing: is missing"},
      {"{target_type: aprilgrid, tagCols: 6, tagRows: 6, tagSize: 0.1, tagSpacing: 0.3, lowId: 36}",
       "lowId: is '36', expected 0"},
      {"{target_type: aprilgrid, tagCols: 6, tagRows: 6, tagSize: 0.1, tagSpacing: 0.3, a: 1}",
       "a: is not a key of Kalibr's aprilgrid"},
      {"{target_type: checkerboard, targetCols: 6, targetRows: 7, rowSpacingMeters: 0.05, "
       "colSpacingMeters: 0.06}",
       "rowSpacingMeters: is 0.05, expected 0.06"},
      {"{target_type: circlegrid, targetCols: 6, targetRows: 7, spacingMeters: 0.05, "
       "asymmetricGrid: 2}",
       "asymmetricGrid: is '2', expected True or False"},
      {"{target_type: hexagons, tagCols: 6}", "target_type: is 'hexagons', expected aprilgrid"},
      {"{type: \"a\\nb\", cols: 6, rows: 6, square_m: 1}", "'a\\x0ab'"},
  };
  int refused = 0;
  for (const auto& [text, message] : cases) {
    EXPECT_THAT(refusal(text), HasSubstr(message)) << text;
    EXPECT_THAT(refusal(text), HasSubstr("board.yaml")) << text;
    ++refused;
  }
  EXPECT_EQ(refused, 39);
}

TEST(Target, PointsRunRowByRowFromTheOrigin) {
  const auto points = targetPoints(parseTarget(kBoards[0], "b"));
  ASSERT_EQ(points.size(), 48u);
  EXPECT_EQ(points[0], Eigen::Vector3d::Zero());
  EXPECT_TRUE(points[1].isApprox(Eigen::Vector3d(0.0244, 0, 0)));
  EXPECT_TRUE(points[8].isApprox(Eigen::Vector3d(0, 0.0244, 0)));
  EXPECT_TRUE(points[47].isApprox(Eigen::Vector3d(7 * 0.0244, 5 * 0.0244, 0)));

  const auto dots = targetPoints(parseTarget(kBoards[2], "b"));
  ASSERT_EQ(dots.size(), 44u);
  EXPECT_TRUE(dots[1].isApprox(Eigen::Vector3d(0.04, 0, 0)));
  EXPECT_TRUE(dots[4].isApprox(Eigen::Vector3d(0.02, 0.02, 0)));

  EXPECT_EQ(targetPoints(parseTarget(kBoards[3], "b")).size(), 24u);

  const auto tags = targetPoints(parseTarget(kBoards[5], "b"));
  ASSERT_EQ(tags.size(), 144u);
  EXPECT_TRUE(tags[1].isApprox(Eigen::Vector3d(0.088, 0, 0)));
  EXPECT_TRUE(tags[2].isApprox(Eigen::Vector3d(0.088 * 1.3, 0, 0)));
  EXPECT_TRUE(tags[12].isApprox(Eigen::Vector3d(0, 0.088, 0)));
}

// Whether black of the artwork covers a place.
bool isBlack(const TargetArtwork& artwork, double x, double y) {
  for (const auto& r : artwork.rectangles) {
    if (x > r.x && y > r.y && x < r.x + r.width && y < r.y + r.height) return true;
  }
  for (const auto& dot : artwork.dots) {
    if (std::hypot(x - dot.x, y - dot.y) < dot.radius) return true;
  }
  return false;
}

// The extent of the pattern turns onto itself with the grid, so a symmetry of the points must be
// one of the ink and the other way round. Charuco and aprilgrid carry codes and have none.
TEST(Target, SymmetriesAreThoseOfTheInk) {
  int boards = 0;
  for (const std::string type : {"checkerboard", "circles", "circles, asymmetric: true"}) {
    for (int cols = 3; cols <= 6; ++cols) {
      for (int rows = 3; rows <= 6; ++rows) {
        const Target target = parseTarget("{type: " + type + ", cols: " + std::to_string(cols) +
                                              ", rows: " + std::to_string(rows) + ", square_m: 1}",
                                          "b");
        const TargetArtwork ink = targetArtwork(target);
        const auto points = targetPoints(target);
        Eigen::Vector2d low = points[0].head<2>();
        Eigen::Vector2d high = low;
        for (const auto& p : points) {
          low = low.cwiseMin(p.head<2>());
          high = high.cwiseMax(p.head<2>());
        }
        const Eigen::Vector2d centre = 0.5 * (low + high);
        int expected = 0;
        for (int quarter = 0; quarter < 4; ++quarter) {
          const Eigen::Rotation2Dd turn(quarter * M_PI / 2);
          bool same = true;
          for (double x = -0.95; x < high.x() + 1; x += 0.31) {
            for (double y = -0.95; y < high.y() + 1; y += 0.31) {
              const Eigen::Vector2d place = turn * (Eigen::Vector2d(x, y) - centre) + centre;
              same = same && isBlack(ink, x, y) == isBlack(ink, place.x(), place.y());
            }
          }
          expected += same;
        }
        const auto orders = targetSymmetries(target);
        EXPECT_EQ(static_cast<int>(orders.size()), expected) << formatTarget(target);
        for (const auto& order : orders) {
          EXPECT_EQ(std::set<int>(order.begin(), order.end()).size(), points.size());
          // A turn keeps distances and handedness.
          const auto at = [&](int i) -> Eigen::Vector2d { return points[order[i]].head<2>(); };
          const int down = cols;
          EXPECT_NEAR((at(1) - at(0)).norm(), (points[1] - points[0]).norm(), 1e-12);
          const Eigen::Vector2d a = at(1) - at(0);
          const Eigen::Vector2d b = at(down) - at(0);
          EXPECT_GT(a.x() * b.y() - a.y() * b.x(), 0.0) << formatTarget(target);
        }
        ++boards;
      }
    }
  }
  EXPECT_EQ(boards, 48);
  EXPECT_EQ(targetSymmetries(parseTarget(kBoards[3], "b")).size(), 1u);
  EXPECT_EQ(targetSymmetries(parseTarget(kBoards[5], "b")).size(), 1u);
}

TEST(Target, FirstSquareOfACheckerboardIsDark) {
  const TargetArtwork ink = targetArtwork(parseTarget(kBoards[0], "b"));
  EXPECT_TRUE(isBlack(ink, 0.012, 0.012));
  EXPECT_FALSE(isBlack(ink, 0.036, 0.012));
  EXPECT_EQ(ink.rectangles.size(), 32u);
}

}  // namespace
}  // namespace omnister
