// SPDX-License-Identifier: Apache-2.0
#include <gmock/gmock.h>

#include <filesystem>

#include "omnister/calibration/calibrate.h"
#include "omnister/calibration/rig_file.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "synthetic_boards.h"

namespace omnister {
namespace {

using test::BoardScene;
using ::testing::HasSubstr;

struct StereoScene {
  LensPtr left = makeLens("conic", {645.0, 473.0},
                          {{"f", {285.0}}, {"alpha", {0.64}}, {"beta", {1.08}}}, 1.5, "test");
  LensPtr right = makeLens("conic", {630.0, 485.0},
                           {{"f", {292.0}}, {"alpha", {0.6}}, {"beta", {1.1}}}, 1.5, "test");
  Pose T_left_right = Pose::Identity();
  Detections seen_left, seen_right;

  explicit StereoScene(double noise_px, int views = 16) {
    T_left_right.linear() = (Eigen::AngleAxisd(0.05, Eigen::Vector3d::UnitY()) *
                             Eigen::AngleAxisd(-0.02, Eigen::Vector3d::UnitX()))
                                .toRotationMatrix();
    T_left_right.translation() << 0.1, 0.004, -0.003;
    BoardScene scene;
    scene.noise_px = noise_px;
    scene.least_distance = 0.15;
    scene.largest_distance = 0.35;
    seen_left.image_size = seen_right.image_size = scene.image_size;
    std::mt19937 random_pose(5);
    std::mt19937 random(6);
    while (static_cast<int>(seen_left.views.size()) < views) {
      const Pose pose = test::randomBoardPose(scene, 1.2, random_pose);
      const std::string name = std::to_string(seen_left.views.size());
      auto l = test::seenBoard(*left, scene, pose, name, random);
      auto r = test::seenBoard(*right, scene, T_left_right.inverse() * pose, name, random);
      if (l.pixels.size() < 30 || r.pixels.size() < 30) continue;
      seen_left.views.push_back(std::move(l));
      seen_right.views.push_back(std::move(r));
    }
  }

