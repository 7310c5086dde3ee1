// SPDX-License-Identifier: Apache-2.0
#include "omnister/lens/lens_file.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <cstdlib>
#include <fstream>
#include <random>

#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/lens/lens_models.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;
using ::testing::HasSubstr;
using ::testing::Not;

constexpr char kGood[] = R"(image_width: 1280
image_height: 960
camera_name: wide
camera_matrix:
  rows: 3
  cols: 3
  data: [300, 0, 640, 0, 300, 480, 0, 0, 1]
distortion_model: equidistant
distortion_coefficients:
  rows: 1
  cols: 4
  data: [0, 0, 0, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [300, 0, 640, 0, 0, 300, 480, 0, 0, 0, 1, 0]
lens_surface:
  version: 1
  model: conic
  center: [640.5, 480.25]
  max_theta: 1.62
  parameters:
    f: 300.125
    alpha: 0.6
    beta: 1.1
  calibration:
    rms_px: 0.21
    views: 20
    date: "2024-05-01T10:00:00Z"
)";

std::string replaced(std::string text, const std::string& what, const std::string& by) {
  const std::size_t place = text.find(what);
  EXPECT_NE(place, std::string::npos) << what;
  return text.replace(place, what.size(), by);
}

std::string messageOf(const std::string& text) {
  try {
    parseLensFile(text, "wide.yaml");
  } catch (const InputError& error) {
    return error.what();
  }
  return "accepted";
}

LensFile sample(const LensStructure& structure, double max_theta = 1.7) {
  LensFile file;
  file.image_size = {1280, 960};
  file.camera_name = "wide";
  file.lens = makeLens(structure, {641.23456789012345, 479.1}, 300.0 / 3.0, max_theta);
  Eigen::VectorXd p = file.lens->parameters();
  std::mt19937 random(3);
  std::normal_distribution<double> gauss;
  for (int i = 2; i < p.size(); ++i)
    p[i] += 1e-5 * std::abs(p[i]) * gauss(random) + 1e-7 * gauss(random);
  file.lens = file.lens->withParameters(p);
  EXPECT_NE(file.lens, nullptr);
  const Eigen::MatrixXd root = Eigen::MatrixXd::Random(p.size(), p.size());
  Eigen::MatrixXd covariance = 1e-9 * root * root.transpose();
  file.covariance = (0.5 * (covariance + covariance.transpose())).eval();
  file.stage_axis = Eigen::Vector3d(1.0, 2.0, -0.5).normalized();
  file.calibration.rms_px = 0.1 + 0.2;
  file.calibration.holdout_rms_px = 1.0 / 3.0;
  file.calibration.views = 20;
  file.calibration.points = 1234;
  file.calibration.date = "2024-05-01T10:00:00Z";
  file.calibration.notes["structure"] = "asphere: 2 terms, \"affinity\"";
  file.calibration.notes["no"] = "true";
  return file;
}

class LensFileOnDisk : public ::testing::Test {
 protected:
  const test::TemporaryFolder temporary_;
  const fs::path folder_ = temporary_.path();
};

TEST(LensFile, ReadsTheDocumentedForm) {
  const LensFile file = parseLensFile(kGood, "wide.yaml");
  EXPECT_EQ(file.image_size, cv::Size(1280, 960));
  EXPECT_EQ(file.camera_name, "wide");
  ASSERT_NE(file.lens, nullptr);
  EXPECT_EQ(file.lens->model(), "conic");
  EXPECT_EQ(file.lens->maxTheta(), 1.62);
  Eigen::VectorXd expected(5);
  expected << 640.5, 480.25, 300.125, 0.6, 1.1;
  EXPECT_EQ(file.lens->parameters(), expected);
  EXPECT_EQ(file.calibration.rms_px, 0.21);
  EXPECT_EQ(file.calibration.views, 20);
  EXPECT_FALSE(file.calibration.points);
  EXPECT_EQ(file.calibration.date, "2024-05-01T10:00:00Z");
  EXPECT_FALSE(file.covariance);
}

TEST(LensFile, ReadsAnyValidYaml) {
  const LensFile file = parseLensFile(
      "{lens_surface: {parameters: {beta: 1.1, alpha: 0.6, f: [300.125]}, max_theta: 1.62e0,\n"
      " center: [640.5, 480.25], model: 'conic', version: 1}, image_height: 960, image_width: "
      "1280}",
      "wide.yaml");
  EXPECT_EQ(file.lens->parameters(), parseLensFile(kGood, "").lens->parameters());
  EXPECT_NO_THROW(parseLensFile("%YAML:1.0\n---\n" + std::string(kGood), "wide.yaml"));
}

