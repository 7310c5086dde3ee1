// SPDX-License-Identifier: Apache-2.0
// `omnister import`, `export`, `project` and `unproject` as a person calls them.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <iostream>
#include <nlohmann/json.hpp>
#include <sstream>
#include <string>
#include <vector>

#include "command_folder.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_file.h"
#include "omnister/lens/lens_models.h"

namespace omnister {
namespace {

using test::Outcome;
using test::run;

using ::testing::AllOf;
using ::testing::HasSubstr;
using Arguments = std::vector<std::string>;

constexpr char kChain[] =
    "cam0:\n  camera_model: ds\n  intrinsics: [-0.2, 0.59, 300, 310, 640, 480]\n"
    "  distortion_model: none\n  distortion_coeffs: []\n  resolution: [1280, 960]\n"
    "  rostopic: /cam0/image_raw\n";

class LensCommands : public test::CommandFolder {
 protected:
  void SetUp() override {
    file_.image_size = {1280, 960};
    file_.camera_name = "wide";
    file_.lens = makeLens(
        "conic", {650.25, 471.5},
        {{"f", {310}}, {"alpha", {0.6}}, {"beta", {1.1}}, {"p", {0.01}}, {"q", {0}}}, 1.6, "made");
    writeLensFile(path("lens.yaml"), file_);
    writeFileAtomically(path("chain.yaml"), kChain);
  }
  std::string refusal(const Arguments& arguments, int code = 1) const {
    return refused(arguments, code, {"old.yaml"});
  }

