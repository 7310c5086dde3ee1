// SPDX-License-Identifier: Apache-2.0
// A board seen from known positions of a stage: shared poses, metric steps, the axis found.
#include <gmock/gmock.h>

#include <nlohmann/json.hpp>

#include "command_run.h"
#include "omnister/calibration/calibrate.h"
#include "omnister/calibration/stage_positions.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/lens/lens_file.h"
#include "stage_scene.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

using ::testing::Contains;
using ::testing::HasSubstr;

using test::StageScene;

std::string refusal(const Detections& detections, const CalibrationOptions& options) {
  try {
    calibrate(detections, options);
  } catch (const Error& error) {
    return error.what();
  }
  return "accepted";
}

// A board that looks the same turned by a half may be numbered from another end in some views.
TEST(StageCalibration, ViewsOfOnePlacementAreNumberedAlike) {
  StageScene scene;
  scene.board.rows = 10;
  Detections detections = scene.seen(3);
  const CalibrationResult straight = calibrate(detections, scene.options());
  int renumbered = 0;
  for (std::size_t i = 1; i < detections.views.size(); i += 2) {
    ViewDetections& view = detections.views[i];
    if (view.points.size() != 120) continue;
    for (Eigen::Vector3d& point : view.points) {
      point = Eigen::Vector3d(11 * 0.04, 9 * 0.04, 0.0) - point;
    }
    ++renumbered;
  }
  ASSERT_GT(renumbered, 0);
  const CalibrationResult result = calibrate(detections, scene.options());
  ASSERT_TRUE(result.stage);
  EXPECT_EQ(result.stage->views, straight.stage->views);
  EXPECT_NEAR(result.height_px, straight.height_px, 0.05);
  EXPECT_LT((result.stage->axis - straight.stage->axis).norm(), 1e-4);
}

TEST(StageCalibration, OneTiltedBoardAndFiveStepsGiveTheHeightAndTheAxis) {
  StageScene scene;
  scene.board.cols = 28;
  scene.board.rows = 20;
  scene.board.square = 0.03;
  scene.distance = 0.2;
  double squares = 0.0;
  double predicted = 0.0;
  double axis_squares = 0.0;
  double axis_predicted = 0.0;
  constexpr int kSeeds = 12;
  for (unsigned seed = 1; seed <= kSeeds; ++seed) {
    const CalibrationResult result = calibrate(scene.seen(seed), scene.options());
    ASSERT_TRUE(result.stage);
    EXPECT_NEAR(result.rms_px, 0.3 * std::sqrt(2.0), 0.02);
    squares += std::pow(result.height_px / 300.0 - 1.0, 2);
    predicted += std::pow(result.height_sigma_px / 300.0, 2);
    axis_squares += (result.stage->axis - scene.axis).squaredNorm();
    axis_predicted += std::pow(result.stage->axis_sigma_rad, 2);
    EXPECT_NEAR(result.stage->scale, 1.0, 5 * result.stage->scale_sigma);
    EXPECT_LT(result.stage->scale_sigma, 2e-4);
    EXPECT_EQ(result.stage->boards, 1);
    EXPECT_EQ(result.stage->views, 6);
  }
  EXPECT_LT(std::sqrt(squares / kSeeds), 2e-4);
  EXPECT_NEAR(std::sqrt(squares / predicted), 1.0, 0.4);
  EXPECT_LT(std::sqrt(axis_squares / kSeeds), 3e-4);
  EXPECT_NEAR(std::sqrt(axis_squares / axis_predicted), 1.0, 0.4);
}

TEST(StageCalibration, ExactCornersGiveTheExactLens) {
  StageScene scene;
  scene.board.noise_px = 0.0;
  scene.boards = 2;
  const CalibrationResult result = calibrate(scene.seen(1), scene.options());
  EXPECT_LT(result.rms_px, 1e-5);
  EXPECT_NEAR(result.height_px, 300.0, 1e-4);
  ASSERT_TRUE(result.file.stage_axis);
  EXPECT_LT((*result.file.stage_axis - scene.axis).norm(), 1e-7);
  EXPECT_NEAR(result.stage->scale, 1.0, 1e-7);
  // The poses that go into the report are those of each view.
  const Eigen::Vector3d moved =
      result.views[5].T_camera_board.translation() - result.views[0].T_camera_board.translation();
  EXPECT_LT((moved + 0.5 * scene.axis).norm(), 1e-6);
}

