// SPDX-License-Identifier: Apache-2.0
// `omnister evaluate thesis|plane|board|pair` as a person calls them.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <nlohmann/json.hpp>
#include <opencv2/imgcodecs.hpp>
#include <random>
#include <sstream>
#include <string>

#include "command_run.h"
#include "omnister/common/file_io.h"
#include "omnister/lens/lens_file.h"
#include "omnister/lens/lens_models.h"
#include "omnister/sim/renderer.h"
#include "omnister/stereo/cloud.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

using nlohmann::json;
using test::Outcome;
using test::run;
using ::testing::HasSubstr;
using ::testing::Not;

class Evaluate : public ::testing::Test {
 protected:
  std::string path(const std::string& name) const { return (folder_.path() / name).string(); }

  LensPtr writeLens(const std::string& name, double focal, double center_u) const {
    LensStructure structure;
    structure.model = "asphere";
    structure.even_terms = 1;
    LensFile file;
    file.image_size = {480, 360};
    file.lens = makeLens(structure, {center_u, 179.0}, focal, 1.6);
    writeLensFile(path(name), file);
    return file.lens;
  }

  test::TemporaryFolder folder_;
};

TEST_F(Evaluate, ThesisMakesOnePageAndItsFigures) {
  const Outcome outcome = run({"evaluate", "thesis", "--out", path("thesis"), "--scale", "0.15",
                               "--grid", "300", "--json"});
  ASSERT_EQ(outcome.code, 0) << outcome.err;
  const json figures = json::parse(outcome.out);
  EXPECT_EQ(figures, json::parse(readFile(path("thesis/thesis.json"))));
  const std::string page = readFile(path("thesis/index.html"));
  for (const char* named : {"Fig. 3.2",
                            "Fig. 3.3",
                            "Fig. 3.5",
                            "Fig. 4.2",
                            "Fig. 4.5",
                            "Fig. 4.9",
                            "Fig. 4.10",
                            "Fig. 4.12",
                            "Figs 4.11 and 4.13",
                            "Fig. 4.14",
                            "Fig. 4.15",
                            "Fig. 5.1",
                            "Fig. 5.3",
                            "Fig. 5.6",
                            "Fig. 5.7",
                            "Fig. 5.8",
                            "Table 4.1",
                            "Table 5.1",
                            "fig. 5.4",
                            "As fig. 5.7: quadric (our fit)",
                            "As fig. 5.7: conic (our fit)",
                            "As fig. 5.7: asphere (our fit)"}) {
    EXPECT_THAT(page, HasSubstr(named));
  }
  EXPECT_THAT(page, Not(HasSubstr("src=\"http")));
  EXPECT_THAT(page, Not(HasSubstr("<script")));
  EXPECT_NEAR(figures["chapter_3"]["best_R_x"].get<double>() / (470 * 0.15), 1.0, 0.01);
  EXPECT_NEAR(figures["chapter_3"]["best_R_y"].get<double>() / (451 * 0.15), 1.0, 0.01);
  ASSERT_EQ(figures["lenses"].size(), 3u);
  for (const auto& [name, lens] : figures["lenses"].items()) {
    const json& table = lens["table_4_1"];
    // Truth is known: tilted boards find it, the thesis' procedure misses R0 by a fifth or more.
    EXPECT_LT(table["asphere (our fit)"]["ray_rms_deg"].get<double>(), 0.05) << name;
    EXPECT_LT(std::abs(table["asphere (our fit)"]["R0_error"].get<double>()), 0.01) << name;
    EXPECT_GT(table["quadric (thesis procedure)"]["R0_error"].get<double>(), 0.15) << name;
    EXPECT_LT(lens["table_5_1"]["asphere (our fit)"]["mean_percent"].get<double>(), 0.5) << name;
    EXPECT_NEAR(lens["table_5_1"]["asphere (our fit)"]["distance_mm"].get<double>(), 173.0, 1.0)
        << name;
    EXPECT_GT(lens["fig_5_1"]["most"].get<int>(), 3) << name;
  }
  EXPECT_GE(figures["claims"].size(), 7u);
}