  LensFile file_;
};

// One JSON object, on one line, and nothing else.
nlohmann::json object(const Outcome& outcome) {
  EXPECT_EQ(outcome.code, 0) << outcome.err;
  EXPECT_EQ(std::count(outcome.out.begin(), outcome.out.end(), '\n'), 1) << outcome.out;
  const auto result = nlohmann::json::parse(outcome.out, nullptr, false);
  EXPECT_TRUE(result.is_object()) << outcome.out;
  return result;
}

TEST_F(LensCommands, HelpIsThere) {
  for (const char* command : {"import", "export", "project", "unproject"}) {
    const Outcome outcome = run({command, "--help"});
    EXPECT_EQ(outcome.code, 0);
    EXPECT_THAT(outcome.out, HasSubstr("--json"));
  }
}

TEST_F(LensCommands, ProjectAnswersEveryLine) {
  const std::vector<std::pair<std::string, Eigen::Vector3d>> rays{
      {"0 0 1", {0, 0, 1}},
      {"0.3 -0.2 1", {0.3, -0.2, 1}},
      {"\t-30,20 ,  100\r", {-30, 20, 100}},
      {"1 0 -0.01", {1, 0, -0.01}},
      {"0 0 -1", {0, 0, -1}},
      {"0 0 0", {0, 0, 0}},
      {"nan 0 1", {NAN, 0, 1}},
      {"inf 0 1", {INFINITY, 0, 1}},
      {"1e-3 +2E-2 3", {1e-3, 2e-2, 3}}};
  std::string input;
  for (const auto& [line, ray] : rays) input += line + "\n";
  input.pop_back();  // the last line may end without a newline
  const Outcome outcome = run({"project", "--lens", path("lens.yaml")}, input);
  ASSERT_EQ(outcome.code, 0) << outcome.err;
  EXPECT_EQ(outcome.err, "");
  const std::vector<std::string> lines = outcome.lines();
  ASSERT_EQ(lines.size(), rays.size());
  int inside = 0;
  for (std::size_t i = 0; i < rays.size(); ++i) {
    const auto expected = file_.lens->project(rays[i].second);
    if (!expected) {
      EXPECT_EQ(lines[i], "nan nan");
      continue;
    }
    ++inside;
    const auto found = parseNumbers(lines[i]);
    ASSERT_TRUE(found && found->size() == 2) << lines[i];
    EXPECT_EQ((*found)[0], expected->x());
    EXPECT_EQ((*found)[1], expected->y());
  }
  EXPECT_EQ(inside, 5);

  const auto json = object(run({"project", "--lens", path("lens.yaml"), "--json"}, input));
  ASSERT_EQ(json.at("pixels").size(), rays.size());
  EXPECT_EQ(json.size(), 1u);
  EXPECT_TRUE(json["pixels"][4].is_null());
  EXPECT_NEAR(json["pixels"][0][0].get<double>(), 650.25, 1e-9);
}

TEST_F(LensCommands, UnprojectUndoesProject) {
  std::string pixels;
  for (int v = 0; v < 960; v += 60) {
    for (int u = 0; u < 1280; u += 80) pixels += std::to_string(u) + " " + std::to_string(v) + "\n";
  }
  const Outcome rays = run({"unproject", "--lens", path("lens.yaml")}, pixels);
  ASSERT_EQ(rays.code, 0) << rays.err;
  EXPECT_EQ(rays.lines().size(), 256u);
  // Rays outside come back outside.
  const Outcome back = run({"project", "--lens", path("lens.yaml")}, rays.out);
  ASSERT_EQ(back.code, 0) << back.err;
  std::istringstream wanted(pixels);
  int inside = 0;
  for (std::size_t i = 0; i < 256; ++i) {
    double u = 0.0;
    double v = 0.0;
    wanted >> u >> v;
    const auto ray = parseNumbers(rays.lines()[i]);
    ASSERT_TRUE(ray && ray->size() == 3) << rays.lines()[i];
    const auto expected = file_.lens->unproject({u, v});
    ASSERT_EQ(expected.has_value(), rays.lines()[i] != "nan nan nan");
    if (!expected) {
      EXPECT_EQ(back.lines()[i], "nan nan");
      continue;
    }
    ++inside;
    EXPECT_NEAR(std::hypot((*ray)[0], (*ray)[1], (*ray)[2]), 1.0, 1e-12);
    const auto pixel = parseNumbers(back.lines()[i]);
    ASSERT_TRUE(pixel && pixel->size() == 2);
    EXPECT_NEAR((*pixel)[0], u, 1e-6);
    EXPECT_NEAR((*pixel)[1], v, 1e-6);
  }
  EXPECT_GT(inside, 100);
  EXPECT_LT(inside, 256);
  const auto json =
      object(run({"unproject", "--lens", path("lens.yaml"), "--json"}, "0 0\n640 480"));
  ASSERT_EQ(json.at("rays").size(), 2u);
  EXPECT_EQ(json["rays"][1].size(), 3u);
}

TEST_F(LensCommands, NothingInNothingOut) {
  for (const char* command : {"project", "unproject"}) {
    const Outcome outcome = run({command, "--lens", path("lens.yaml")});
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    EXPECT_EQ(outcome.out + outcome.err, "");
  }
}

TEST_F(LensCommands, ALineThatIsNoNumbersIsAnErrorThatNamesIt) {
  struct Row {
    std::string command, good, bad;
  };
  const std::vector<Row> rows{{"project", "0 0 1", "0 zero 1"},
                              {"project", "0 0 1", "0 0"},
                              {"project", "0 0 1", "0 0 1 1"},
                              {"project", "0 0 1", ""},
                              {"project", "0 0 1", "0 0 0x1g"},
                              {"unproject", "5 5", "5"},
                              {"unproject", "5 5", "5 5 5"},
                              {"unproject", "5 5", "5 \x1b[31m"},
                              {"unproject", "5 5", std::string(5000, '1') + " 2"}};
  for (const Row& row : rows) {
    const std::string input = row.good + "\n" + row.good + "\n" + row.bad + "\n" + row.good + "\n";
    const Outcome outcome = run({row.command, "--lens", path("lens.yaml")}, input);
    EXPECT_EQ(outcome.code, 1) << row.bad;
    EXPECT_THAT(outcome.err, AllOf(HasSubstr("line 3"), HasSubstr("expected")));
    EXPECT_EQ(std::count(outcome.err.begin(), outcome.err.end(), '\n'), 1);
    EXPECT_EQ(outcome.err.find('\x1b'), std::string::npos);
    EXPECT_EQ(outcome.lines().size(), 2u) << "what came before is answered";
    const Outcome json = run({row.command, "--lens", path("lens.yaml"), "--json"}, input);
    EXPECT_EQ(json.code, 1);
    EXPECT_EQ(json.out, "");
    EXPECT_EQ(json.err, outcome.err);
  }
}

TEST_F(LensCommands, ImportPassesALensFileThrough) {
  LensStructure structure;
  structure.model = "conic";
  LensFile file;
  file.image_size = {640, 480};
  file.lens = makeLens(structure, {310.0, 250.0}, 150.0, 1.5);
  writeLensFile(path("conic.yaml"), file);
  const auto json =
      object(run({"import", path("conic.yaml"), "--out", path("passed.yaml"), "--json"}));
  EXPECT_EQ(json.at("model"), "conic");
  EXPECT_EQ(json.at("residual_rms_px").get<double>(), 0.0);
  EXPECT_EQ(readLensFile(path("passed.yaml")).lens->parameters(), file.lens->parameters());
  const auto refused =
      run({"import", path("conic.yaml"), "--model", "spline", "--out", path("refit.yaml")});
  EXPECT_EQ(refused.code, 1);
  EXPECT_THAT(refused.err, HasSubstr("lens file already"));
  EXPECT_FALSE(std::filesystem::exists(path("refit.yaml")));
}

TEST_F(LensCommands, ExportNarrowsWhereTheWholeFieldCannotBeSaid) {
  // Kannala and Brandt's four terms cannot follow a surface that turns up at the rim.
  LensStructure structure;
  structure.model = "spline";
  structure.knots = 10;
  LensFile file;
  file.image_size = {1280, 960};
  file.lens = makeLens(structure, {640.0, 480.0}, 300.0, 1.7);
  Eigen::VectorXd numbers = file.lens->parameters();
  numbers[numbers.size() - 1] += 30.0;
  numbers[numbers.size() - 2] += 2.0;
  file.lens = file.lens->withParameters(numbers);
  ASSERT_TRUE(file.lens);
  writeLensFile(path("rim.yaml"), file);
  const auto refused = run({"export", path("rim.yaml"), "--format", "equidistant", "--out",
                            path("rim_info.yaml"), "--max-residual", "0.1"});
  EXPECT_EQ(refused.code, 1);
  EXPECT_THAT(refused.err, HasSubstr("--narrow writes that"));
  EXPECT_FALSE(std::filesystem::exists(path("rim_info.yaml")));
  const Outcome narrowed =
      run({"export", path("rim.yaml"), "--format", "equidistant", "--out", path("rim_info.yaml"),
           "--max-residual", "0.1", "--narrow", "--json"});
  ASSERT_EQ(narrowed.code, 0) << narrowed.err;
  const auto json = nlohmann::json::parse(narrowed.out);
  EXPECT_LE(json.at("residual_rms_px").get<double>(), 0.1);
  EXPECT_GT(json.at("max_theta_rad").get<double>(), 0.8);
  EXPECT_LT(json.at("max_theta_rad").get<double>(), 1.7);
  EXPECT_THAT(narrowed.err, HasSubstr("degrees off the axis are said"));
  const Outcome given = run({"export", path("rim.yaml"), "--format", "equidistant", "--out",
                             path("rim_info.yaml"), "--max-theta", "45", "--json"});
  ASSERT_EQ(given.code, 0) << given.err;
  EXPECT_NEAR(nlohmann::json::parse(given.out).at("max_theta_rad").get<double>(), M_PI / 4, 1e-9);
}

TEST_F(LensCommands, ExportNamesShearThatAModelCannotSay) {
  const std::map<std::string, std::vector<double>> parameters{
      {"f", {310}}, {"alpha", {0.6}}, {"beta", {1.1}}, {"p", {0.004}}, {"q", {0.003}}};
  LensFile file;
  file.image_size = {1280, 960};
  file.lens = makeLens("conic", {640.0, 480.0}, parameters, 1.5, "made");
  writeLensFile(path("shear.yaml"), file);
  const Outcome outcome = run({"export", path("shear.yaml"), "--format", "kalibr", "--out",
                               path("shear_chain.yaml"), "--max-residual", "5", "--json"});
  ASSERT_EQ(outcome.code, 0) << outcome.err;
  EXPECT_THAT(outcome.err, HasSubstr("shear"));
  EXPECT_FALSE(nlohmann::json::parse(outcome.out).at("remarks").empty());
}

TEST_F(LensCommands, ImportWritesALensFile) {
  const auto json =
      object(run({"import", path("chain.yaml"), "--out", path("imported.yaml"), "--json"}));
  EXPECT_EQ(json.at("model"), "spline");
  EXPECT_LE(json.at("residual_rms_px").get<double>(), 0.05);
  EXPECT_GE(json.at("residual_max_px").get<double>(), json["residual_rms_px"].get<double>());
  const LensFile imported = readLensFile(path("imported.yaml"));
  EXPECT_EQ(imported.image_size, cv::Size(1280, 960));
  // The formula of the double sphere along one ray.
  const Eigen::Vector3d n = Eigen::Vector3d(0.5, -0.3, 0.4).normalized();
  const double z = n.z() - 0.2;
  const double k = 0.59 * std::hypot(n.x(), n.y(), z) + 0.41 * z;
  const auto pixel = imported.lens->project(n);
  ASSERT_TRUE(pixel);
  EXPECT_NEAR(pixel->x(), 300 * n.x() / k + 640, 0.05);
  EXPECT_NEAR(pixel->y(), 310 * n.y() / k + 480, 0.05);
}

TEST_F(LensCommands, ExportGoesThereAndComesBack) {
  std::string rays;
  for (int i = 0; i <= 15; ++i) {
    for (int j = 0; j < 8; ++j) {
      rays += formatNumber(std::sin(0.1 * i) * std::cos(j)) + " " +
              formatNumber(std::sin(0.1 * i) * std::sin(j)) + " " +
              formatNumber(std::cos(0.1 * i)) + "\n";
    }
  }
  const std::vector<std::string> before =
      run({"project", "--lens", path("lens.yaml")}, rays).lines();
  ASSERT_EQ(before.size(), 128u);
  for (const std::string format : {"kalibr", "ocam", "equidistant"}) {
    SCOPED_TRACE(format);
    const std::string theirs = path(format + ".theirs");
    const std::string back = path(format + ".yaml");
    const Outcome outcome =
        run({"export", path("lens.yaml"), "--format", format, "--out", theirs, "--json"});
    const auto json = object(outcome);
    EXPECT_EQ(json.at("model"), format == "kalibr" ? "eucm" : format);
    const double rms = json.at("residual_rms_px");
    const double max = json.at("residual_max_px");
    EXPECT_LE(rms, 0.5);
    EXPECT_GE(max, rms);
    EXPECT_NEAR(json.at("max_theta_rad").get<double>(), 1.6, 1e-12);
    // Past 90 degrees not everybody follows the equidistant formula.
    EXPECT_EQ(outcome.err.empty(), format != "equidistant") << outcome.err;

    const std::string from = format == "equidistant" ? "camera_info" : format;
    const auto imported =
        object(run({"import", theirs, "--format", from, "--out", back, "--json"}));
    const double allowed = 1.05 * max + imported.at("residual_max_px").get<double>() + 1e-3;
    const std::vector<std::string> after = run({"project", "--lens", back}, rays).lines();
    ASSERT_EQ(after.size(), before.size());
    for (std::size_t i = 0; i < before.size(); ++i) {
      const auto a = parseNumbers(before[i]);
      const auto b = parseNumbers(after[i]);
      ASSERT_TRUE(a && b);
      EXPECT_LE(std::hypot((*a)[0] - (*b)[0], (*a)[1] - (*b)[1]), allowed) << i;
    }
  }
  EXPECT_EQ(readLensFile(path("equidistant.yaml")).camera_name, "wide");
}

TEST_F(LensCommands, ExportSaysWhatItDidToAPerson) {
  const Outcome outcome = run({"export", path("lens.yaml"), "--format", "kalibr", "--model", "ds",
                               "--max-residual", "50", "--out", path("ds.yaml")});
  ASSERT_EQ(outcome.code, 0) << outcome.err;
  EXPECT_THAT(outcome.out, AllOf(HasSubstr("model: ds\n"), HasSubstr("residual_rms_px: ")));
  EXPECT_THAT(readFile(path("ds.yaml")), HasSubstr("camera_model: ds\n"));
}

TEST_F(LensCommands, RefusalsLeaveNoFile) {
  const std::string lens = path("lens.yaml");
  const std::string chain = path("chain.yaml");
  const std::string old = path("old.yaml");
  writeFileAtomically(path("broken.yaml"), "cam0:\n  camera_model: ds\n  intrinsics: [1, 2]\n");
  const std::string lens_text = readFile(lens);
  for (const std::string& out : {old, path("new.yaml")}) {
    EXPECT_THAT(refusal({"import", path("broken.yaml"), "--out", out}), HasSubstr("broken.yaml"));
    EXPECT_THAT(refusal({"import", path("none.yaml"), "--out", out}), HasSubstr("none.yaml"));
    EXPECT_THAT(refusal({"import", chain, "--camera", "cam7", "--out", out}), HasSubstr("cam7"));
    EXPECT_THAT(refusal({"import", chain, "--model", "quadric", "--max-residual", "0.01", "--json",
                         "--out", out}),
                AllOf(HasSubstr("chain.yaml"), HasSubstr("--max-residual")));
    // Only the conic itself is exact, so neither of these is.
    for (const char* format : {"ocam", "equidistant"}) {
      EXPECT_THAT(refusal({"export", lens, "--format", format, "--max-residual", "1e-9", "--out",
                           out, "--json"}),
                  AllOf(HasSubstr("lens.yaml"), HasSubstr("px RMS"), HasSubstr("--max-residual")));
    }
    EXPECT_THAT(refusal({"export", chain, "--format", "ocam", "--out", out}),
                AllOf(HasSubstr("chain.yaml"), HasSubstr("lens_surface")));
    EXPECT_THAT(refusal({"export", path("none.yaml"), "--format", "ocam", "--out", out}),
                HasSubstr("none.yaml"));
  }
  EXPECT_THAT(refusal({"export", lens, "--format", "ocam", "--out", path("no/new.txt")}),
              HasSubstr("no/new.txt"));
  EXPECT_THAT(refusal({"export", lens, "--format", "ocam", "--out", lens}),
              HasSubstr("input and an output"));
  EXPECT_THAT(refusal({"import", chain, "--out", chain}), HasSubstr("input and an output"));
  EXPECT_EQ(readFile(lens), lens_text);
  EXPECT_THAT(refusal({"project", "--lens", path("none.yaml")}), HasSubstr("none.yaml"));
  EXPECT_THAT(refusal({"unproject", "--lens", chain}), HasSubstr("lens_surface"));
}

TEST_F(LensCommands, WrongUsageIsTwo) {
  const std::string lens = path("lens.yaml");
  const std::string out = path("new.yaml");
  const std::vector<Arguments> calls{
      {},
      {"exports", lens},
      {"project"},
      {"unproject"},
      {"project", "--lens"},
      {"project", "--lens", lens, "--fast"},
      {"unproject", "--lens", lens, "5 5"},
      {"import", "--out", out},
      {"import", path("chain.yaml")},
      {"import", path("chain.yaml"), "--out", out, "--format", "matlab"},
      {"import", path("chain.yaml"), "--out", out, "--model", "auto"},
      {"import", path("chain.yaml"), "--out", out, "--max-residual", "-1"},
      {"export", lens, "--format", "kalibr"},
      {"export", lens, "--out", out},
      {"export", "--format", "kalibr", "--out", out},
      {"export", lens, "--format", "mrcal", "--out", out},
      {"export", lens, "--format", "kalibr", "--out", out, "--max-residual", "much"},
      {"export", lens, "--format", "kalibr", "--out", out, "--model", "fov"},
      {"export", lens, "--format", "ocam", "--out", out, "--model", "ds"}};
  for (const Arguments& call : calls) EXPECT_NE(refusal(call, 2), "");
}

}  // namespace
}  // namespace omnister