TEST(StageCalibration, ASquareBoardTellsTheScaleOnlyWhereTheStageComesNearer) {
  StageScene scene;
  scene.tilt = 0.0;
  scene.axis = Eigen::Vector3d::UnitX();
  scene.board.noise_px = 0.1;
  CalibrationOptions options;
  options.model = "conic";
  EXPECT_THAT(refusal(scene.seen(1), options), HasSubstr("square to the optical axis"));
  scene.axis = Eigen::Vector3d(0.6, 0.0, 0.8);
  scene.step = 0.03;
  const CalibrationResult result = calibrate(scene.seen(1), scene.options());
  EXPECT_NEAR(result.height_px, 300.0, 5 * result.height_sigma_px);
  EXPECT_LT(result.height_sigma_px, 1.0);
  EXPECT_LT((result.stage->axis - scene.axis).norm(), 5 * result.stage->axis_sigma_rad);
}

TEST(StageCalibration, AWrongPositionIsNamedAndHardlyMatters) {
  StageScene scene;
  scene.boards = 3;
  Detections detections = scene.seen(3);
  const CalibrationResult clean = calibrate(detections, scene.options());
  EXPECT_THAT(clean.warnings, Not(Contains(HasSubstr("stage position"))));
  detections.views[7].stage->position_m += 0.02;
  const CalibrationResult result = calibrate(detections, scene.options());
  EXPECT_THAT(result.warnings, Contains(HasSubstr("'b1_1'")));
  EXPECT_EQ(result.stage->views, 17);
  EXPECT_NEAR(result.rms_px, clean.rms_px, 0.01);
  EXPECT_NEAR(result.height_px, clean.height_px, 0.3);
  // A board that was carried about belongs to no placement.
  std::mt19937 random(1);
  std::uniform_real_distribution<double> unit(0.0, 0.5);
  for (ViewDetections& view : detections.views) view.stage->position_m = unit(random);
  EXPECT_NE(refusal(detections, scene.options()), "accepted");
}

TEST(StageCalibration, UnitsThatDisagreeAreTold) {
  StageScene scene;
  scene.boards = 2;
  scene.unit = 1.01;
  const CalibrationResult result = calibrate(scene.seen(5), scene.options());
  EXPECT_NEAR(result.stage->scale, 1.0 / 1.01, 5 * result.stage->scale_sigma);
  EXPECT_THAT(result.warnings, Contains(HasSubstr("of what the stage positions say")));
  for (const double unit : {1000.0, 3.3, 0.4}) {
    scene.unit = unit;
    EXPECT_THAT(refusal(scene.seen(5), scene.options()), HasSubstr("both in metres")) << unit;
  }
  scene.unit = 1.0;
  scene.step = 0.0;
  EXPECT_THAT(refusal(scene.seen(5), scene.options()), HasSubstr("different stage positions"));
}

