// SPDX-License-Identifier: Apache-2.0
// What cannot carry a calibration is refused by the command, with the reason and without a lens.
#include <gmock/gmock.h>

#include <nlohmann/json.hpp>
#include <opencv2/imgcodecs.hpp>

#include "command_run.h"
#include "omnister/calibration/detections.h"
#include "omnister/common/file_io.h"
#include "rendered_boards.h"
#include "synthetic_boards.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::Not;

constexpr double kDegree = M_PI / 180.0;

class CalibrateRefusals : public ::testing::Test {
 protected:
  /// Boards all tilted by one angle, their middles at most `spread` off the axis.
  Detections boards(double tilt, double spread, int views = 12) {
    std::mt19937 random(4);
    std::uniform_real_distribution<double> unit(-1.0, 1.0);
    test::BoardScene scene;
    scene.noise_px = 0.2;
    Detections detections;
    detections.image_size = scene.image_size;
    for (int i = 0; i < views; ++i) {
      Pose pose = Pose::Identity();
      pose.linear() = (Eigen::AngleAxisd(0.5 * i, Eigen::Vector3d::UnitZ()) *
                       Eigen::AngleAxisd(tilt, Eigen::Vector3d::UnitX()))
                          .toRotationMatrix();
      pose.translation() =
          Eigen::Vector3d(spread * unit(random), spread * unit(random), 0.2 + 0.05 * unit(random)) -
          pose.linear() * Eigen::Vector3d(0.105, 0.075, 0.0);
      detections.views.push_back(
          test::seenBoard(*lens_, scene, pose, "board" + std::to_string(i), random));
    }
    return detections;
  }