TEST(LensFile, ComesBackBitForBit) {
  int models = 0;
  for (const std::string& model : lensModelNames()) {
    LensStructure structure;
    structure.model = model;
    structure.even_terms = 3;
    structure.knots = 16;
    structure.affinity = true;
    structure.decentring = model == "asphere" || model == "spline";
    const LensFile file = sample(structure, model == "spherical" ? 1.4 : 1.7);
    const std::string text = formatLensFile(file);
    const LensFile back = parseLensFile(text, model);
    EXPECT_EQ(back.lens->parameters(), file.lens->parameters()) << model;
    EXPECT_EQ(back.lens->maxTheta(), file.lens->maxTheta());
    EXPECT_EQ(back.lens->parameterNames(), file.lens->parameterNames());
    EXPECT_EQ(*back.covariance, *file.covariance);
    EXPECT_EQ(*back.stage_axis, *file.stage_axis);
    EXPECT_EQ(back.camera_name, file.camera_name);
    EXPECT_EQ(back.image_size, file.image_size);
    EXPECT_EQ(back.calibration.rms_px, file.calibration.rms_px);
    EXPECT_EQ(back.calibration.holdout_rms_px, file.calibration.holdout_rms_px);
    EXPECT_EQ(back.calibration.points, file.calibration.points);
    EXPECT_EQ(back.calibration.notes, file.calibration.notes);
    EXPECT_EQ(formatLensFile(back), text);
    ++models;
  }
  EXPECT_EQ(models, 5);
}

TEST(LensFile, HasTheLiteralLayout) {
  LensStructure structure;
  structure.model = "asphere";
  structure.even_terms = 1;
  const std::string text = formatLensFile(sample(structure));
  EXPECT_THAT(text, HasSubstr("image_width: 1280\nimage_height: 960\ncamera_name: wide\n"
                              "camera_matrix:\n  rows: 3\n  cols: 3\n  data: ["));
  EXPECT_THAT(text, HasSubstr("\ndistortion_model: equidistant\n"));
  EXPECT_THAT(text,
              HasSubstr("\nlens_surface:\n  version: 1\n  model: asphere\n  center: [641.2345678"));
  EXPECT_THAT(text, HasSubstr("\n  max_theta: 1.7\n  parameters:\n    f: "));
  EXPECT_THAT(text, HasSubstr("\n  covariance: ["));
  EXPECT_THAT(text, HasSubstr("\n  calibration:\n    rms_px: 0.3"));
  EXPECT_THAT(text, Not(HasSubstr("nan")));
  // No number that a YAML 1.1 reader takes for text: an exponent without a point.
  for (std::size_t i = text.find("e-"); i != std::string::npos; i = text.find("e-", i + 1)) {
    const std::size_t begin = text.find_last_of(" [", i);
    EXPECT_NE(text.substr(begin, i - begin).find('.'), std::string::npos) << text.substr(begin, 24);
  }
}

TEST(LensFile, OddNamesComeBack) {
  LensStructure structure;
  LensFile file = sample(structure);
  for (const std::string name : {"", "true", "12", "a: b", "# c", "quote\"back\\slash", "tab\there",
                                 "line\nbreak", "caf\xC3\xA9", "~", "- x", "0x10", "null"}) {
    file.camera_name = name;
    EXPECT_EQ(parseLensFile(formatLensFile(file), "x").camera_name, name);
  }
}

