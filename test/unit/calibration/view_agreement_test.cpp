// SPDX-License-Identifier: Apache-2.0
// Views of two cameras, or of one whose images were turned, do not pass for views of one.
#include <gmock/gmock.h>

#include "omnister/calibration/calibrate.h"
#include "synthetic_boards.h"

namespace omnister {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::Not;

LensPtr lensAt(double x, double y, double f) {
  return makeLens("conic", {x, y}, {{"f", {f}}, {"alpha", {0.64}}, {"beta", {1.08}}}, 1.6, "test");
}

Detections seenBy(const LensPtr& lens, unsigned seed, int views = 20) {
  test::BoardScene scene = test::wideScene(seed, 0.05);
  scene.views = views;
  return test::simulatedBoards(*lens, scene);
}

void turn(ViewDetections& view, const cv::Size& size) {
  for (Eigen::Vector2d& pixel : view.pixels) {
    pixel = Eigen::Vector2d(size.width - 1, size.height - 1) - pixel;
  }
}

std::string refusal(const Detections& detections) {
  try {
    calibrate(detections, {});
  } catch (const ContradictionError& error) {
    return error.what();
  }
  return "accepted";
}

TEST(ViewAgreement, EverySecondImageTurnedIsNamedAndRefused) {
  // Centres a little and far off the middle of the image.
  for (const double off : {3.5, 12.0}) {
    Detections detections = seenBy(lensAt(639.5 + off, 479.5 - 0.6 * off, 285.0), 1);
    for (std::size_t i = 1; i < detections.views.size(); i += 2) {
      turn(detections.views[i], detections.image_size);
    }
    const std::string message = refusal(detections);
    EXPECT_THAT(message, AllOf(HasSubstr("contradict each other"), HasSubstr("turned by 180"),
                               HasSubstr("10 of them agree on one lens"),
                               HasSubstr("board1, board3, board5")))
        << off;
  }
}

TEST(ViewAgreement, AFewTurnedImagesAreNamed) {
  Detections detections = seenBy(lensAt(647.0, 472.0, 285.0), 2);
  for (const std::size_t i : {4u, 9u, 15u, 16u}) turn(detections.views[i], detections.image_size);
  EXPECT_THAT(refusal(detections), AllOf(HasSubstr("16 of them agree"), HasSubstr("turned by 180"),
                                         HasSubstr("(board4, board9, board15, board16)")));
}

TEST(ViewAgreement, TwoCamerasInOneFolderAreSplit) {
  struct Case {
    double x, y, f;
  };
  // Nearly alike, of another focal length, and of quite another lens.
  for (const Case& other :
       {Case{630.0, 486.0, 285.0}, {645.0, 473.0, 300.0}, {600.0, 500.0, 420.0}}) {
    Detections detections = seenBy(lensAt(645.0, 473.0, 285.0), 3, 14);
    const Detections more = seenBy(lensAt(other.x, other.y, other.f), 4, 10);
    for (const ViewDetections& view : more.views) {
      detections.views.push_back(view);
      detections.views.back().name = "other" + view.name;
    }
    const std::string message = refusal(detections);
    EXPECT_THAT(message, AllOf(HasSubstr("14 of them agree on one lens"),
                               HasSubstr("10 of them agree on another lens"),
                               HasSubstr("otherboard0, otherboard1")))
        << other.f << " " << other.x;
    CalibrationOptions options;
    options.contradictions = Contradictions::kLeaveOut;
    const CalibrationResult result = calibrate(detections, options);
    EXPECT_NEAR(result.height_px, 285.0, 1.0);
    EXPECT_LT(result.rms_px, 0.09);
    EXPECT_FALSE(result.views.back().used);
    EXPECT_THAT(result.views.back().reason, HasSubstr("contradict"));
  }
}

TEST(ViewAgreement, KeptTogetherWhenTold) {
  Detections detections = seenBy(lensAt(647.0, 472.0, 285.0), 5);
  for (std::size_t i = 1; i < detections.views.size(); i += 2) {
    turn(detections.views[i], detections.image_size);
  }
  CalibrationOptions options;
  options.contradictions = Contradictions::kKeep;
  EXPECT_GT(calibrate(detections, options).rms_px, 0.2);
}

// Neither noise, outliers, bent boards nor a lens that no compact model says are contradictions.
TEST(ViewAgreement, OneCameraIsOneCamera) {
  for (unsigned seed = 1; seed <= 6; ++seed) {
    test::BoardScene scene = test::wideScene(seed, 0.3);
    scene.warp = {0.001, -0.0007};
    scene.outliers = 0.03;
    EXPECT_EQ(refusal(test::simulatedBoards(*test::wideLens(), scene)), "accepted") << seed;
  }
  CalibrationOptions options;
  options.model = "spherical";
  EXPECT_NO_THROW(calibrate(seenBy(lensAt(645.0, 473.0, 285.0), 3), options));
  test::BoardScene bent = test::bentScene(20);
  EXPECT_EQ(refusal(test::simulatedBoards(*test::bentLens(), bent)), "accepted");
}

TEST(BoardScale, TheLensDoesNotDependOnTheUnitOfLength) {
  const Detections metres = seenBy(lensAt(645.0, 473.0, 285.0), 7);
  const CalibrationResult result = calibrate(metres, {});
  for (const double unit : {1e-6, 1e-3, 1e3, 0.7}) {
    Detections other = metres;
    for (ViewDetections& view : other.views) {
      for (Eigen::Vector3d& point : view.points) point *= unit;
    }
    const CalibrationResult again = calibrate(other, {});
    EXPECT_NEAR(again.height_px / result.height_px, 1.0, 1e-6) << unit;
    EXPECT_NEAR(again.rms_px / result.rms_px, 1.0, 1e-6) << unit;
    EXPECT_NEAR(again.views[0].T_camera_board.translation().norm(),
                unit * result.views[0].T_camera_board.translation().norm(), 1e-4 * unit);
    EXPECT_NEAR(again.depth_uncertainty[0].distance / result.depth_uncertainty[0].distance, unit,
                1e-3 * unit);
  }
}

}  // namespace
}  // namespace omnister