  test::Outcome calibrate(const Detections& detections, std::vector<std::string> more = {}) {
    const std::string corners = folder_.path() / "corners.csv";
    writeFileAtomically(corners, formatDetections(detections));
    std::vector<std::string> arguments = {"calibrate", "--detections", corners,    "--size",
                                          "1280x960",  "--out",        lens_file_, "--json"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return test::run(arguments);
  }

  void expectRefused(const test::Outcome& outcome, const std::string& reason) {
    EXPECT_EQ(outcome.code, 1);
    EXPECT_EQ(outcome.out, "");
    // The last line, whatever progress a slow machine told before.
    ASSERT_FALSE(outcome.err.empty());
    const std::size_t last = outcome.err.rfind('\n', outcome.err.size() - 2);
    EXPECT_THAT(outcome.err.substr(last == std::string::npos ? 0 : last + 1), HasSubstr(reason));
    EXPECT_FALSE(std::filesystem::exists(lens_file_));
  }

  test::TemporaryFolder folder_;
  std::string lens_file_ = folder_.path() / "lens.yaml";
  LensPtr lens_ = makeLens("conic", {645.0, 473.0},
                           {{"f", {285.0}}, {"alpha", {0.64}}, {"beta", {1.08}}}, 1.6, "test");
};

TEST_F(CalibrateRefusals, TooLittleTilt) {
  const std::string reason = "square to the optical axis";
  expectRefused(calibrate(boards(0.0, 0.1)), reason);
  expectRefused(calibrate(boards(2 * kDegree, 0.1)), reason);
  EXPECT_EQ(calibrate(boards(30 * kDegree, 0.1)).code, 0);
}

TEST_F(CalibrateRefusals, TooFewOrAlikeOrMirroredViews) {
  expectRefused(calibrate(boards(0.5, 0.1, 2)), "at least 3 different views");
  Detections alike = boards(0.5, 0.1, 6);
  for (ViewDetections& view : alike.views) {
    view.pixels = alike.views[0].pixels;
    view.points = alike.views[0].points;
  }
  expectRefused(calibrate(alike), "the same corners as view 'board0'");
  Detections mirrored = boards(0.5, 0.1);
  for (Eigen::Vector3d& point : mirrored.views[3].points) point.x() = 0.21 - point.x();
  const test::Outcome outcome = calibrate(mirrored);
  EXPECT_EQ(outcome.code, 0);
  EXPECT_THAT(outcome.err, AllOf(HasSubstr("'board3' is not used"), HasSubstr("mirrored")));
  EXPECT_EQ(nlohmann::json::parse(outcome.out)["views_used"], 11);
}

TEST_F(CalibrateRefusals, CornersThatNoLensExplains) {
  Detections shuffled = boards(0.5, 0.1);
  std::mt19937 random(1);
  for (ViewDetections& view : shuffled.views) {
    std::shuffle(view.points.begin(), view.points.end(), random);
  }
  const test::Outcome outcome = calibrate(shuffled);
  EXPECT_EQ(outcome.code, 1);
  EXPECT_FALSE(std::filesystem::exists(lens_file_));
}

TEST_F(CalibrateRefusals, ABadViewIsNamed) {
  Detections detections = boards(0.5, 0.1);
  std::mt19937 random(1);
  std::normal_distribution<double> noise(0.0, 3.0);
  for (Eigen::Vector2d& pixel : detections.views[7].pixels) {
    pixel += Eigen::Vector2d(noise(random), noise(random));
  }
  detections.views[2].pixels[5].x() += 15.0;
  const test::Outcome outcome = calibrate(detections);
  EXPECT_EQ(outcome.code, 0) << outcome.err;
  EXPECT_THAT(outcome.err, AllOf(HasSubstr("'board7'"), HasSubstr("'board2' (1)")));
  EXPECT_THAT(outcome.err, Not(HasSubstr("'board3'")));
}

TEST_F(CalibrateRefusals, MoreFoldsThanViewsAndPathsThatCannotBeWritten) {
  const Detections good = boards(0.5, 0.1);
  expectRefused(calibrate(good, {"--folds", "13"}), "13 folds of 12 views");
  writeFileAtomically(folder_.path() / "file", "x");
  expectRefused(calibrate(good, {"--report", folder_.path() / "file" / "report"}), "is no folder");
}

TEST_F(CalibrateRefusals, UncertaintyAtDepthAndBiasAreTold) {
  const test::Outcome outcome = calibrate(boards(0.5, 0.1));
  ASSERT_EQ(outcome.code, 0);
  const auto json = nlohmann::json::parse(outcome.out);
  const auto& depths = json["uncertainty_at_depth"];
  ASSERT_EQ(depths.size(), 4u);
  EXPECT_NEAR(depths[0]["distance_m"], 0.2, 0.05);
  EXPECT_TRUE(depths[3]["distance_m"].is_null());
  // Known best where the boards were.
  EXPECT_LT(depths[0]["rms_px"], depths[2]["rms_px"]);
  EXPECT_LT(depths[0]["rms_px"], json["uncertainty_rms_px"]);
  EXPECT_TRUE(json["bias_rms_px"].is_number());
  EXPECT_THAT(json["bias_against"].get<std::string>(), HasSubstr("asphere"));
}

TEST_F(CalibrateRefusals, ImagesOfDifferentSizeAndAnotherBoard) {
  const std::string target = folder_.path() / "target.yaml";
  const std::string small = folder_.path() / "small.png";
  const std::string large = folder_.path() / "large.png";
  ASSERT_TRUE(cv::imwrite(small, cv::Mat(cv::Size(40, 30), CV_8U, cv::Scalar(90))));
  ASSERT_TRUE(cv::imwrite(large, cv::Mat(cv::Size(44, 30), CV_8U, cv::Scalar(90))));
  writeFileAtomically(target, "{type: checkerboard, cols: 9, rows: 6, square_m: 0.03}\n");
  const test::Outcome sizes =
      test::run({"calibrate", "--target", target, small, large, "--out", lens_file_});
  EXPECT_EQ(sizes.code, 1);
  EXPECT_THAT(sizes.err, AllOf(HasSubstr("large.png"), HasSubstr("is 44x30 pixels"),
                               HasSubstr("expected 40x30 as"), HasSubstr("small.png")));
}

TEST_F(CalibrateRefusals, AnotherBoardIsNamedByItsSize) {
  const cv::Size size(640, 480);
  const LensPtr lens = test::wideLens(size);
  struct Case {
    Target shown;
    int cols, rows;  ///< that the target file asks for
    std::string says;
  };
  Target charuco{TargetType::kCharuco, 7, 5, 0.03};
  charuco.marker_m = 0.022;
  charuco.dictionary = "DICT_4X4_50";
  Target tags{TargetType::kAprilGrid, 5, 4, 0.03};
  tags.spacing = 0.3;
  tags.dictionary = "tag36h11";
  const Target dots{TargetType::kCircles, 7, 6, 0.03};
  Target shifted{TargetType::kCircles, 4, 9, 0.03};
  shifted.asymmetric = true;
  const Target squares{TargetType::kCheckerboard, 8, 5, 0.03};
  const std::vector<Case> cases = {{squares, 9, 6, "8 x 5 inner corners"},
                                   {charuco, 5, 7, "7 x 5 squares"},
                                   {charuco, 8, 6, "7 x 5 squares"},
                                   {tags, 4, 5, "5 x 4 tags"},
                                   {tags, 6, 6, "5 x 4 tags"},
                                   {dots, 8, 6, "7 x 6 dots"},
                                   {dots, 6, 5, "7 x 6 dots"},
                                   {shifted, 4, 11, "4 x 9 dots"}};
  const std::string target = folder_.path() / "target.yaml";
  for (const Case& c : cases) {
    Target asked = c.shown;
    asked.cols = c.cols;
    asked.rows = c.rows;
    SCOPED_TRACE(formatTarget(asked));
    writeFileAtomically(target, formatTarget(asked));
    const std::string board = folder_.path() / "board.png";
    ASSERT_TRUE(cv::imwrite(
        board, test::draw(c.shown, test::boardPose(c.shown, {10, 30, 0.25, 20, 10}), *lens, size)));
    const test::Outcome outcome =
        test::run({"calibrate", "--target", target, board, "--out", lens_file_});
    EXPECT_EQ(outcome.code, 1);
    EXPECT_THAT(outcome.err,
                AllOf(HasSubstr("target.yaml"),
                      HasSubstr("are " + std::to_string(c.cols) + " and " + std::to_string(c.rows)),
                      HasSubstr("board.png shows a board of " + c.says)));
    EXPECT_FALSE(std::filesystem::exists(lens_file_));
    // The right file is not refused for its size.
    writeFileAtomically(target, formatTarget(c.shown));
    const test::Outcome right =
        test::run({"calibrate", "--target", target, board, "--out", lens_file_});
    EXPECT_THAT(right.err, AllOf(HasSubstr("at least 3 different views"), HasSubstr("1 of 1")));
  }
}

}  // namespace
}  // namespace omnister