TEST(LensFile, WritesTheNearestStandardModelOnlyWhenItIsNear) {
  LensStructure structure;
  structure.model = "spline";
  LensFile file;
  file.image_size = {1280, 960};
  file.lens = makeLens(structure, {640.0, 480.0}, 350.0, 1.7);  // equidistant itself
  const auto near = nearestStandardModel(*file.lens, file.image_size);
  ASSERT_TRUE(near);
  EXPECT_LT(near->worst_residual_px, 1e-6);
  EXPECT_EQ(near->distortion_model, "equidistant");
  EXPECT_NEAR(near->K(0, 0), 350.0, 1e-3);
  EXPECT_NEAR(near->K(1, 2), 480.0, 1e-3);

  // An elliptic quadric is none.
  structure.model = "quadric";
  const LensPtr round = makeLens(structure, {640.0, 480.0}, 350.0, 1.7);
  Eigen::VectorXd p = round->parameters();
  p[4] *= 1.3;
  file.lens = round->withParameters(p);
  EXPECT_FALSE(nearestStandardModel(*file.lens, file.image_size));
  const std::string text = formatLensFile(file);
  EXPECT_THAT(
      text, HasSubstr("camera_matrix:\n  rows: 3\n  cols: 3\n  data: [0, 0, 0, 0, 0, 0, 0, 0, 0]"));
  EXPECT_THAT(text, HasSubstr("distortion_model: \"\"\n"));
  EXPECT_THAT(text, HasSubstr("distortion_coefficients:\n  rows: 1\n  cols: 0\n  data: []\n"));
  EXPECT_THAT(text, HasSubstr("equidistant_residual_px: "));
  EXPECT_NO_THROW(parseLensFile(text, "x"));
}

TEST(LensFile, StandardModelProjectsLikeTheLens) {
  LensStructure structure;
  structure.model = "conic";
  const LensPtr lens = makeLens(structure, {655.0, 470.0}, 330.0, 1.6);
  const auto info = nearestStandardModel(*lens, {1280, 960});
  ASSERT_TRUE(info);
  double worst = 0.0;
  int compared = 0;
  for (int u = 0; u < 1280; u += 20) {
    for (int v = 0; v < 960; v += 20) {
      const auto n = lens->unproject(Eigen::Vector2d(u, v));
      if (!n) continue;
      const double s = n->head<2>().norm();
      if (s == 0.0) continue;
      const double theta = std::atan2(s, n->z());
      const double t = theta * theta;
      const double r =
          theta * (1 + t * (info->D[0] + t * (info->D[1] + t * (info->D[2] + t * info->D[3]))));
      const Eigen::Vector2d pixel(info->K(0, 2) + info->K(0, 0) * r * n->x() / s,
                                  info->K(1, 2) + info->K(1, 1) * r * n->y() / s);
      worst = std::max(worst, (pixel - Eigen::Vector2d(u, v)).norm());
      ++compared;
    }
  }
  EXPECT_GT(compared, 2000);
  EXPECT_NEAR(worst, info->worst_residual_px, 0.2 * worst + 1e-6);
}

