// SPDX-License-Identifier: Apache-2.0
// The second detection, guided by the lens that the first one gave.
#include "omnister/calibration/guided_pass.h"

#include <gmock/gmock.h>

#include <nlohmann/json.hpp>
#include <opencv2/imgcodecs.hpp>

#include "command_run.h"
#include "omnister/common/file_io.h"
#include "omnister/lens/lens_file.h"
#include "rendered_boards.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

const cv::Size kSize(640, 480);

double worstError(const ViewDetections& view, const LensModel& lens, const Pose& pose) {
  double worst = 0.0;
  for (std::size_t i = 0; i < view.pixels.size(); ++i) {
    const auto truth = lens.project(pose * view.points[i]);
    worst = std::max(worst, truth ? (*truth - view.pixels[i]).norm() : HUGE_VAL);
  }
  return worst;
}

TEST(GuidedPass, FindsBoardsThatTheFirstPassDidNotSee) {
  const test::TemporaryFolder folder;
  const LensPtr lens = test::wideLens(kSize);
  const Target target = parseTarget("{type: checkerboard, cols: 8, rows: 5, square_m: 0.03}", "t");
  const std::vector<test::Placement> placements{{10, 30, 0.3, 25, 20}, {15, 200, 0.28, -20, 10}};
  std::vector<std::string> files;
  std::vector<Pose> poses;
  Detections first;
  first.image_size = kSize;
  for (const test::Placement& placement : placements) {
    poses.push_back(test::boardPose(target, placement));
    const cv::Mat image = test::draw(target, poses.back(), *lens, kSize);
    files.push_back(folder.path() / (std::to_string(files.size()) + ".png"));
    ASSERT_TRUE(cv::imwrite(files.back(), image));
    // What the detector finds in the first, and nothing in the others.
    if (files.size() > 1) continue;
    auto view = detectTarget(image, target);
    ASSERT_TRUE(view);
    view->name = files.back();
    view->stage = StagePosition{0.25, "here"};
    first.views.push_back(*view);
  }
  // Time enough, so that no slow machine sees less.
  const GuidedPass pass = detectGuided(files, target, *lens, first, {60.0, 1});
  ASSERT_EQ(pass.detections.views.size(), 2u);
  EXPECT_EQ(pass.views_added, 1);
  EXPECT_EQ(pass.corners_before, 40);
  EXPECT_EQ(pass.corners_after, 80);
  EXPECT_THAT(pass.missed, ::testing::IsEmpty());
  EXPECT_EQ(pass.detections.views[0].stage->position_m, 0.25);
  EXPECT_EQ(pass.detections.views[1].name, files[1]);
  for (std::size_t i = 0; i < 2; ++i) {
    EXPECT_LT(worstError(pass.detections.views[i], *lens, poses[i]), 0.3) << i;
  }
}

class GuidedPassCommand : public ::testing::Test {
 protected:
  void SetUp() override {
    writeFileAtomically(folder_.path() / "target.yaml", formatTarget(target_));
  }

  /// Images of the board by a camera of the rig.
  std::vector<std::string> drawn(const std::string& side, const Pose& T_camera_rig) {
    const std::vector<test::Placement> placements{{12, 30, 0.3, 35, 20},  {35, 110, 0.3, -30, 100},
                                                  {45, 200, 0.3, 30, 10}, {40, 300, 0.3, 25, 75},
                                                  {60, 20, 0.3, -30, 40}, {20, 250, 0.3, -35, 60}};
    std::vector<std::string> files;
    for (std::size_t i = 0; i < placements.size(); ++i) {
      files.push_back(folder_.path() / (side + std::to_string(i) + ".png"));
      const Pose pose = T_camera_rig * test::boardPose(target_, placements[i]);
      EXPECT_TRUE(cv::imwrite(files.back(), test::draw(target_, pose, *lens_, kSize)));
    }
    return files;
  }

