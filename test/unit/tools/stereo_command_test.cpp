// SPDX-License-Identifier: Apache-2.0
// `omnister stereo` and `omnister evaluate plane` as a person calls them.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <nlohmann/json.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <string>
#include <vector>

#include "command_folder.h"
#include "omnister/common/file_io.h"
#include "omnister/lens/lens_file.h"
#include "omnister/lens/lens_models.h"
#include "omnister/stereo/cloud.h"
#include "unit/stereo/analytic_scene.h"

namespace omnister {
namespace {

using test::Outcome;
using test::run;

namespace fs = std::filesystem;
using ::testing::AllOf;
using ::testing::HasSubstr;

class StereoCommand : public test::CommandFolder {
 protected:
  static constexpr const char* kPose = "-0.3 0 0 0 0 0 1";

  void SetUp() override {
    LensFile lens;
    lens.image_size = {128, 96};
    lens.lens = makeLens(LensStructure{}, {63.2, 47.9}, 55.0, 1.3);
    writeLensFile(path("lens.yaml"), lens);
    const auto scene = test::wall(2.0, 0.25);
    reference_ = test::look(scene, *lens.lens, lens.image_size, Pose::Identity()).image;
    displaced_ = test::look(scene, *lens.lens, lens.image_size, test::pose(-0.3, 0, 0)).image;
    cv::imwrite(path("reference.png"), reference_);
    cv::imwrite(path("displaced.png"), displaced_);
  }

  // The arguments that work, with some changed ("" leaves one out) and some added.
  std::vector<std::string> arguments(const std::map<std::string, std::string>& changed = {},
                                     const std::vector<std::string>& added = {}) const {
    std::map<std::string, std::string> values = {{"--lens", path("lens.yaml")},
                                                 {"--reference", path("reference.png")},
                                                 {"--displaced", path("displaced.png")},
                                                 {"--pose", kPose},
                                                 {"--min-range", "1.2"},
                                                 {"--matcher", "thesis"},
                                                 {"--thesis-window", "5"},
                                                 {"--cloud", path("cloud.ply")},
                                                 {"--range", path("range.tiff")}};
    for (const auto& [key, value] : changed) values[key] = value;
    std::vector<std::string> result = {"stereo"};
    for (const auto& [key, value] : values) {
      if (value.empty()) continue;
      result.push_back(key);
      result.push_back(value);
    }
    result.insert(result.end(), added.begin(), added.end());
    return result;
  }

  std::string refusal(const std::vector<std::string>& call, int code = 1) const {
    return refused(call, code, {"cloud.ply", "range.tiff"});
  }

  cv::Mat reference_, displaced_;
};

// A textured wall seen by two cameras that differ, large enough to try other poses small.
class StereoMistakes : public StereoCommand {
 protected:
  void SetUp() override {
    StereoCommand::SetUp();
    const cv::Size size(320, 240);
    LensFile left, right;
    left.image_size = right.image_size = size;
    left.lens = makeLens(LensStructure{}, {158.2, 120.9}, 130.0, 1.3);
    right.lens = makeLens(LensStructure{}, {171.0, 113.0}, 143.0, 1.3);
    writeLensFile(path("left.yaml"), left);
    writeLensFile(path("right.yaml"), right);
    const auto scene = test::wall(2.0, 0.25);
    const Pose pose = parsePose(kTrue, "pose");
    cv::imwrite(path("l.png"), test::look(scene, *left.lens, size, Pose::Identity()).image);
    cv::imwrite(path("r.png"), test::look(scene, *right.lens, size, pose).image);
  }

  nlohmann::json matched(const std::map<std::string, std::string>& changed) const {
    std::map<std::string, std::string> values = {{"--lens", path("left.yaml")},
                                                 {"--lens-displaced", path("right.yaml")},
                                                 {"--reference", path("l.png")},
                                                 {"--displaced", path("r.png")},
                                                 {"--pose", kTrue},
                                                 {"--min-range", "1.2"},
                                                 {"--matcher", "sweep"},
                                                 {"--thesis-window", ""}};
    for (const auto& [key, value] : changed) values[key] = value;
    const Outcome outcome = run(arguments(values, {"--json"}));
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    return nlohmann::json::parse(outcome.out);
  }

