// SPDX-License-Identifier: Apache-2.0
#include "omnister/lens/lens_import.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <functional>
#include <nlohmann/json.hpp>
#include <opencv2/calib3d.hpp>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_file.h"
#include "published_lenses.h"

namespace omnister {
namespace {

using nlohmann::json;
using ::testing::HasSubstr;

using test::asFile;
using test::cameraInfo;
using test::direction;
using test::kalibr;
using test::kDegree;
using test::list;
using test::Residual;
using test::residual;

constexpr double kPi = M_PI;

// ---------------------------------------------------------------- the lenses of others

double median(std::vector<double> values) {
  std::sort(values.begin(), values.end());
  const std::size_t n = values.size();
  return n % 2 == 1 ? values[n / 2] : 0.5 * (values[n / 2 - 1] + values[n / 2]);
}

TEST(ForeignLenses, BecomeSurfaces) {
  const std::filesystem::path path =
      std::filesystem::path(OMNISTER_SOURCE_DIR) / "../shared/data/lenses/lenses.json";
  std::ifstream file(path);
  if (!file) GTEST_SKIP() << path << " is not here";
  const json entries = json::parse(file);
  std::vector<double> splines;
  std::vector<double> aspheres;
  for (const json& entry : entries) {
    const std::string name = entry["name"];
    const std::string text = asFile(entry);
    if (text.empty()) continue;
    const ForeignCamera camera = readForeignCamera(text, name);
    const ForeignField field = foreignField(camera);
    const double limit = std::min(95.0 * kDegree, field.one_to_one);
    const ForeignFit spline = fitForeignCamera(camera, "spline");
    const ForeignFit asphere = fitForeignCamera(camera, "asphere", 2);
    const Residual s = residual(camera, *spline.fit.lens, limit);
    const Residual a = residual(camera, *asphere.fit.lens, limit);
    std::printf(
        "%-56s %-18s to %5.1f (1:1 %5.1f) deg  spline %.4f max %.3f  asphere r^6 %.4f max "
        "%.3f%s%s%s\n",
        name.substr(0, 55).c_str(), camera.model.c_str(), limit / kDegree,
        field.one_to_one / kDegree, s.rms, s.max, a.rms, a.max,
        spline.structure.affinity ? " affinity" : "", spline.structure.turn ? " turn" : "",
        spline.structure.decentring_growth ? " growth"
        : spline.structure.decentring      ? " decentring"
                                           : "");
    EXPECT_LE(s.rms, 0.05) << name;
    splines.push_back(s.rms);
    aspheres.push_back(a.rms);
  }
  std::printf("median: spline %.4f, asphere r^6 %.4f px\n", median(splines), median(aspheres));
  EXPECT_EQ(splines.size(), entries.size() - 1);  // all but the radial polynomial
  EXPECT_LE(median(splines), 0.01);
  EXPECT_LE(median(aspheres), 0.05);
}

// ---------------------------------------------------------------- formulas

// Rays within `max_theta`, compared with a formula of the test's own.
void compare(const ForeignCamera& camera, double max_theta,
             const std::function<Eigen::Vector2d(const Eigen::Vector3d&)>& expected) {
  int compared = 0;
  for (int i = 0; i <= 20; ++i) {
    for (int j = 0; j < 9; ++j) {
      const Eigen::Vector3d n = direction(max_theta * i / 20, 0.7 * j);
      const auto pixel = camera.project(n);
      ASSERT_TRUE(pixel) << n.transpose();
      EXPECT_LT((*pixel - expected(n)).norm(), 1e-6) << n.transpose();
      ++compared;
    }
  }
  EXPECT_EQ(compared, 21 * 9);
}

Eigen::Vector2d byOpenCv(const Eigen::Vector3d& n, const std::vector<double>& D, bool fisheye) {
  const cv::Matx33d K(700, 0, 640, 0, 710, 480, 0, 0, 1);
  const std::vector<cv::Point3d> points{{n.x(), n.y(), n.z()}};
  std::vector<cv::Point2d> pixels;
  if (fisheye) {
    cv::fisheye::projectPoints(points, pixels, cv::Vec3d(), cv::Vec3d(), K, D);
  } else {
    cv::projectPoints(points, cv::Vec3d(), cv::Vec3d(), K, D, pixels);
  }
  return {pixels[0].x, pixels[0].y};
}

constexpr char kK[] = "[700, 0, 640, 0, 710, 480, 0, 0, 1]";

TEST(CameraInfo, ProjectsLikeOpenCv) {
  const std::vector<double> plumb{-0.2, 0.05, 1e-3, -2e-3, -0.01};
  compare(
      readForeignCamera(cameraInfo("plumb_bob", kK, "[-0.2, 0.05, 0.001, -0.002, -0.01]", 5), "x"),
      0.6, [&](const Eigen::Vector3d& n) { return byOpenCv(n, plumb, false); });
  const std::vector<double> rational{0.3, 0.05, 1e-3, -2e-3, 0.01, 0.6, 0.1, 0.02};
  compare(readForeignCamera(cameraInfo("rational_polynomial", kK,
                                       "[0.3, 0.05, 0.001, -0.002, 0.01, 0.6, 0.1, 0.02]", 8),
                            "x"),
          0.9, [&](const Eigen::Vector3d& n) { return byOpenCv(n, rational, false); });
  const std::vector<double> equidistant{-0.02, 0.01, -0.005, 0.001};
  compare(readForeignCamera(cameraInfo("equidistant", kK, "[-0.02, 0.01, -0.005, 0.001]", 4), "x"),
          1.5, [&](const Eigen::Vector3d& n) { return byOpenCv(n, equidistant, true); });
}

TEST(Kalibr, ProjectsByItsFormulas) {
  const auto pixel = [](double x, double y) {
    return Eigen::Vector2d(300 * x + 640, 310 * y + 480);
  };
  const std::vector<double> radtan{-0.1, 0.02, 1e-3, -5e-4};
  const auto bend = [&](double x, double y) {
    const double r2 = x * x + y * y;
    const double radial = 1 + radtan[0] * r2 + radtan[1] * r2 * r2;
    return Eigen::Vector2d(x * radial + 2 * radtan[2] * x * y + radtan[3] * (r2 + 2 * x * x),
                           y * radial + radtan[2] * (r2 + 2 * y * y) + 2 * radtan[3] * x * y);
  };
  compare(readForeignCamera(
              kalibr("omni", "[1.2, 300, 310, 640, 480]", "radtan", "[-0.1, 0.02, 0.001, -0.0005]"),
              "x"),
          1.8, [&](const Eigen::Vector3d& n) {
            const Eigen::Vector2d m = bend(n.x() / (n.z() + 1.2), n.y() / (n.z() + 1.2));
            return pixel(m.x(), m.y());
          });
  compare(readForeignCamera(kalibr("ds", "[-0.2, 0.59, 300, 310, 640, 480]", "none", "[]"), "x"),
          1.9, [&](const Eigen::Vector3d& n) {
            const double z = -0.2 + n.z();
            const double d2 = std::sqrt(n.x() * n.x() + n.y() * n.y() + z * z);
            const double k = 0.59 * d2 + 0.41 * z;
            return pixel(n.x() / k, n.y() / k);
          });
  compare(readForeignCamera(kalibr("eucm", "[0.6, 1.1, 300, 310, 640, 480]", "none", "[]"), "x"),
          1.9, [&](const Eigen::Vector3d& n) {
            const double d = std::sqrt(1.1 * n.head<2>().squaredNorm() + n.z() * n.z());
            const double k = 0.6 * d + 0.4 * n.z();
            return pixel(n.x() / k, n.y() / k);
          });
}

TEST(Kalibr, EucmIsAConicExactly) {
  const ForeignCamera camera = readForeignCamera(
      kalibr("eucm", "[0.6, 1.1, 300, 310, 640, 480]", "none", "[]"), "chain.yaml");
  const ForeignFit fit = fitForeignCamera(camera, "conic");
  EXPECT_LT(fit.fit.max_px, 1e-6);
  EXPECT_TRUE(fit.structure.affinity);
  EXPECT_FALSE(fit.structure.turn);
  const Eigen::VectorXd p = fit.fit.lens->parameters();
  EXPECT_NEAR(p[2], 310.0, 1e-4);
  EXPECT_NEAR(p[3], 0.6, 1e-6);
  EXPECT_NEAR(p[4], 1.1, 1e-6);
  EXPECT_NEAR(p[5], 300.0 / 310.0 - 1.0, 1e-8);
}

TEST(Kalibr, TakesTheCameraAskedFor) {
  std::string chain = kalibr("eucm", "[0.6, 1.1, 300, 310, 640, 480]", "none", "[]");
  std::string second = kalibr("ds", "[-0.2, 0.59, 300, 310, 640, 480]", "none", "[]");
  chain += second.replace(0, 4, "cam1");
  const ForeignCamera first = readForeignCamera(chain, "chain.yaml");
  EXPECT_EQ(first.camera_name, "cam0");
  ASSERT_EQ(first.remarks.size(), 1u);
  EXPECT_THAT(first.remarks[0], HasSubstr("cam0, cam1"));
  const ForeignCamera other = readForeignCamera(chain, "chain.yaml", "kalibr", "cam1");
  EXPECT_EQ(other.model, "ds-none");
  EXPECT_TRUE(other.remarks.empty());
  EXPECT_THROW(readForeignCamera(chain, "chain.yaml", "kalibr", "cam7"), InputError);
}

TEST(OCam, TurnsRowsAndColumnsIntoOurAxes) {
  const std::string text =
      "#poly\n\n3 -200 0 0.002\n\n#inv\n\n2 1 2\n\n#center\n\n243.5 392.25\n\n#affine\n\n"
      "1.001 0.02 -0.03\n\n#size\n\n480 754\n";
  const ForeignCamera camera = readForeignCamera(text, "calib_results.txt");
  EXPECT_EQ(camera.format, "ocam");
  EXPECT_EQ(camera.image_size, cv::Size(754, 480));
  int compared = 0;
  for (double down = -150; down <= 150; down += 50) {
    for (double right = -150; right <= 150; right += 50) {
      const double rho = std::hypot(down, right);
      const Eigen::Vector3d ray(right, down, 200 - 0.002 * rho * rho);
      const Eigen::Vector2d expected(-0.03 * down + right + 392.25,
                                     1.001 * down + 0.02 * right + 243.5);
      const auto pixel = camera.project(ray.normalized());
      ASSERT_TRUE(pixel);
      EXPECT_LT((*pixel - expected).norm(), 1e-6);
      ++compared;
    }
  }
  EXPECT_EQ(compared, 49);
  const ForeignFit fit = fitForeignCamera(camera, "spline");
  EXPECT_LT(fit.fit.rms_px, 0.01);
  EXPECT_TRUE(fit.structure.turn);
}

std::string mrcalModel(const std::string& model, const std::string& intrinsics) {
  return "# a comment\n{\n    'lensmodel':  '" + model + "',\n    'intrinsics': " + intrinsics +
         ",\n    'extrinsics': [ 0, 0, 0, 0, 0, 0,],\n    'imagersize': [ 1280, 960,],\n"
         "    'icam_intrinsics': 0,\n    'optimization_inputs': b'a{}[]#\\'x',\n}\n";
}

TEST(Mrcal, ReadsItsModels) {
  const std::vector<double> opencv8{0.3, 0.05, 1e-3, -2e-3, 0.01, 0.6, 0.1, 0.02};
  const ForeignCamera camera = readForeignCamera(
      mrcalModel("LENSMODEL_OPENCV8",
                 "[700, 710, 640, 480, 0.3, 0.05, 0.001, -0.002, 0.01, 0.6, 0.1, 0.02]"),
      "a.cameramodel");
  EXPECT_EQ(camera.format, "mrcal");
  compare(camera, 0.9, [&](const Eigen::Vector3d& n) { return byOpenCv(n, opencv8, false); });
  // Without any correction a splined model is stereographic.
  std::string zeros = "[400, 400, 640, 480";
  for (int i = 0; i < 2 * 10 * 8; ++i) zeros += ", 0";
  const ForeignCamera splined = readForeignCamera(
      mrcalModel("LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=10_Ny=8_fov_x_deg=150", zeros + "]"),
      "a.cameramodel");
  compare(splined, 1.0, [](const Eigen::Vector3d& n) -> Eigen::Vector2d {
    return Eigen::Vector2d(640, 480) + 800.0 * n.head<2>() / (1.0 + n.z());
  });
}

// ---------------------------------------------------------------- refusals

TEST(Import, RefusesWithFilePlaceAndExpectation) {
  const auto message = [](const std::string& text, const std::string& format) -> std::string {
    try {
      readForeignCamera(text, "their.file", format);
    } catch (const InputError& error) {
      return error.what();
    }
    return "accepted";
  };
  const auto info = [](const std::string& model, const std::string& K, const std::string& D,
                       int count) { return cameraInfo(model, K, D, count); };
  struct Row {
    std::string text;
    std::string format;
    std::vector<std::string> words;
  };
  const std::string ocam = "3 -200 0 0.002\n2 1 2\n243.5 392.25\n1.001 0.02 -0.03\n480 754\n";
  const std::vector<Row> rows{
      {"", "auto", {"empty"}},
      {"hello", "auto", {"none of the known", "--format"}},
      {info("plumb_bob", "[0, 0, 0, 0, 0, 0, 0, 0, 0]", "[]", 0), "auto", {"not calibrated"}},
      {info("plumb_bob", "[700, 0, 640]", "[]", 0), "auto", {"camera_matrix.data", "9 numbers"}},
      {info("plumb_bob", "[.nan, 0, 640, 0, 710, 480, 0, 0, 1]", "[]", 0), "auto", {"finite"}},
      {info("plumb_bob", "[-7, 0, 640, 0, 710, 480, 0, 0, 1]", "[]", 0), "auto", {"-7", "focal"}},
      {info("plumb_bob", kK, "[1, 2, 3]", 3), "auto", {"3 numbers", "k1 k2 p1 p2 k3"}},
      {info("plumb_bob", kK, "[1, 2, 3, 4, 5]", 4), "auto", {"distortion_coefficients.cols"}},
      {info("equidistant", kK, "[1, 2, 3]", 3), "auto", {"3 numbers", "expected 4"}},
      {info("banana", kK, "[]", 0), "auto", {"banana", "plumb_bob"}},
      {kalibr("sphere", "[1, 2, 3, 4]", "none", "[]"), "auto", {"sphere", "eucm", "line 2"}},
      {kalibr("ds", "[1, 2, 3]", "none", "[]"), "auto", {"3 numbers", "xi alpha"}},
      {kalibr("ds", "[0.1, 7, 300, 300, 640, 480]", "none", "[]"), "auto", {"alpha = 7"}},
      {kalibr("pinhole", "[300, 300, 640, 480]", "radtan", "[1]"), "auto", {"1 numbers", "radtan"}},
      {kalibr("pinhole", "[300, 300, 640, 480]", "wavy", "[1]"), "auto", {"wavy"}},
      {kalibr("omni", "[1, 300, 300, 640, 480]", "equidistant", "[1]"), "auto", {"equidistant"}},
      {kalibr("eucm", "[0.6, 1.1, 300, 310, 640, 480]", "none", "[]", 0), "auto", {"resolution"}},
      {"cam0: 3\n", "kalibr", {"no camera"}},
      {ocam + "7\n", "auto", {"line 6", "after the image size"}},
      {"3 -200 0\n", "ocam", {"line", "ends within"}},
      {"3 -200 x 1\n", "ocam", {"line 1", "expected numbers"}},
      {"3 200 0 1\n2 1 2\n1 1\n1 0 0\n480 754\n", "ocam", {"negative"}},
      {"1e9 1\n", "ocam", {"line 1", "1 to 100"}},
      {"3 -200 0 nan\n", "ocam", {"line 1", "finite"}},
      {mrcalModel("LENSMODEL_PINHOLE", "[1, 2, 3]"), "auto", {"3 numbers", "expected 4", "line 4"}},
      {mrcalModel("LENSMODEL_CAHVORE", "[1, 2, 3]"), "auto", {"CAHVORE", "LENSMODEL_OPENCV8"}},
      {mrcalModel("LENSMODEL_PINHOLE", "'x'"), "auto", {"intrinsics", "list of numbers"}},
      {mrcalModel("LENSMODEL_PINHOLE", "[1, 2, 3, nan]"), "auto", {"finite"}},
      {mrcalModel("LENSMODEL_SPLINED_STEREOGRAPHIC_order=9_Nx=10_Ny=8_fov_x_deg=1", "[1]"),
       "auto",
       {"order"}},
      {"{ 'lensmodel': 'LENSMODEL_PINHOLE', ", "mrcal", {"line 1"}},
      {"{ 'lensmodel': " + std::string(5000, '['), "mrcal", {"nested"}},
      {std::string(5000, '{'), "mrcal", {"their.file"}},
  };
  for (const Row& row : rows) {
    const std::string text = message(row.text, row.format);
    EXPECT_THAT(text, HasSubstr("their.file"));
    for (const std::string& word : row.words) EXPECT_THAT(text, HasSubstr(word)) << row.text;
  }
  EXPECT_THROW(readForeignCamera(ocam, "x", "ocam", "cam0"), InputError);
}

}  // namespace
}  // namespace omnister