TEST(LensFile, RefusesWithFileKeyAndExpectation) {
  struct Row {
    std::string text;
    std::vector<std::string> words;
  };
  const std::string good = kGood;
  const auto with = [&](const std::string& what, const std::string& by) {
    return replaced(good, what, by);
  };
  const std::string surface = good.substr(good.find("lens_surface:"));
  const std::vector<Row> rows{
      {"", {"not a YAML mapping"}},
      {"just a word", {"not a YAML mapping"}},
      {"[1, 2, 3]", {"not a YAML mapping"}},
      {"a: [1, 2", {"not YAML"}},
      {good + "---\n" + good, {"line ", "begins another YAML document"}},
      {"\x01\x02\x7f", {"wide.yaml"}},
      {std::string("\0\0\0\0", 4), {"wide.yaml"}},
      {"\xff\xfe\xfd", {"wide.yaml"}},
      {with("lens_surface:", "lens_surfaces:"), {"lens_surface", "missing", "omnister import"}},
      {good.substr(0, good.find("lens_surface:")), {"lens_surface", "missing", "omnister import"}},
      {with("lens_surface:\n", "lens_surface: 3\nx:\n"), {"lens_surface", "not a mapping"}},
      {surface, {"image_width", "missing"}},
      {with("image_width: 1280", "image_width: 0"), {"image_width", "is 0", "1 to 65535"}},
      {with("image_width: 1280", "image_width: -1280"), {"image_width", "-1280"}},
      {with("image_width: 1280", "image_width: 12.5"), {"image_width", "12.5", "whole"}},
      {with("image_width: 1280", "image_width: 1e12"), {"image_width", "65535"}},
      {with("image_width: 1280", "image_width: wide"),
       {"image_width (line 1)", "\"wide\"", "number"}},
      {with("image_width: 1280", "image_width: [1280]"), {"image_width", "list"}},
      {with("image_width: 1280\n", "image_width: 1280\nimage_width: 1281\n"),
       {"image_width", "twice"}},
      {with("rows: 3", "rows: 4"), {"camera_matrix.rows", "is 4"}},
      {with("rows: 3", "rows: -1"), {"camera_matrix.rows", "is -1"}},
      {with("rows: 3\n  cols: 3", "rows: 100000\n  cols: 100000"), {"camera_matrix.rows"}},
      {with("data: [300, 0,", "data: [0,"), {"camera_matrix.data", "8 entries", "9 numbers"}},
      {with("data: [300, 0,", "data: [.nan, 0,"), {"camera_matrix.data[0]", ".nan", "finite"}},
      {with("data: [300, 0,", "data: [.inf, 0,"), {"camera_matrix.data[0]", "finite"}},
      {with("data: [300, 0,", "data: [nan, 0,"), {"camera_matrix.data[0]", "finite"}},
      {with("cols: 4\n  data: [0, 0, 0, 0]", "cols: 4\n  data: [0, 0, 0]"),
       {"distortion_coefficients.data"}},
      {with("cols: 4\n  data: [0, 0, 0, 0]", "cols: 1000000\n  data: [0]"),
       {"distortion_coefficients.cols"}},
      {with("data: [1, 0, 0, 0, 1", "data: [one, 0, 0, 0, 1"),
       {"rectification_matrix.data[0]", "\"one\""}},
      {with("cols: 4\n  data: [300", "cols: 3\n  data: [300"), {"projection_matrix.cols"}},
      {with("version: 1", "version: 2"), {"lens_surface.version", "is 2", "expected 1"}},
      {with("  version: 1\n", ""), {"lens_surface.version", "missing"}},
      {with("model: conic", "model: pinhole"),
       {"lens_surface.model", "pinhole", "spherical, quadric"}},
      {with("model: conic", "model: [conic]"), {"lens_surface.model", "list"}},
      {with("model: conic", "model: \"a\\nb\""), {"lens_surface.model", "a\\x0ab"}},
      {with("  center: [640.5, 480.25]\n", ""), {"lens_surface.center", "missing"}},
      {with("[640.5, 480.25]", "[640.5]"), {"lens_surface.center", "1 entries", "2 numbers"}},
      {with("[640.5, 480.25]", "640.5"), {"lens_surface.center", "not a list"}},
      {with("[640.5, 480.25]", "[.nan, 480.25]"), {"lens_surface.center[0]", "finite"}},
      {with("[640.5, 480.25]", "[1e300, 480.25]"), {"wide.yaml"}},
      {with("[640.5, 480.25]", "[1e999, 480.25]"), {"lens_surface.center[0]", "1e999"}},
      {with("max_theta: 1.62", "max_theta: -1"), {"lens_surface.max_theta", "-1"}},
      {with("max_theta: 1.62", "max_theta: 95"), {"lens_surface.max_theta", "95", "pi"}},
      {with("max_theta: 1.62", "max_theta: .nan"), {"lens_surface.max_theta", "finite"}},
      {with("max_theta: 1.62", "max_theta:"), {"lens_surface.max_theta", "missing"}},
      {with("max_theta: 1.62", "max_theta: 3.0"), {"one-to-one"}},
      {with("    f: 300.125\n", ""), {"parameters.f", "missing"}},
      {with("f: 300.125", "f: -300"), {"parameters", "one-to-one"}},
      {with("f: 300.125", "f: 0"), {"parameters", "one-to-one"}},
      {with("f: 300.125", "f: 1e300"), {"parameters"}},
      {with("f: 300.125", "f: many"), {"lens_surface.parameters.f", "many"}},
      {with("f: 300.125", "f: {a: 1}"), {"lens_surface.parameters.f", "mapping"}},
      {with("f: 300.125", "f: [[1]]"), {"lens_surface.parameters.f[0]", "list"}},
      {with("f: 300.125", "f: 300.125\n    f: 301"), {"parameters", "twice"}},
      {with("f: 300.125", "f: 300.125\n    g: 301"), {"parameters.g", "no parameter"}},
      {with("f: 300.125", "? [a, b]\n    : 3\n    f: 3"), {"parameters", "plain word"}},
      {with("  parameters:\n", "  parameters: 3\n  other:\n"),
       {"lens_surface.parameters", "mapping"}},
      {with("  calibration:", "  covariance: [1, 2]\n  calibration:"),
       {"covariance", "2 entries", "25 numbers"}},
      {with("  calibration:", "  covariance: x\n  calibration:"), {"covariance", "list"}},
      {with("  calibration:", "  stage_axis: [1, 1, 1]\n  calibration:"), {"stage_axis", "unit"}},
      {with("rms_px: 0.21", "rms_px: -1"), {"calibration.rms_px", "negative"}},
      {with("views: 20", "views: 1.5"), {"calibration.views", "whole"}},
      {with("  calibration:\n", "  calibration: 7\n  other:\n"), {"calibration", "mapping"}},
      {"lens_surface: &a [*a]", {"wide.yaml"}},
      {std::string(100000, '['), {"wide.yaml"}},
      {std::string(100000, '{'), {"wide.yaml"}},
      {"lens_surface: " + std::string(20000, '[') + std::string(20000, ']'), {"wide.yaml"}},
  };
  int checked = 0;
  for (const Row& row : rows) {
    const std::string message = messageOf(row.text);
    EXPECT_THAT(message, HasSubstr("wide.yaml")) << row.text.substr(0, 200);
    for (const std::string& word : row.words) {
      EXPECT_THAT(message, HasSubstr(word)) << row.text.substr(0, 60);
    }
    EXPECT_EQ(message.find('\n'), std::string::npos);
    EXPECT_LT(message.size(), 1100u);
    ++checked;
  }
  EXPECT_EQ(checked, static_cast<int>(rows.size()));
}