TEST_F(Evaluate, PlaneTellsAFlatCloudFromABentOne) {
  const LensPtr lens = writeLens("lens.yaml", 150.0, 239.0);
  std::mt19937 random(3);
  std::normal_distribution<float> noise(0.0F, 0.002F);
  // A wall 2 m ahead, its ranges too long by `bend` at 45 degrees off the axis, less so further in.
  const auto writeWall = [&](double bend) {
    const cv::Size size(480, 360);
    Cloud cloud{cv::Mat(size, CV_32FC3, cv::Scalar::all(NAN)), cv::Mat::zeros(size, CV_8UC3),
                cv::Mat(size, CV_32FC1, cv::Scalar(0.01)), cv::Mat::ones(size, CV_32FC1)};
    for (int v = 0; v < size.height; ++v) {
      for (int u = 0; u < size.width; ++u) {
        const auto ray = lens->unproject({double(u), double(v)});
        if (!ray || ray->z() < 0.5) continue;
        const double off = 2.0 * (1.0 - ray->z() * ray->z());
        const double range = 2.0 / ray->z() * (1.0 + bend * off + noise(random));
        for (int i = 0; i < 3; ++i)
          cloud.xyz.at<cv::Vec3f>(v, u)[i] = static_cast<float>(range * (*ray)[i]);
      }
    }
    writeCloud(path("wall.ply"), cloud);
  };
  const auto check = [&](const std::string& truth) {
    const Outcome outcome = run({"evaluate", "plane", "--cloud", path("wall.ply"), "--report",
                                 path("report"), "--truth-height", truth, "--json"});
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    return json::parse(outcome.out);
  };
  writeWall(0.0);
  const json good = check("2");
  EXPECT_EQ(good["verdict"], "good") << good;
  EXPECT_LT(good["systematic_range_error"].get<double>(), 0.001);
  EXPECT_NEAR(good["distance_m"].get<double>(), 2.0, 0.001);
  const std::string page = readFile(path("report/report.html"));
  EXPECT_THAT(page, HasSubstr("Range error over the image"));
  EXPECT_THAT(page, HasSubstr("against the angle off the axis"));
  const json farther = check("2.1");
  EXPECT_FALSE(farther["good"].get<bool>());
  EXPECT_THAT(farther["verdict"].get<std::string>(), HasSubstr("another distance"));
  writeWall(0.05);
  const json bent = check("2");
  EXPECT_FALSE(bent["good"].get<bool>());
  EXPECT_THAT(bent["verdict"].get<std::string>(), HasSubstr("bent")) << bent;
  EXPECT_GT(bent["systematic_range_error"].get<double>(), 0.01);
}