  static std::string remarksOf(const nlohmann::json& json) {
    std::string text;
    if (json.contains("remarks")) {
      for (const auto& remark : json["remarks"]) text += remark.get<std::string>() + "\n";
    }
    return text;
  }

  // To the right, a little up, and turned about the axis.
  static constexpr const char* kTrue = "0.3 -0.08 0.02 0 0.03 0.15 0.988";
};

TEST_F(StereoMistakes, NothingIsSaidOfAPairThatFits) {
  const nlohmann::json json = matched({});
  EXPECT_GT(json["valid_fraction"].get<double>(), 0.4);
  EXPECT_EQ(remarksOf(json), "");
}

TEST_F(StereoMistakes, AnInvertedPoseIsNamed) {
  const nlohmann::json json = matched({{"--pose", formatPose(parsePose(kTrue, "pose").inverse())}});
  EXPECT_LT(json["valid_fraction"].get<double>(), 0.25);
  EXPECT_THAT(remarksOf(json), HasSubstr("with the pose inverted"));
}

TEST_F(StereoMistakes, ExchangedImagesAndLensesAreNamed) {
  EXPECT_THAT(remarksOf(matched({{"--reference", path("r.png")}, {"--displaced", path("l.png")}})),
              HasSubstr("with the two images exchanged"));
  EXPECT_THAT(remarksOf(matched({{"--reference", path("r.png")},
                                 {"--displaced", path("l.png")},
                                 {"--lens", path("right.yaml")},
                                 {"--lens-displaced", path("left.yaml")}})),
              HasSubstr("with the pose inverted"));
}

TEST_F(StereoMistakes, ABlackSurroundIsLeftOut) {
  for (const char* name : {"l.png", "r.png"}) {
    cv::Mat image = cv::imread(path(name), cv::IMREAD_GRAYSCALE);
    cv::Mat dark(image.size(), CV_8UC1);
    cv::RNG random(3);
    random.fill(dark, cv::RNG::NORMAL, 8, 3);
    cv::Mat disc(image.size(), CV_8UC1, cv::Scalar(0));
    cv::circle(disc, {160, 120}, 112, cv::Scalar(255), -1);
    image.copyTo(dark, disc);
    cv::imwrite(path(name), dark);
  }
  const nlohmann::json json = matched({});
  EXPECT_THAT(remarksOf(json), HasSubstr("the picture is a disc of radius 11"));
  const cv::Mat range = cv::imread(path("range.tiff"), cv::IMREAD_UNCHANGED);
  int inside = 0, outside = 0;
  for (int v = 0; v < range.rows; ++v) {
    for (int u = 0; u < range.cols; ++u) {
      if (std::isnan(range.at<float>(v, u))) continue;
      (std::hypot(u - 160, v - 120) > 112 ? outside : inside) += 1;
    }
  }
  EXPECT_EQ(outside, 0);
  EXPECT_GT(inside, 8000);
}

TEST_F(StereoCommand, WritesCloudRangeAndJson) {
  const Outcome outcome = run(arguments({}, {"--json", "--threads", "1"}));
  ASSERT_EQ(outcome.code, 0) << outcome.err;
  EXPECT_EQ(outcome.err, "");
  EXPECT_EQ(std::count(outcome.out.begin(), outcome.out.end(), '\n'), 1);
  const auto json = nlohmann::json::parse(outcome.out);
  EXPECT_GT(json["valid_fraction"].get<double>(), 0.7);
  EXPECT_LE(json["valid_fraction"].get<double>(), 1.0);
  EXPECT_GT(json["seconds"]["total"].get<double>(), 0.0);
  EXPECT_GE(json["seconds"]["setup"].get<double>(), 0.0);
  EXPECT_GE(json["working_memory_mb"].get<double>(), 0.0);
  EXPECT_GT(json["peak_memory_mb"].get<double>(), 5.0);
  EXPECT_NEAR(json["baseline_m"].get<double>(), 0.3, 1e-12);

  const cv::Mat range = cv::imread(path("range.tiff"), cv::IMREAD_UNCHANGED);
  ASSERT_EQ(range.type(), CV_32FC1);
  const Cloud cloud = readCloud(path("cloud.ply"));
  ASSERT_EQ(cloud.xyz.size(), range.size());
  int valid = 0, on_wall = 0;
  for (int v = 0; v < range.rows; ++v) {
    for (int u = 0; u < range.cols; ++u) {
      const auto& p = cloud.xyz.at<cv::Vec3f>(v, u);
      ASSERT_EQ(std::isnan(range.at<float>(v, u)), std::isnan(p[0]));
      if (std::isnan(p[0])) continue;
      ++valid;
      EXPECT_NEAR(cv::norm(p), range.at<float>(v, u), 1e-5 * cv::norm(p));
      on_wall += std::abs(p[2] - 2.0) < 0.1;
      EXPECT_EQ(cloud.bgr.at<cv::Vec3b>(v, u), cv::Vec3b::all(reference_.at<uchar>(v, u)));
    }
  }
  EXPECT_EQ(valid, json["valid"].get<int>());
  EXPECT_GT(on_wall, 0.9 * valid);

  const Outcome plane = run({"evaluate", "plane", "--cloud", path("cloud.ply"), "--truth-height",
                             "2", "--json", "--roi", "20,20,80,60"});
  ASSERT_EQ(plane.code, 0) << plane.err;
  const auto fit = nlohmann::json::parse(plane.out);
  EXPECT_NEAR(fit["distance_m"].get<double>(), 2.0, 0.01);
  EXPECT_NEAR(fit["normal"][2].get<double>(), -1.0, 0.001);
  EXPECT_LT(fit["median_range_error"].get<double>(), 0.01);
  EXPECT_GT(fit["density"].get<double>(), 0.95);
  EXPECT_FALSE(fit["bands"].empty());
}

TEST_F(StereoCommand, SweepIsTheDefaultAndRepeats) {
  const Outcome outcome = run(
      arguments({{"--matcher", ""}, {"--cloud", path("new.pcd")}}, {"--json", "--repeat", "3"}));
  ASSERT_EQ(outcome.code, 0) << outcome.err;
  const auto json = nlohmann::json::parse(outcome.out);
  EXPECT_EQ(json["matcher"], "sweep");
  EXPECT_EQ(json["repeat"], 3);
  EXPECT_GT(json["valid_fraction"].get<double>(), 0.5);
  EXPECT_THAT(readFile(path("new.pcd")), HasSubstr("HEIGHT 96"));
}

TEST_F(StereoCommand, TakesAnyDepthAndColour) {
  const auto rangeOf = [&](const std::map<std::string, std::string>& changed) {
    const Outcome outcome = run(arguments(changed));
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    return cv::imread(path("range.tiff"), cv::IMREAD_UNCHANGED);
  };
  const cv::Mat plain = rangeOf({});
  // Twelve bits in files of sixteen.
  cv::Mat deep;
  reference_.convertTo(deep, CV_16U, 4095.0 / 255.0);
  cv::imwrite(path("reference16.png"), deep);
  displaced_.convertTo(deep, CV_16U, 4095.0 / 255.0);
  cv::imwrite(path("displaced16.png"), deep);
  const cv::Mat from16 =
      rangeOf({{"--reference", path("reference16.png")}, {"--displaced", path("displaced16.png")}});
  cv::Mat color;
  cv::cvtColor(reference_, color, cv::COLOR_GRAY2BGRA);
  cv::imwrite(path("color.png"), color);
  const cv::Mat from_color = rangeOf({{"--reference", path("color.png")}});
  for (const cv::Mat& other : {from16, from_color}) {
    EXPECT_EQ(0, std::memcmp(plain.data, other.data, plain.total() * 4));
  }
}

TEST_F(StereoCommand, AMaskLeavesPixelsOut) {
  cv::Mat mask(96, 128, CV_8UC1, cv::Scalar(0));
  mask(cv::Rect(40, 30, 30, 20)) = 1;
  cv::imwrite(path("mask.png"), mask);
  const Outcome outcome = run(arguments({{"--mask", path("mask.png")}}, {"--json"}));
  ASSERT_EQ(outcome.code, 0) << outcome.err;
  const auto json = nlohmann::json::parse(outcome.out);
  EXPECT_LE(json["valid"].get<int>(), 600);
  EXPECT_GT(json["valid_fraction"].get<double>(), 0.9);
}

TEST_F(StereoCommand, SeveralDisplacedImagesWithTheirPoses) {
  const Outcome outcome = run(arguments({}, {"--displaced", path("displaced.png"), "--pose", kPose,
                                             "--lens-displaced", path("lens.yaml"), "--json"}));
  ASSERT_EQ(outcome.code, 0) << outcome.err;
  EXPECT_THAT(refusal(arguments({}, {"--displaced", path("displaced.png")})),
              HasSubstr("2 displaced image(s) but 1 pose(s)"));
  EXPECT_THAT(refusal(arguments({}, {"--pose", kPose})),
              HasSubstr("1 displaced image(s) but 2 pose(s)"));
  EXPECT_THAT(refusal(arguments({{"--pose", ""}})), HasSubstr("0 pose(s)"));
  EXPECT_THAT(refusal(arguments({}, {"--lens-displaced", path("lens.yaml"), "--lens-displaced",
                                     path("lens.yaml")})),
              HasSubstr("2 lenses"));
}

TEST_F(StereoCommand, RegionReductionAndPrior) {
  const auto json = [&](const std::map<std::string, std::string>& changed,
                        const std::vector<std::string>& added) {
    auto call = arguments(changed, added);
    call.push_back("--json");
    const Outcome outcome = run(call);
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    return nlohmann::json::parse(outcome.out);
  };
  const std::map<std::string, std::string> sweep = {{"--matcher", ""}};
  EXPECT_LE(json(sweep, {"--roi", "40,30,30,20"})["valid"].get<int>(), 600);
  // The wall is where it was, on a grid of half the size.
  const auto half = json(sweep, {"--reduce", "2"});
  EXPECT_EQ(half["width"], 64);
  EXPECT_EQ(half["height"], 48);
  const Cloud cloud = readCloud(path("cloud.ply"));
  int valid = 0, on_wall = 0;
  for (int v = 0; v < cloud.xyz.rows; ++v) {
    for (int u = 0; u < cloud.xyz.cols; ++u) {
      const auto& p = cloud.xyz.at<cv::Vec3f>(v, u);
      if (std::isnan(p[2])) continue;
      ++valid;
      on_wall += std::abs(p[2] - 2.0) < 0.1;
    }
  }
  EXPECT_GT(valid, 1000);
  EXPECT_GT(on_wall, 0.6 * valid);
  // A range image of the frame before fills what the images leave open, and no more than they show.
  const int alone = json(sweep, {"--refine"})["valid"].get<int>();
  fs::copy(path("range.tiff"), path("before.tiff"));
  const int with = json(sweep, {"--prior", path("before.tiff")})["valid"].get<int>();
  EXPECT_GE(with, alone);
  EXPECT_THAT(refusal(arguments(sweep, {"--prior", path("before.tiff"), "--reduce", "2"})),
              HasSubstr("before.tiff"));
  EXPECT_THAT(refusal(arguments({}, {"--refine"})), HasSubstr("--refine is for the sweep"));
  for (const char* roi : {"1,2,3", "0,0,0,5", "0,0,129,5", "a,b,c,d", "-1,0,5,5", "1,1,5,5,5"})
    EXPECT_THAT(refusal(arguments(sweep, {"--roi", roi})), HasSubstr("--roi"));
  for (const char* reduce : {"0", "-1", "65", "16"})
    EXPECT_THAT(refusal(arguments(sweep, {"--reduce", reduce})), HasSubstr("reduce"));
}

TEST_F(StereoCommand, PresetsAreTheSettingsThatTheyStandFor) {
  const auto range = [&](const std::vector<std::string>& added) {
    const Outcome outcome = run(arguments({{"--matcher", ""}}, added));
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    return readFile(path("range.tiff"));
  };
  EXPECT_EQ(range({"--preset", "fast"}), range({"--reduce", "2"}));
  EXPECT_EQ(range({"--preset", "balanced"}), range({}));
  const std::string accurate = range({"--preset", "accurate"});
  EXPECT_EQ(accurate, range({"--refine"}));
  EXPECT_NE(accurate, range({}));
  for (const std::vector<std::string>& wrong : {std::vector<std::string>{"--preset", "best"},
                                                {"--preset", "fast", "--reduce", "3"},
                                                {"--preset", "balanced", "--refine"}}) {
    EXPECT_EQ(run(arguments({{"--matcher", ""}}, wrong)).code, 2) << wrong.back();
  }
}

TEST_F(StereoCommand, CalibrationsMakePartOfSigma) {
  const auto sigma = [&](const std::string& lens, const std::vector<std::string>& added) {
    const Outcome outcome = run(arguments({{"--matcher", ""}, {"--lens", path(lens)}}, added));
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    const cv::Mat all = readCloud(path("cloud.ply")).sigma;
    const float value = all.at<float>(all.rows / 2, all.cols / 2);
    EXPECT_TRUE(std::isfinite(value));
    return value;
  };
  LensFile lens = readLensFile(path("lens.yaml"));
  const Eigen::Index count = lens.lens->parameters().size();
  lens.covariance = 4.0 * Eigen::MatrixXd::Identity(count, count);
  writeLensFile(path("unsure.yaml"), lens);
  const float exact = sigma("lens.yaml", {});
  EXPECT_GT(sigma("unsure.yaml", {}), exact);
  EXPECT_GT(sigma("unsure.yaml", {"--reduce", "2"}), sigma("lens.yaml", {"--reduce", "2"}));
  // A step of 0.3 m that is known to 10 % makes ranges uncertain by 10 %.
  const float unsure = sigma("lens.yaml", {"--pose-sigma", "0.03 0"});
  EXPECT_NEAR(std::sqrt(unsure * unsure - exact * exact), 0.2, 0.04);
  for (const char* bad : {"1", "a b", "-1 0", "0 1 2", "nan 0", "0 9"})
    EXPECT_THAT(refusal(arguments({}, {"--pose-sigma", bad})), HasSubstr("--pose-sigma"));
  EXPECT_THAT(refusal(arguments({}, {"--pose-sigma", "0 0", "--pose-sigma", "0 0"})),
              HasSubstr("2 --pose-sigma"));
}

TEST_F(StereoCommand, SaysWhyImagesGiveNothing) {
  const auto err = [&](const cv::Mat& displaced, const char* matcher) {
    cv::imwrite(path("other.png"), displaced);
    const Outcome outcome =
        run(arguments({{"--matcher", matcher}, {"--displaced", path("other.png")}}, {"--json"}));
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    const auto json = nlohmann::json::parse(outcome.out);
    EXPECT_EQ(json["remarks"].size(), 1u);
    return outcome.err;
  };
  const auto plain = [&](int grey) { return cv::Mat(96, 128, CV_8UC1, cv::Scalar(grey)); };
  for (const char* matcher : {"", "thesis"}) {
    EXPECT_THAT(err(plain(0), matcher), HasSubstr("displaced image 1 is black"));
    EXPECT_THAT(err(plain(255), matcher), HasSubstr("displaced image 1 is saturated: 100 %"));
    EXPECT_THAT(err(plain(90), matcher), HasSubstr("displaced image 1 has no contrast"));
    EXPECT_THAT(err(displaced_ * 0.25, matcher), HasSubstr("exposed otherwise"));
  }
}

TEST_F(StereoCommand, RefusesBadInputAndTouchesNothing) {
  cv::imwrite(path("small.png"), cv::Mat(10, 12, CV_8UC1, cv::Scalar(7)));
  cv::imwrite(path("float.tiff"), cv::Mat(96, 128, CV_32FC1, cv::Scalar(7)));
  const std::string png = readFile(path("reference.png"));
  writeFileAtomically(path("cut.png"), png.substr(0, png.size() / 2));
  writeFileAtomically(path("text.png"), "not an image");
  EXPECT_THAT(refusal(arguments({{"--reference", path("absent.png")}})), HasSubstr("absent.png"));
  EXPECT_THAT(refusal(arguments({{"--displaced", path("absent.png")}})), HasSubstr("absent.png"));
  EXPECT_THAT(refusal(arguments({{"--reference", path("cut.png")}})), HasSubstr("cut.png"));
  EXPECT_THAT(refusal(arguments({{"--reference", path("text.png")}})), HasSubstr("text.png"));
  EXPECT_THAT(refusal(arguments({{"--displaced", path("small.png")}})),
              AllOf(HasSubstr("small.png"), HasSubstr("12x10"), HasSubstr("lens.yaml"),
                    HasSubstr("128x96")));
  EXPECT_THAT(refusal(arguments({{"--mask", path("small.png")}})), HasSubstr("small.png"));
  EXPECT_THAT(refusal(arguments({{"--reference", path("float.tiff")}})), HasSubstr("8 or 16 bits"));
  EXPECT_THAT(refusal(arguments({{"--lens", path("reference.png")}})), HasSubstr("reference.png"));
  EXPECT_THAT(refusal(arguments({{"--lens", path("absent.yaml")}})), HasSubstr("absent.yaml"));
  EXPECT_THAT(refusal(arguments({{"--pose", "0 0 0 0 0 0 1"}})), HasSubstr("no parallax"));
  EXPECT_THAT(refusal(arguments({{"--pose", "nan 0 0 0 0 0 1"}})), HasSubstr("--pose"));
  EXPECT_THAT(refusal(arguments({{"--pose", "0.1 0 0"}})), HasSubstr("--pose"));
  EXPECT_THAT(refusal(arguments({{"--pose", "0.1 0 0 0 0 0 0"}})), HasSubstr("--pose"));
  EXPECT_THAT(refusal(arguments({{"--min-range", "nan"}})), HasSubstr("minimum range is nan"));
  EXPECT_THAT(refusal(arguments({{"--min-range", "3"}, {"--max-range", "2"}})),
              HasSubstr("not below"));
  EXPECT_THAT(refusal(arguments({{"--hypotheses", "2000000"}})), HasSubstr("hypotheses"));
  EXPECT_EQ(run(arguments({{"--repeat", "0"}})).code, 2);
  EXPECT_EQ(run(arguments({{"--threads", "-1"}})).code, 2);
  for (const std::vector<std::string>& call :
       {std::vector<std::string>{"nope"}, {"nope", "--help"}, {"", "--help"}}) {
    const Outcome unknown = run(call);
    EXPECT_EQ(unknown.code, 2);
    EXPECT_EQ(unknown.out, "");
    EXPECT_THAT(unknown.err, HasSubstr("no subcommand '" + call[0] + "'"));
  }
  EXPECT_THAT(refusal(arguments({{"--thesis-window", "4"}})), HasSubstr("thesis mask"));
  // Outputs.
  EXPECT_THAT(refusal(arguments({{"--cloud", path("cloud.obj")}})), HasSubstr("cloud.obj"));
  EXPECT_THAT(refusal(arguments({{"--range", path("range.png")}})), HasSubstr("range.png"));
  EXPECT_THAT(refusal(arguments({{"--cloud", path("absent/cloud.ply")}})), HasSubstr("no folder"));
  fs::copy(path("reference.png"), path("reference.tiff"));
  EXPECT_THAT(refusal(arguments(
                  {{"--reference", path("reference.tiff")}, {"--range", path("reference.tiff")}})),
              HasSubstr("input and an output at once"));
  fs::create_directory(path("folder.ply"));
  EXPECT_THAT(refusal(arguments({{"--cloud", path("folder.ply")}})), HasSubstr("folder.ply"));
  fs::create_directory(path("folder.tiff"));
  EXPECT_THAT(refusal(arguments({{"--range", path("folder.tiff")}})), HasSubstr("it is a folder"));
}

TEST_F(StereoCommand, WrongUsageIsExitCode2) {
  EXPECT_THAT(refusal({"stereo"}, 2), HasSubstr("required"));
  EXPECT_THAT(refusal(arguments({{"--matcher", "best"}}), 2), HasSubstr("--matcher"));
  EXPECT_THAT(refusal(arguments({{"--min-range", "near"}}), 2), HasSubstr("--min-range"));
  EXPECT_THAT(refusal(arguments({}, {"--frobnicate"}), 2), HasSubstr("frobnicate"));
  EXPECT_THAT(refusal({"evaluate"}, 2), HasSubstr("subcommand"));
}

TEST_F(StereoCommand, EvaluateRefusesWhatItCannotRead) {
  EXPECT_THAT(refusal({"evaluate", "plane", "--cloud", path("cloud.ply")}), HasSubstr("cloud.ply"));
  EXPECT_EQ(run(arguments()).code, 0);
  for (const char* roi :
       {"1,2,3", "0,0,0,5", "0,0,129,5", "a,b,c,d", "-1,0,5,5", "0.5,0,5,5", "nan,0,5,5"}) {
    const Outcome outcome = run({"evaluate", "plane", "--cloud", path("cloud.ply"), "--roi", roi});
    EXPECT_EQ(outcome.code, 1) << roi;
    EXPECT_THAT(outcome.err, HasSubstr("--roi")) << roi;
  }
  EXPECT_EQ(run({"evaluate", "plane", "--cloud", path("cloud.ply"), "--truth-height", "nan"}).code,
            1);
}

}  // namespace
}  // namespace omnister