  nlohmann::json json(std::vector<std::string> arguments, const std::vector<std::string>& more) {
    for (const char* word : {"--model", "conic", "--json", "--target"}) arguments.push_back(word);
    arguments.push_back(folder_.path() / "target.yaml");
    arguments.insert(arguments.end(), more.begin(), more.end());
    const test::Outcome outcome = test::run(arguments);
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    return nlohmann::json::parse(outcome.out, nullptr, false);
  }

  test::TemporaryFolder folder_;
  LensPtr lens_ = test::wideLens(kSize);
  Target target_ =
      parseTarget("{type: aprilgrid, cols: 4, rows: 4, square_m: 0.05, spacing: 0.3}", "t");
};

TEST_F(GuidedPassCommand, TellsWhatItGained) {
  const auto files = drawn("image", Pose::Identity());
  std::vector<std::string> arguments = {"calibrate"};
  arguments.insert(arguments.end(), files.begin(), files.end());
  const auto guided = json(arguments, {});
  const auto plain = json(arguments, {"--one-pass"});
  EXPECT_FALSE(plain.contains("second_pass"));
  const auto& pass = guided["second_pass"];
  EXPECT_EQ(pass["kept"], true);
  EXPECT_EQ(pass["views_added"], 0);
  EXPECT_EQ(pass["corners_before"], plain["points"]);
  EXPECT_EQ(pass["corners_after"], guided["points"]);
  EXPECT_LT(guided["rms_px"], 0.1);
}

TEST_F(GuidedPassCommand, OfTwoCamerasToo) {
  Pose T_right_left = Pose::Identity();
  T_right_left.translation() << -0.06, 0.003, 0.002;
  std::vector<std::string> arguments = {"calibrate-stereo", "--left"};
  for (const std::string& file : drawn("left", Pose::Identity())) arguments.push_back(file);
  arguments.push_back("--right");
  for (const std::string& file : drawn("right", T_right_left)) arguments.push_back(file);
  const auto guided = json(arguments, {});
  const auto plain = json(arguments, {"--one-pass"});
  EXPECT_FALSE(plain.contains("second_pass"));
  SCOPED_TRACE(guided.dump() + plain.dump());
  const auto& pass = guided["second_pass"];
  const bool kept = pass["left"]["kept"];
  int before = 0;
  int after = 0;
  for (const char* side : {"left", "right"}) {
    EXPECT_EQ(pass[side]["kept"], kept);
    EXPECT_EQ(pass[side]["views_added"], 0);
    before += pass[side]["corners_before"].get<int>();
    after += pass[side]["corners_after"].get<int>();
  }
  EXPECT_EQ(plain["points"], before);
  // Kept or not, the result is that of the corners it tells of.
  EXPECT_EQ(guided["points"], kept ? after : before);
  if (!kept) {
    EXPECT_EQ(guided["pose"], plain["pose"]);
  }
  EXPECT_LE(guided["rms_px"], 1.15 * plain["rms_px"].get<double>());
  EXPECT_NEAR(guided["baseline_m"], T_right_left.translation().norm(), 2e-4);
}

TEST(GuidedPass, KeepsOnlyWhatServesTheFit) {
  const auto result = [](int points, double residual, double outlier) {
    CalibrationResult result;
    ViewResult& view = result.views.emplace_back();
    view.residuals.assign(static_cast<std::size_t>(points), Eigen::Vector2d(residual, 0.0));
    view.residuals[0].x() = outlier;
    result.points = points;
    result.rms_px = std::sqrt((residual * residual * (points - 1) + outlier * outlier) / points);
    return result;
  };
  const CalibrationResult first = result(100, 0.2, 0.2);
  EXPECT_FALSE(servesBetter(first, first));
  EXPECT_TRUE(servesBetter(first, result(100, 0.15, 0.2)));
  EXPECT_TRUE(servesBetter(first, result(120, 0.2, 0.2)));
  EXPECT_FALSE(servesBetter(first, result(80, 0.19, 0.2)));
  EXPECT_FALSE(servesBetter(first, result(120, 0.2, 5.0)));
}

}  // namespace
}  // namespace omnister