TEST_F(Evaluate, BoardTellsAGoodLensFromOneThatHasDrifted) {
  const LensPtr truth = writeLens("lens.yaml", 150.0, 239.0);
  std::mt19937 random(1);
  std::normal_distribution<double> noise(0.0, 0.1);
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  std::ostringstream csv;
  csv.precision(12);
  csv << "view,u_px,v_px,x_m,y_m,z_m\n";
  for (int view = 0; view < 8; ++view) {
    Pose pose = Pose::Identity();
    pose.linear() = (Eigen::AngleAxisd(0.5 * uniform(random), Eigen::Vector3d::UnitX()) *
                     Eigen::AngleAxisd(0.5 * uniform(random), Eigen::Vector3d::UnitY()))
                        .toRotationMatrix();
    pose.translation() = Eigen::Vector3d(0.1 * uniform(random), 0.1 * uniform(random), 0.25);
    for (int y = 0; y < 7; ++y) {
      for (int x = 0; x < 9; ++x) {
        const Eigen::Vector3d point(0.05 * (x - 4), 0.05 * (y - 3), 0.0);
        const auto pixel = truth->project(pose * point);
        if (!pixel) continue;
        csv << view << "," << pixel->x() + noise(random) << "," << pixel->y() + noise(random) << ","
            << point.x() << "," << point.y() << ",0\n";
      }
    }
  }
  writeFileAtomically(path("corners.csv"), csv.str());
  const auto check = [&](const std::string& lens) {
    const Outcome outcome = run({"evaluate", "board", "--lens", path(lens), "--detections",
                                 path("corners.csv"), "--report", path("report"), "--json"});
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    return json::parse(outcome.out);
  };
  const json good = check("lens.yaml");
  EXPECT_TRUE(good["good"].get<bool>()) << good;
  EXPECT_NEAR(good["rms_px"].get<double>(), 0.14, 0.02);
  EXPECT_NEAR(good["scale"].get<double>(), 1.0, 5.0 * good["scale_sigma"].get<double>());
  EXPECT_THAT(readFile(path("report/report.html")), HasSubstr("Residual against radius"));
  writeLens("moved.yaml", 150.0, 242.0);
  const json moved = check("moved.yaml");
  EXPECT_FALSE(moved["good"].get<bool>()) << moved;
  EXPECT_THAT(moved["verdict"].get<std::string>(), HasSubstr("drifted"));
  EXPECT_NEAR(moved["center_shift_px"][0].get<double>(), -3.0, 0.5);
  writeLens("longer.yaml", 156.0, 239.0);
  const json longer = check("longer.yaml");
  EXPECT_FALSE(longer["good"].get<bool>()) << longer;

  const Outcome nothing = run({"evaluate", "board", "--lens", path("lens.yaml")});
  EXPECT_EQ(nothing.code, 2);
  const Outcome missing =
      run({"evaluate", "board", "--lens", path("lens.yaml"), "--detections", path("none.csv")});
  EXPECT_EQ(missing.code, 1);
  EXPECT_THAT(missing.err, HasSubstr("none.csv"));
}

TEST_F(Evaluate, PairTellsAGoodPoseFromOneThatHasDrifted) {
  const LensPtr lens = writeLens("lens.yaml", 110.0, 239.0);
  const sim::ScenePtr scene =
      sim::readScene(std::string(OMNISTER_SOURCE_DIR) + "/config/scenes/room.yaml");
  const sim::Renderer renderer(*lens, {480, 360});
  sim::RenderOptions options;
  options.adaptive = true;
  options.noise_sigma = 1.0;
  options.color = false;
  Pose displaced = Pose::Identity();
  displaced.translation() = Eigen::Vector3d(0.12, 0.0, 0.0);
  cv::imwrite(path("r.png"), renderer.render(*scene, Pose::Identity(), options).image);
  options.seed = 2;
  cv::imwrite(path("d.png"), renderer.render(*scene, displaced, options).image);
  const auto check = [&](const std::string& pose) {
    const Outcome outcome =
        run({"evaluate", "pair", "--lens", path("lens.yaml"), "--reference", path("r.png"),
             "--displaced", path("d.png"), "--pose", pose, "--report", path("report"), "--json"});
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    return outcome.code == 0 ? json::parse(outcome.out) : json();
  };
  const json good = check("0.12 0 0 0 0 0 1");
  EXPECT_TRUE(good["good"].get<bool>()) << good;
  EXPECT_LT(good["median_px"].get<double>(), 0.3);
  EXPECT_GT(good["inliers"].get<int>(), 150);
  EXPECT_THAT(readFile(path("report/report.html")), HasSubstr("epipolar"));
  // Turned by one degree about its z axis.
  const json turned = check("0.12 0 0 0 0 0.0087265 0.9999619");
  EXPECT_FALSE(turned["good"].get<bool>()) << turned;
  EXPECT_THAT(turned["verdict"].get<std::string>(), HasSubstr("drifted"));
  EXPECT_NEAR(turned["turn_deg"][2].get<double>(), -1.0, 0.1);

  const Outcome still =
      run({"evaluate", "pair", "--lens", path("lens.yaml"), "--reference", path("r.png"),
           "--displaced", path("d.png"), "--pose", "0 0 0 0 0 0 1"});
  EXPECT_EQ(still.code, 1);
  EXPECT_THAT(still.err, HasSubstr("baseline"));
}

}  // namespace
}  // namespace omnister