  CalibrationOptions options() const {
    CalibrationOptions options;
    options.structure = structureOf(*left);
    return options;
  }
};

std::string refusal(const Detections& left, const Detections& right,
                    const CalibrationOptions& options) {
  try {
    calibrateStereo(left, right, options);
  } catch (const Error& error) {
    return error.what();
  }
  return "accepted";
}

double angleBetween(const Pose& a, const Pose& b) {
  return Eigen::AngleAxisd(a.linear().transpose() * b.linear()).angle();
}

TEST(CalibrateStereo, FindsThePoseBetweenTheCameras) {
  const StereoScene exact(0.0);
  const StereoCalibrationResult clean =
      calibrateStereo(exact.seen_left, exact.seen_right, exact.options());
  EXPECT_LT(clean.rms_px, 1e-4);
  EXPECT_LT((clean.T_left_right.translation() - exact.T_left_right.translation()).norm(), 1e-6);
  EXPECT_LT(angleBetween(clean.T_left_right, exact.T_left_right), 1e-6);
  EXPECT_EQ(clean.left.file.camera_name, "left");

  const StereoScene noisy(0.1);
  const StereoCalibrationResult result =
      calibrateStereo(noisy.seen_left, noisy.seen_right, noisy.options());
  EXPECT_NEAR(result.rms_px, 0.141, 0.015);
  EXPECT_LT((result.T_left_right.translation() - noisy.T_left_right.translation()).norm(), 2e-4);
  EXPECT_LT(angleBetween(result.T_left_right, noisy.T_left_right), 1e-3);
  EXPECT_TRUE(result.left.file.covariance && result.right.file.covariance);
}

TEST(CalibrateStereo, PredictsPairsThatItHasNotSeen) {
  const StereoScene scene(0.1);
  CalibrationOptions options = scene.options();
  EXPECT_FALSE(calibrateStereo(scene.seen_left, scene.seen_right, options).holdout_rms_px);
  options.folds = 4;
  const StereoCalibrationResult result =
      calibrateStereo(scene.seen_left, scene.seen_right, options);
  ASSERT_TRUE(result.holdout_rms_px);
  // Noise of 0.1 px either way, a little of which a pose of its own takes up.
  EXPECT_GT(*result.holdout_rms_px, 0.12);
  EXPECT_LT(*result.holdout_rms_px, 0.16);
}

TEST(CalibrateStereo, NamesThePairThatDisagrees) {
  StereoScene scene(0.1);
  // The right camera's image of pair 3 is of another instant: the board had moved by then.
  BoardScene board;
  std::mt19937 random(9);
  const StereoScene other(0.1, 5);
  scene.seen_right.views[3] = other.seen_right.views[4];
  scene.seen_right.views[3].name = "late";
  // And one camera did not see the board at all once.
  scene.seen_left.views[7].pixels.clear();
  scene.seen_left.views[7].points.clear();
  const StereoCalibrationResult result =
      calibrateStereo(scene.seen_left, scene.seen_right, scene.options());
  EXPECT_FALSE(result.left.views[3].used);
  EXPECT_FALSE(result.right.views[3].used);
  EXPECT_FALSE(result.left.views[7].used);
  EXPECT_TRUE(result.right.views[7].used);
  EXPECT_THAT(result.warnings, ::testing::Contains(HasSubstr("'late' is not used")));
  EXPECT_LT((result.T_left_right.translation() - scene.T_left_right.translation()).norm(), 3e-4);
}

TEST(CalibrateStereo, RefusesWithTheReason) {
  const StereoScene scene(0.1, 8);
  Detections fewer = scene.seen_right;
  fewer.views.pop_back();
  EXPECT_THAT(refusal(scene.seen_left, fewer, scene.options()), HasSubstr("expected pairs"));
  Detections bare = scene.seen_right;
  for (std::size_t i = 0; i < 6; ++i) {
    bare.views[i].pixels.clear();
    bare.views[i].points.clear();
  }
  EXPECT_THAT(refusal(scene.seen_left, bare, scene.options()), HasSubstr("right camera"));
  Detections turned = scene.seen_right;
  std::rotate(turned.views.begin(), turned.views.begin() + 3, turned.views.end());
  EXPECT_THAT(refusal(scene.seen_left, turned, scene.options()), HasSubstr("pairs agree"));
}

// Cameras rolled against each other: a board that looks the same turned by a half is numbered from
// another end in the right camera's images, in all of them or in some.
TEST(CalibrateStereo, SymmetricBoardsMayBeNumberedFromEitherEnd) {
  for (const int every : {1, 2, 3}) {
    StereoScene scene(0.1);
    int renumbered = 0;
    for (std::size_t i = 0; i < scene.seen_right.views.size();
         i += static_cast<std::size_t>(every)) {
      ViewDetections& view = scene.seen_right.views[i];
      if (view.points.size() != 48) continue;  // detectors number whole boards alone
      for (Eigen::Vector3d& point : view.points) {
        point = Eigen::Vector3d(7 * 0.03, 5 * 0.03, 0.0) - point;
      }
      ++renumbered;
    }
    EXPECT_GT(renumbered, 3);
    const StereoCalibrationResult result =
        calibrateStereo(scene.seen_left, scene.seen_right, scene.options());
    EXPECT_NEAR(result.rms_px, 0.141, 0.015);
    EXPECT_LT((result.T_left_right.translation() - scene.T_left_right.translation()).norm(), 3e-4);
    EXPECT_LT(angleBetween(result.T_left_right, scene.T_left_right), 1e-3);
    for (const ViewResult& view : result.right.views) EXPECT_TRUE(view.used) << view.reason;
  }
}

TEST(CalibrateStereo, OneCameraTwiceIsNoRig) {
  const StereoScene scene(0.1);
  EXPECT_THAT(refusal(scene.seen_left, scene.seen_left, scene.options()),
              HasSubstr("one camera's images twice"));
  // Stored anew, the corners of copies differ by little.
  Detections copy = scene.seen_left;
  std::mt19937 random(2);
  std::normal_distribution<double> noise(0.0, 0.05);
  for (ViewDetections& view : copy.views) {
    for (Eigen::Vector2d& pixel : view.pixels)
      pixel += Eigen::Vector2d(noise(random), noise(random));
  }
  EXPECT_THAT(refusal(scene.seen_left, copy, scene.options()), HasSubstr("of 16 pairs"));
}

TEST(CalibrateStereo, TheUnitOfTheBoardIsThatOfTheBaseline) {
  StereoScene scene(0.1);
  const StereoCalibrationResult metres =
      calibrateStereo(scene.seen_left, scene.seen_right, scene.options());
  for (Detections* camera : {&scene.seen_left, &scene.seen_right}) {
    for (ViewDetections& view : camera->views) {
      for (Eigen::Vector3d& point : view.points) point *= 1000.0;
    }
  }
  const StereoCalibrationResult millimetres =
      calibrateStereo(scene.seen_left, scene.seen_right, scene.options());
  EXPECT_NEAR(millimetres.T_left_right.translation().norm(),
              1000.0 * metres.T_left_right.translation().norm(), 0.01);
  EXPECT_NEAR(millimetres.right.height_px, metres.right.height_px, 1e-3);
}

TEST(RigFile, ComesBackAndFindsItsLenses) {
  RigFile rig;
  const std::filesystem::path folder =
      std::filesystem::path(::testing::TempDir()) / "omnister rig: \"file\" test";
  std::filesystem::create_directories(folder);
  rig.reference = folder / "left.yaml";
  rig.displaced = folder / "sub" / "right.yaml";
  rig.T_ref_disp.translation() << 0.1, -0.02, 1e-3;
  rig.T_ref_disp.linear() =
      Eigen::AngleAxisd(0.3, Eigen::Vector3d(1, 2, 3).normalized()).toRotationMatrix();
  rig.rms_px = 0.32;
  rig.date = "2026-01-01T00:00:00Z";
  const std::filesystem::path path = folder / "rig.yaml";
  writeRigFile(path, rig);
  EXPECT_THAT(readFile(path), HasSubstr("reference: \"left.yaml\""));
  const RigFile back = readRigFile(path);
  EXPECT_EQ(back.reference, rig.reference);
  EXPECT_EQ(back.displaced, rig.displaced);
  EXPECT_LT((back.T_ref_disp.matrix() - rig.T_ref_disp.matrix()).norm(), 1e-14);
  EXPECT_EQ(*back.rms_px, 0.32);
  EXPECT_EQ(back.date, rig.date);
  std::filesystem::remove_all(folder);
}

TEST(RigFile, RefusesNamingTheKey) {
  const std::string good = formatRigFile([] {
    RigFile rig;
    rig.reference = "a.yaml";
    rig.displaced = "b.yaml";
    rig.T_ref_disp.translation().x() = 0.1;
    return rig;
  }());
  EXPECT_NO_THROW(parseRigFile(good, "x"));
  const auto refusal = [](const std::string& text) -> std::string {
    try {
      parseRigFile(text, "rig.yaml");
    } catch (const InputError& error) {
      return error.what();
    }
    return "accepted";
  };
  const auto with = [&](const std::string& from, const std::string& to) {
    std::string text = good;
    text.replace(text.find(from), from.size(), to);
    return text;
  };
  EXPECT_THAT(refusal(""), HasSubstr("rig"));
  EXPECT_THAT(refusal("rig: 3\n"), HasSubstr("rig"));
  EXPECT_THAT(refusal("rig: [\n"), HasSubstr("not YAML"));
  EXPECT_THAT(refusal(with("version: 1", "version: 2")), HasSubstr("rig.version"));
  EXPECT_THAT(refusal(with("\"a.yaml\"", "\"\"")), HasSubstr("rig.reference"));
  EXPECT_THAT(refusal(with("[0.1,", "[nan,")), HasSubstr("rig.T_ref_disp"));
  EXPECT_THAT(refusal(with("[0.1,", "[")), HasSubstr("7 numbers"));
  EXPECT_THAT(refusal(with("[0.1,", "[0,")), HasSubstr("baseline"));
  EXPECT_THAT(refusal(with("0, 1]", "0, 0]")), HasSubstr("T_ref_disp"));
  EXPECT_THAT(refusal(with("baseline_m: 0.1", "baseline_m: 0.2")), HasSubstr("rig.baseline_m"));
  EXPECT_THAT(refusal(good + "  speed: 3\n"), HasSubstr("rig.speed"));
  EXPECT_THAT(refusal(good + "  version: 1\n"), HasSubstr("rig.version: stands there twice"));
  EXPECT_THAT(refusal(good + "---\n" + good), HasSubstr("begins another YAML document"));
  EXPECT_EQ(refusal(good + "---\n"), "accepted");
}

}  // namespace
}  // namespace omnister