TEST(LensFile, NegativeOrSkewCovarianceIsRefused) {
  LensStructure structure;
  LensFile file = sample(structure);
  const std::string text = formatLensFile(file);
  LensFile bad = file;
  (*bad.covariance)(1, 0) += 1.0;
  EXPECT_THAT(messageOf(formatLensFile(bad)), HasSubstr("covariance"));
  bad = file;
  (*bad.covariance)(2, 2) = -1e-9;
  EXPECT_THAT(messageOf(formatLensFile(bad)), HasSubstr("negative variance in row 3"));
  bad.covariance = Eigen::MatrixXd::Identity(3, 3);
  EXPECT_THROW(formatLensFile(bad), Error);
}

// Bytes knocked about at random: refused or read, never a crash.
TEST(LensFile, SurvivesBrokenBytes) {
  std::mt19937 random(5);
  int refused = 0;
  int read = 0;
  const std::string good = kGood;
  for (int i = 0; i < 2000; ++i) {
    std::string text = good;
    const int changes = 1 + static_cast<int>(random() % 4);
    for (int k = 0; k < changes; ++k) {
      if (text.empty()) break;
      const std::size_t place = random() % text.size();
      switch (random() % 4) {
        case 0:
          text[place] = static_cast<char>(random());
          break;
        case 1:
          text.erase(place, 1 + random() % 20);
          break;
        case 2:
          text.insert(place, 1, "[]{}:,-#&*!|>'\"%@`\n\t 9e."[random() % 24]);
          break;
        default:
          text.resize(std::min(text.size(), std::max<std::size_t>(place, 1)));
      }
    }
    try {
      const LensFile file = parseLensFile(text, "x");
      ASSERT_NE(file.lens, nullptr);
      ASSERT_TRUE(file.lens->parameters().allFinite());
      ++read;
    } catch (const InputError&) {
      ++refused;
    }
  }
  EXPECT_EQ(refused + read, 2000);
  EXPECT_GT(refused, 500);
  EXPECT_GT(read, 50);
}

TEST_F(LensFileOnDisk, WritesKeepingThePrevious) {
  const fs::path path = folder_ / "wide.yaml";
  LensStructure structure;
  LensFile file = sample(structure);
  writeLensFile(path, file);
  const std::string first = readFile(path);
  file.camera_name = "other";
  writeLensFile(path, file);
  EXPECT_EQ(readLensFile(path).camera_name, "other");
  EXPECT_EQ(readFile(path.string() + "~"), first);
  file.lens = nullptr;
  EXPECT_THROW(writeLensFile(path, file), Error);
  EXPECT_EQ(readLensFile(path).camera_name, "other");
  EXPECT_EQ(std::distance(fs::directory_iterator(folder_), fs::directory_iterator()), 2);
}

TEST_F(LensFileOnDisk, MissingOrHugeIsAnError) {
  EXPECT_THROW(readLensFile(folder_ / "none.yaml"), Error);
  EXPECT_THROW(readLensFile(folder_), Error);
  std::ofstream(folder_ / "huge.yaml") << std::string(8u << 20, 'x');
  EXPECT_THROW(readLensFile(folder_ / "huge.yaml"), Error);
  EXPECT_THROW(writeLensFile(folder_ / "no" / "folder.yaml", sample({})), Error);
}

}  // namespace
}  // namespace omnister