TEST(StagePositions, ReadsWhatIsDocumentedAndRefusesTheRest) {
  const auto rows =
      parseStagePositions("\xEF\xBB\xBFview, position_m,board\r\n a.png , 0.5,x\n\n", "f");
  ASSERT_EQ(rows.size(), 1u);
  EXPECT_EQ(rows[0].view, "a.png");
  EXPECT_EQ(rows[0].stage.position_m, 0.5);
  EXPECT_EQ(rows[0].stage.board, "x");
  const auto message = [](const std::string& text) {
    try {
      parseStagePositions(text, "steps.csv");
    } catch (const InputError& error) {
      return std::string(error.what());
    }
    return std::string("accepted");
  };
  EXPECT_THAT(message("view,u\na,1\n"), AllOf(HasSubstr("steps.csv"), HasSubstr("line 1"),
                                              HasSubstr("'view,u'"), HasSubstr("view,position_m")));
  EXPECT_THAT(message("view,position_m\na,1\nb,x\n"),
              AllOf(HasSubstr("line 3, column position_m"), HasSubstr("'x'")));
  EXPECT_THAT(message("view,position_m\na,nan\n"), HasSubstr("expected metres"));
  EXPECT_THAT(message("view,position_m\na,1\na,2\n"), HasSubstr("has a row already"));
  EXPECT_THAT(message("view,position_m\na,1,b\n"), HasSubstr("3 fields, expected 2"));
  EXPECT_THAT(message("view,position_m,board\na,1,\n"), HasSubstr("column board"));
  EXPECT_THAT(message("view,position_m\n,1\n"), HasSubstr("column view"));
  EXPECT_THAT(message("view,position_m\n"), HasSubstr("no position"));

  Detections detections;
  for (const char* name : {"one/a.png", "one/b.png", "two/b.png", "two/c.png"}) {
    detections.views.emplace_back().name = name;
  }
  const auto remarks = applyStagePositions(
      parseStagePositions("view,position_m\na.png,1\nx,2\n", "f"), "f", detections);
  EXPECT_EQ(detections.views[0].stage->position_m, 1.0);
  EXPECT_FALSE(detections.views[1].stage);
  EXPECT_THAT(remarks, ::testing::ElementsAre(HasSubstr("'x'"), HasSubstr("3 views have no")));
  const auto apply = [&](const std::string& text) {
    Detections copy = detections;
    applyStagePositions(parseStagePositions(text, "f"), "f", copy);
  };
  EXPECT_THROW(apply("view,position_m\nb.png,1\n"), InputError);
  EXPECT_THROW(apply("view,position_m\nc.png,1\ntwo/c.png,1\n"), InputError);
  EXPECT_THROW(apply("view,position_m\nx,1\n"), InputError);
  EXPECT_NO_THROW(apply("view,position_m\ntwo/b.png,1\n"));
}

TEST(StagePositions, TheCommandWritesTheAxisWithTheLens) {
  const test::TemporaryFolder folder;
  StageScene scene;
  scene.boards = 2;
  const Detections detections = scene.seen(9);
  const std::string corners = folder.path() / "corners.csv";
  const std::string steps = folder.path() / "steps.csv";
  const std::string lens = folder.path() / "lens.yaml";
  writeFileAtomically(corners, formatDetections(detections));
  std::string text = "view,position_m,board\n";
  for (const ViewDetections& view : detections.views) {
    text +=
        view.name + "," + std::to_string(view.stage->position_m) + "," + view.stage->board + "\n";
  }
  writeFileAtomically(steps, text);
  const test::Outcome outcome =
      test::run({"calibrate", "--detections", corners, "--size", "1280x960", "--positions", steps,
                 "--model", "quadric", "--out", lens, "--json"});
  ASSERT_EQ(outcome.code, 0) << outcome.err;
  const auto json = nlohmann::json::parse(outcome.out);
  EXPECT_NEAR(json["stage_axis"][0], scene.axis.x(), 2e-3);
  EXPECT_NEAR(json["stage_axis"][2], scene.axis.z(), 2e-3);
  EXPECT_NEAR(json["height_px"], 300.0, 1.0);
  EXPECT_GT(json["height_sigma_px"], 0.01);
  EXPECT_NEAR(json["stage_scale"], 1.0, 2e-3);
  const LensFile file = readLensFile(lens);
  ASSERT_TRUE(file.stage_axis);
  EXPECT_LT((*file.stage_axis - scene.axis).norm(), 3e-3);
  EXPECT_EQ(file.calibration.notes.count("stage_axis_sigma_rad"), 1u);

  writeFileAtomically(steps, "view,position_m\nb0_0,here\n");
  const test::Outcome bad = test::run({"calibrate", "--detections", corners, "--size", "1280x960",
                                       "--positions", steps, "--out", folder.path() / "no.yaml"});
  EXPECT_EQ(bad.code, 1);
  EXPECT_THAT(bad.err, AllOf(HasSubstr("steps.csv"), HasSubstr("line 2, column position_m")));
  EXPECT_FALSE(std::filesystem::exists(folder.path() / "no.yaml"));
  EXPECT_EQ(test::run({"calibrate", "--detections", corners, "--size", "1280x960", "--positions",
                       steps, "--procedure", "quadric"})
                .code,
            2);
}

}  // namespace
}  // namespace omnister
