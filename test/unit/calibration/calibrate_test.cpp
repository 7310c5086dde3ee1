// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/calibrate.h"

#include <gmock/gmock.h>

#include <filesystem>

#include "full_tests.h"
#include "omnister/calibration/uncertainty.h"
#include "omnister/common/error.h"
#include "synthetic_boards.h"

namespace omnister {
namespace {

using test::BoardScene;
using test::fullTests;
using test::wideLens;
using test::wideScene;
using ::testing::HasSubstr;

constexpr double kDegree = M_PI / 180.0;

LensStructure sameStructure(const LensModel& lens) { return structureOf(lens); }

CalibrationOptions exactly(const LensModel& lens) {
  CalibrationOptions options;
  options.structure = sameStructure(lens);
  return options;
}

std::string refusal(const Detections& detections, const CalibrationOptions& options = {}) {
  try {
    calibrate(detections, options);
  } catch (const Error& error) {
    return error.what();
  }
  return "accepted";
}

/// Distance of the projections of two lenses, pixel by pixel over the field, without any alignment.
struct LensError {
  double rms = 0.0;
  double max = 0.0;
  int count = 0;
};
LensError compare(const LensModel& truth, const LensModel& found, double max_theta) {
  LensError error;
  for (int ring = 1; ring <= 40; ++ring) {
    for (int step = 0; step < 36; ++step) {
      const double theta = max_theta * ring / 40.0;
      const double azimuth = 10.0 * kDegree * step;
      const Eigen::Vector3d ray(std::sin(theta) * std::cos(azimuth),
                                std::sin(theta) * std::sin(azimuth), std::cos(theta));
      const auto a = truth.project(ray);
      const auto b = found.project(ray);
      if (!a || !b) continue;
      const double distance = (*a - *b).norm();
      error.rms += distance * distance;
      error.max = std::max(error.max, distance);
      ++error.count;
    }
  }
  error.rms = std::sqrt(error.rms / error.count);
  return error;
}

TEST(Calibrate, FindsAnyLensExactlyWithoutNoiseAndWithoutFocalGuess) {
  struct Truth {
    const char* model;
    std::map<std::string, std::vector<double>> numbers;
    double degrees;
  };
  const std::vector<Truth> truths = {
      {"conic", {{"f", {900.0}}, {"alpha", {0.1}}, {"beta", {1.0}}}, 38},  // nearly perspective
      {"conic",
       {{"f", {450.0}}, {"alpha", {0.6}}, {"beta", {1.1}}, {"p", {0.004}}, {"q", {-0.002}}},
       70},
      {"quadric", {{"R0", {300.0}}, {"a", {34.0}}, {"b", {35.0}}}, 80},
      {"spherical", {{"R", {520.0}}}, 70},
      {"asphere",
       {{"f", {285.0}}, {"alpha", {0.66}}, {"beta", {1.05}}, {"a4", {0.02}}, {"a6", {0.003}}},
       95},
      {"conic", {{"f", {200.0}}, {"alpha", {0.62}}, {"beta", {1.1}}}, 115},  // 230 degrees
  };
  for (const Truth& truth : truths) {
    SCOPED_TRACE(std::string(truth.model) + " of " + std::to_string(truth.degrees));
    const LensPtr lens =
        makeLens(truth.model, {652.0, 470.0}, truth.numbers, truth.degrees * kDegree, "test");
    BoardScene scene = wideScene(3, 0.0);
    if (truth.degrees < 60) scene.least_distance = 0.4, scene.largest_distance = 1.2;
    const Detections detections = test::simulatedBoards(*lens, scene);
    ASSERT_EQ(static_cast<int>(detections.views.size()), scene.views);
    const CalibrationResult result = calibrate(detections, exactly(*lens));
    EXPECT_LT(result.rms_px, 1e-4);
    const LensError error = compare(*lens, *result.file.lens, 0.9 * truth.degrees * kDegree);
    EXPECT_GT(error.count, 1000);
    EXPECT_LT(error.max, 1e-3);
    EXPECT_LT(error.rms, 1e-4);
  }
}

TEST(Calibrate, NoiseIsCarriedIntoTheCovariance) {
  const LensPtr truth = wideLens();
  const int seeds = fullTests() ? 40 : 12;
  double square_sum = 0.0;
  int count = 0;
  double squares = 0.0;
  for (int seed = 1; seed <= seeds; ++seed) {
    const Detections detections = test::simulatedBoards(*truth, wideScene(100 + seed, 0.1));
    const CalibrationResult result = calibrate(detections, exactly(*truth));
    EXPECT_NEAR(result.rms_px, 0.1 * std::sqrt(2.0), 0.015);
    const LensError error = compare(*truth, *result.file.lens, 93 * kDegree);
    EXPECT_EQ(error.count, 40 * 36) << "seed " << seed;
    // Free board poses leave a small rotation of the camera against a shift of the centre almost
    // open: with it taken out the error is that of the surface.
    EXPECT_LT(error.rms, 0.2) << "seed " << seed;
    const ProjectionField surface =
        projectionDifference(*truth, *result.file.lens, wideScene(0, 0).image_size);
    EXPECT_LT(surface.rms_px, 0.18) << "seed " << seed;
    EXPECT_LT(surface.max_px, 0.25) << "seed " << seed;
    squares += surface.rms_px * surface.rms_px;
    ASSERT_TRUE(result.file.covariance);
    const Eigen::VectorXd difference = result.file.lens->parameters() - truth->parameters();
    for (Eigen::Index i = 0; i < difference.size(); ++i) {
      const double z = difference[i] / std::sqrt((*result.file.covariance)(i, i));
      square_sum += z * z;
      ++count;
    }
  }
  const double z_deviation = std::sqrt(square_sum / count);
  EXPECT_GT(z_deviation, 0.75);
  EXPECT_LT(z_deviation, 1.3);
  EXPECT_LT(std::sqrt(squares / seeds), 0.07);
}

TEST(Calibrate, EverySetOfTwentyBoardsConvergesWhateverTheStructure) {
  const LensPtr truth = wideLens();
  const int seeds = fullTests() ? 20 : 4;
  double squares = 0.0;
  for (int seed = 1; seed <= seeds; ++seed) {
    const BoardScene scene = wideScene(static_cast<unsigned>(seed), 0.1);
    const CalibrationResult result = calibrate(test::simulatedBoards(*truth, scene), {});
    const ProjectionField error = projectionDifference(*truth, *result.file.lens, scene.image_size);
    EXPECT_LT(error.max_px, 0.2) << "seed " << seed;
    squares += error.rms_px * error.rms_px;
  }
  // As good as the corners allow: the covariance predicts 0.05 px.
  EXPECT_LT(std::sqrt(squares / seeds), 0.06);
}

TEST(Calibrate, OutliersHardlyMatter) {
  const LensPtr truth = wideLens();
  BoardScene scene = wideScene(7, 0.1);
  const CalibrationResult clean = calibrate(test::simulatedBoards(*truth, scene), exactly(*truth));
  scene.outliers = 0.05;
  const CalibrationResult dirty = calibrate(test::simulatedBoards(*truth, scene), exactly(*truth));
  EXPECT_GT(dirty.rms_px, 3.0);  // all corners count in the figure
  const LensError clean_error = compare(*truth, *clean.file.lens, 90 * kDegree);
  const LensError error = compare(*truth, *dirty.file.lens, 90 * kDegree);
  EXPECT_GT(error.count, 1000);
  EXPECT_LT(error.rms, clean_error.rms + 0.05);
  EXPECT_THAT(dirty.warnings, ::testing::Contains(HasSubstr("hardly count")));
}

TEST(Calibrate, FindsTheBendOfTheBoard) {
  const LensPtr truth = wideLens();
  BoardScene scene = wideScene(11, 0.05);
  scene.warp = {0.001, -0.0006};
  const Detections detections = test::simulatedBoards(*truth, scene);
  const CalibrationResult bent = calibrate(detections, exactly(*truth));
  // Seen from the other side of z the sign would turn; the board's own frame is kept here.
  EXPECT_NEAR(bent.board_warp[0], 0.001, 1e-4);
  EXPECT_NEAR(bent.board_warp[1], -0.0006, 1e-4);
  CalibrationOptions flat = exactly(*truth);
  flat.board_warp = false;
  EXPECT_GT(calibrate(detections, flat).rms_px, 1.5 * bent.rms_px);
}

TEST(Calibrate, AutoChoosesByHeldOutErrorAndSaysSo) {
  const LensPtr truth =
      makeLens("conic", {645.3, 473.1}, {{"f", {285.0}}, {"alpha", {0.64}}, {"beta", {1.08}}},
               95 * kDegree, "test");
  CalibrationOptions options;
  options.folds = 5;
  const CalibrationResult result =
      calibrate(test::simulatedBoards(*truth, wideScene(5, 0.1)), options);
  ASSERT_TRUE(result.holdout_rms_px);
  EXPECT_GE(result.candidates.size(), 8u);
  int chosen = 0;
  double least = HUGE_VAL;
  for (const CandidateResult& candidate : result.candidates) {
    chosen += candidate.chosen;
    ASSERT_TRUE(candidate.holdout_rms_px);
    least = std::min(least, *candidate.holdout_rms_px);
    if (candidate.chosen) {
      EXPECT_EQ(*candidate.holdout_rms_px, *result.holdout_rms_px);
    }
  }
  EXPECT_EQ(chosen, 1);
  EXPECT_LE(*result.holdout_rms_px, 1.004 * least);
  EXPECT_LT(*result.holdout_rms_px, 0.17);
  EXPECT_LT(compare(*truth, *result.file.lens, 92 * kDegree).rms, 0.1);
}

TEST(Calibrate, AGridSaysWhatNoRadialSurfaceCan) {
  const LensPtr truth = test::bentLens();
  ASSERT_NE(truth, nullptr);
  const Detections detections = test::simulatedBoards(*truth, test::bentScene(44));
  const CalibrationResult result = calibrate(detections, {});
  EXPECT_GT(result.points, 3000);
  EXPECT_GT(structureOf(*result.file.lens).grid, 0);
  const ProjectionField error =
      projectionDifference(*truth, *result.file.lens, detections.image_size);
  EXPECT_LT(error.rms_px, 0.05);
  EXPECT_LT(error.max_px, 0.25);
  EXPECT_NEAR(result.rms_px, 0.14, 0.01);
  CalibrationOptions radial;
  radial.model = "asphere";
  const CalibrationResult without = calibrate(detections, radial);
  EXPECT_GT(projectionDifference(*truth, *without.file.lens, detections.image_size).rms_px, 0.15);

  // Into a lens file and back; the square of the grid's size is left out.
  const LensFile file = parseLensFile(formatLensFile(result.file), "grid.yaml");
  EXPECT_EQ(file.lens->parameters(), result.file.lens->parameters());
  EXPECT_FALSE(file.covariance);
  EXPECT_TRUE(file.calibration.notes.count("uncertainty_rms_px"));
}

TEST(Calibrate, SameNumbersWithAnyNumberOfThreads) {
  const LensPtr truth = wideLens();
  BoardScene scene = wideScene(13, 0.1);
  scene.views = 12;
  const Detections detections = test::simulatedBoards(*truth, scene);
  CalibrationOptions options;
  options.folds = 4;
  options.threads = 1;
  const CalibrationResult one = calibrate(detections, options);
  options.threads = 4;
  const CalibrationResult four = calibrate(detections, options);
  EXPECT_EQ(one.file.lens->parameters(), four.file.lens->parameters());
  EXPECT_EQ(*one.holdout_rms_px, *four.holdout_rms_px);
}

TEST(Calibrate, AnyUnitAndAnyAxesOfTheBoard) {
  const LensPtr truth = wideLens();
  Detections detections = test::simulatedBoards(*truth, wideScene(17, 0.0));
  for (ViewDetections& view : detections.views) {
    // Squares as the unit, axes swapped: a mirrored board for every view alike.
    for (Eigen::Vector3d& point : view.points) {
      point = Eigen::Vector3d(point.y() / 0.03, point.x() / 0.03, 0.0);
    }
  }
  const CalibrationResult result = calibrate(detections, exactly(*truth));
  EXPECT_LT(compare(*truth, *result.file.lens, 90 * kDegree).max, 1e-3);
  for (const ViewResult& view : result.views) EXPECT_TRUE(view.used) << view.reason;
}

TEST(Calibrate, BadViewsAreLeftOutByName) {
  const LensPtr truth = wideLens();
  Detections detections = test::simulatedBoards(*truth, wideScene(19, 0.1));
  detections.views[2] = detections.views[1];
  detections.views[2].name = "twin";
  detections.views[4].name = "mirrored";
  for (auto& point : detections.views[4].points) point.x() = 0.21 - point.x();
  detections.views[6].name = "shuffled";
  std::mt19937 random(1);
  std::shuffle(detections.views[6].points.begin(), detections.views[6].points.end(), random);
  detections.views[8].name = "few";
  detections.views[8].pixels.resize(3);
  detections.views[8].points.resize(3);
  const CalibrationResult result = calibrate(detections, exactly(*truth));
  EXPECT_FALSE(result.views[2].used);
  EXPECT_THAT(result.views[2].reason, HasSubstr("board1"));
  EXPECT_FALSE(result.views[4].used);
  EXPECT_THAT(result.views[4].reason, HasSubstr("mirrored"));
  EXPECT_FALSE(result.views[6].used);
  EXPECT_FALSE(result.views[8].used);
  EXPECT_THAT(result.views[8].reason, HasSubstr("3 corners"));
  int used = 0;
  for (const ViewResult& view : result.views) used += view.used;
  EXPECT_EQ(used, 16);
  EXPECT_LT(compare(*truth, *result.file.lens, 90 * kDegree).rms, 0.1);
  EXPECT_THAT(result.warnings, ::testing::Contains(HasSubstr("'shuffled' is not used")));
}

TEST(Calibrate, RefusesWithTheReason) {
  const LensPtr truth = wideLens();
  BoardScene scene = wideScene(23, 0.1);
  Detections detections = test::simulatedBoards(*truth, scene);
  Detections few = detections;
  few.views.resize(2);
  EXPECT_THAT(refusal(few), HasSubstr("at least 3"));
  Detections copies = detections;
  for (ViewDetections& view : copies.views) {
    view.pixels = detections.views[0].pixels;
    view.points = detections.views[0].points;
  }
  EXPECT_THAT(refusal(copies), HasSubstr("same corners"));
  Detections line = detections;
  for (ViewDetections& view : line.views) {
    for (auto& point : view.points) point.y() = 0.0;
  }
  EXPECT_THAT(refusal(line), HasSubstr("one line"));
  Detections noise = detections;
  std::mt19937 random(3);
  for (ViewDetections& view : noise.views)
    std::shuffle(view.pixels.begin(), view.pixels.end(), random);
  EXPECT_NE(refusal(noise), "accepted");
  Detections infinite = detections;
  infinite.views[0].pixels[0].x() = std::nan("");
  EXPECT_THAT(refusal(infinite), HasSubstr("not finite"));
  CalibrationOptions unknown;
  unknown.model = "fisheye";
  EXPECT_THAT(refusal(detections, unknown), HasSubstr("unknown lens model"));
  EXPECT_THAT(refusal(Detections{}), HasSubstr("size"));
}

TEST(Calibrate, RefusesBoardsSquareToTheAxis) {
  const LensPtr truth = wideLens();
  for (const double noise : {0.0, 0.1}) {
    BoardScene scene = wideScene(29, noise);
    std::mt19937 random(scene.seed);
    std::uniform_real_distribution<double> unit(-1.0, 1.0);
    Detections detections;
    detections.image_size = scene.image_size;
    for (int i = 0; i < 15; ++i) {
      Pose pose = Pose::Identity();
      pose.translation() << 0.1 * unit(random) - 0.1, 0.1 * unit(random) - 0.08,
          0.2 + 0.05 * unit(random);
      detections.views.push_back(
          test::seenBoard(*truth, scene, pose, "board" + std::to_string(i), random));
    }
    for (const char* model : {"auto", "conic", "asphere"}) {
      CalibrationOptions options;
      options.model = model;
      EXPECT_THAT(refusal(detections, options), HasSubstr("square to the optical axis")) << noise;
    }
  }
}

TEST(ProjectionUncertainty, PredictsTheScatterOfTheFits) {
  const LensPtr truth = wideLens();
  double squares = 0.0;
  double predicted = 0.0;
  const int seeds = 10;
  for (int seed = 0; seed < seeds; ++seed) {
    const Detections detections = test::simulatedBoards(*truth, wideScene(200 + seed, 0.1));
    const CalibrationResult result = calibrate(detections, exactly(*truth));
    const double difference =
        projectionDifference(*result.file.lens, *truth, detections.image_size).rms_px;
    squares += difference * difference;
    const double sigma =
        projectionUncertainty(*result.file.lens, *result.file.covariance, detections.image_size)
            .rms_px;
    predicted += sigma * sigma;
  }
  EXPECT_GT(std::sqrt(squares / predicted), 0.6);
  EXPECT_LT(std::sqrt(squares / predicted), 1.5);
}

class RealCorners : public ::testing::Test {
 protected:
  Detections read(const char* name, cv::Size size) {
    const std::filesystem::path path =
        std::filesystem::path(OMNISTER_SOURCE_DIR) / "../shared/data/detections" / name;
    if (!std::filesystem::exists(path)) return {};
    return readDetections(path, size);
  }
};

TEST_F(RealCorners, PredictedBetterThanByItsPeers) {
  const Detections jy = read("opencv_jy_left.csv", {1280, 800});
  const Detections theta = read("boofcv_theta.csv", {640, 720});
  if (jy.views.empty() || theta.views.empty()) GTEST_SKIP() << "the shared data is absent";
  CalibrationOptions options;
  options.folds = 5;
  const CalibrationResult narrow = calibrate(jy, options);
  EXPECT_EQ(narrow.points, 34 * 48);
  EXPECT_LE(*narrow.holdout_rms_px, 0.224);
  const CalibrationResult wide = calibrate(theta, options);
  EXPECT_EQ(wide.points, 26 * 24);
  EXPECT_LE(*wide.holdout_rms_px, 0.230);
  EXPECT_GT(wide.file.lens->maxTheta(), 90 * kDegree);
}

}  // namespace
}  // namespace omnister
