// SPDX-License-Identifier: Apache-2.0
#include <gmock/gmock.h>

#include <filesystem>
#include <nlohmann/json.hpp>

#include "omnister/calibration/rig_file.h"
#include "omnister/common/file_io.h"
#include "omnister/lens/lens_file.h"
#include "omnister/lens/lens_models.h"
#include "synthetic_boards.h"
#include "tools/cli/command_line.h"

namespace omnister {
namespace {

using ::testing::HasSubstr;

class CalibrateCommand : public ::testing::Test {
 protected:
  void SetUp() override {
    folder_ = std::filesystem::path(::testing::TempDir()) / "omnister_calibrate_command";
    std::filesystem::remove_all(folder_);
    std::filesystem::create_directories(folder_);
    const LensPtr lens =
        makeLens("conic", {645.0, 473.0}, {{"f", {285.0}}, {"alpha", {0.64}}, {"beta", {1.08}}},
                 1.6, "test");
    test::BoardScene scene;
    scene.views = 8;
    scene.noise_px = 0.05;
    writeFileAtomically(folder_ / "corners.csv",
                        formatDetections(test::simulatedBoards(*lens, scene)));
  }
  void TearDown() override { std::filesystem::remove_all(folder_); }

  int run(const std::vector<std::string>& arguments) {
    std::vector<const char*> argv = {"omnister"};
    for (const std::string& argument : arguments) argv.push_back(argument.c_str());
    ::testing::internal::CaptureStdout();
    ::testing::internal::CaptureStderr();
    const int code = tools::runCommandLine(static_cast<int>(argv.size()), argv.data());
    out_ = ::testing::internal::GetCapturedStdout();
    err_ = ::testing::internal::GetCapturedStderr();
    return code;
  }

  std::filesystem::path folder_;
  std::string out_, err_;
};

TEST_F(CalibrateCommand, WritesLensReportAndJson) {
  const std::string lens = folder_ / "lens.yaml";
  ASSERT_EQ(
      run({"calibrate", "--detections", folder_ / "corners.csv", "--size", "1280x960", "--model",
           "conic", "--folds", "4", "--out", lens, "--report", folder_ / "report", "--json"}),
      0)
      << err_;
  const auto json = nlohmann::json::parse(out_);
  for (const char* key : {"model", "rms_px", "holdout_rms_px", "views", "views_used", "points",
                          "max_theta_rad", "seconds"}) {
    EXPECT_TRUE(json.contains(key)) << key;
  }
  EXPECT_EQ(json["model"], "conic");
  EXPECT_EQ(json["views_used"], 8);
  EXPECT_LT(json["rms_px"], 0.1);
  const LensFile file = readLensFile(lens);
  EXPECT_EQ(file.lens->model(), "conic");
  EXPECT_TRUE(file.covariance);
  const std::string html = readFile(folder_ / "report" / "report.html");
  EXPECT_THAT(html, HasSubstr("data:image/svg+xml;base64,PD94"));
  for (const char* part :
       {"Residual vectors", "against radius", "against azimuth", "radius and sector",
        "Projection uncertainty", "Lens profile", "Lens surface", "board7"})
    EXPECT_THAT(html, HasSubstr(part));
}

TEST_F(CalibrateCommand, TouchesNothingWhenItFails) {
  const std::string lens = folder_ / "lens.yaml";
  writeFileAtomically(lens, "precious");
  writeFileAtomically(folder_ / "few.csv", "view,u_px,v_px,x_m,y_m,z_m\n0,1,2,0,0,0\n");
  EXPECT_EQ(run({"calibrate", "--detections", folder_ / "few.csv", "--size", "1280x960", "--out",
                 lens, "--report", folder_ / "report", "--json"}),
            1);
  EXPECT_EQ(out_, "");
  EXPECT_EQ(readFile(lens), "precious");
  EXPECT_FALSE(std::filesystem::exists(folder_ / "report"));
  const std::string corners = folder_ / "corners.csv";
  const std::string before = readFile(corners);
  EXPECT_EQ(run({"calibrate", "--detections", corners, "--size", "1280x960", "--out", corners}), 1);
  EXPECT_THAT(err_, HasSubstr("an input and an output"));
  EXPECT_EQ(readFile(corners), before);
  EXPECT_EQ(
      run({"calibrate-stereo", "--left-detections", corners, "--right-detections", corners,
           "--size", "1280x960", "--out-left", lens, "--out-right", folder_ / "no" / "b.yaml"}),
      1);
  EXPECT_THAT(err_, HasSubstr("there is no folder"));
  EXPECT_EQ(readFile(lens), "precious");
  EXPECT_EQ(run({"calibrate", "--detections", folder_ / "absent.csv", "--size", "1280x960"}), 1);
  EXPECT_THAT(err_, HasSubstr("absent.csv"));
  EXPECT_EQ(run({"calibrate", "--detections", folder_ / "corners.csv"}), 2);
  EXPECT_EQ(run({"calibrate"}), 2);
  EXPECT_EQ(run({"calibrate", "--detections", "x", "--size", "1280x960", "--model", "fisheye"}), 2);
  EXPECT_EQ(run({"calibrate", "--detections", "x", "--size", "1280x960", "--folds", "1"}), 2);
  EXPECT_EQ(run({"calibrate-stereo", "--left-detections", "x", "--size", "1280x960"}), 2);
  EXPECT_EQ(run({"calibrate-stereo", "--left", "a", "b", "--right", "c", "--target", "t"}), 1);
  EXPECT_THAT(err_, HasSubstr("expected pairs"));
}

}  // namespace
}  // namespace omnister
