// SPDX-License-Identifier: Apache-2.0
#include "omnister/lens/lens_export.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <cstdio>
#include <filesystem>
#include <opencv2/calib3d.hpp>
#include <sstream>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_import.h"
#include "omnister/lens/lens_models.h"
#include "unit/lens/projection_residual.h"

namespace omnister {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;
using test::direction;
using test::Residual;
using ::testing::HasSubstr;

constexpr double kPi = 3.14159265358979323846;

struct Named {
  std::string name;
  LensFile file;
};

LensFile made(const LensStructure& structure, cv::Size size, Vector2d center,
              const std::map<std::string, std::vector<double>>& parameters, double max_theta) {
  LensFile out;
  out.image_size = size;
  out.lens = makeLens(structure.model, center, parameters, max_theta, "made");
  return out;
}

// The package's own lenses, and made ones of every kind of surface.
std::vector<Named> lenses() {
  std::vector<Named> out;
  const std::filesystem::path folder = std::filesystem::path(OMNISTER_SOURCE_DIR) / "config/lenses";
  for (const char* name : {"equidistant_180", "equidistant_180_small", "equisolid_195"}) {
    out.push_back({name, readLensFile(folder / (std::string(name) + ".yaml"))});
  }
  const cv::Size size(1280, 960);
  const Vector2d center(650.2, 471.3);
  out.push_back({"quadric, 160 degrees", made({"quadric"}, size, center,
                                              {{"R0", {330}}, {"a", {36.3}}, {"b", {36.3}}}, 1.4)});
  out.push_back(
      {"conic with aspect, 190 degrees",
       made({"conic"}, size, center,
            {{"f", {310}}, {"alpha", {0.6}}, {"beta", {1.1}}, {"p", {0.01}}, {"q", {0}}}, 1.66)});
  out.push_back(
      {"conic with shear, 190 degrees",
       made({"conic"}, size, center,
            {{"f", {310}}, {"alpha", {0.6}}, {"beta", {1.1}}, {"p", {0.004}}, {"q", {0.002}}},
            1.66)});
  out.push_back({"asphere, 150 degrees",
                 made({"asphere"}, {1920, 1080}, {955, 545},
                      {{"f", {600}}, {"alpha", {0.55}}, {"beta", {1.05}}, {"a4", {0.004}}}, 1.3)});
  return out;
}

// On a grid that the export does not know.
template <typename Project>
Residual residual(const LensModel& lens, double max_theta, const Project& project) {
  std::vector<double> thetas;
  for (int i = 0; i <= 120; ++i) thetas.push_back(max_theta * (1.0 - 1e-9) * i / 120);
  return test::projectionResidual(
      thetas, 45, 0.1, [&lens](const Vector3d& n) { return lens.project(n); }, project);
}

TEST(LensExport, ComesBackToTheStatedResidual) {
  int round_trips = 0;
  for (const Named& lens : lenses()) {
    for (const std::string& format : exportFormats()) {
      SCOPED_TRACE(lens.name + " as " + format);
      const LensExport out = exportLens(lens.file, format);
      std::printf("%-32s %-20s %.4f px RMS, %.4f max, to %.1f degrees\n", lens.name.c_str(),
                  out.model.c_str(), out.residual_rms_px, out.residual_max_px,
                  out.max_theta_rad * 180.0 / kPi);
      EXPECT_LE(out.residual_rms_px, 0.5);
      EXPECT_GE(out.residual_max_px, out.residual_rms_px);
      EXPECT_LE(out.max_theta_rad, lens.file.lens->maxTheta());

      const ForeignCamera camera = readForeignCamera(out.text, "exported");
      EXPECT_EQ(camera.image_size, lens.file.image_size);
      const Residual source = residual(*lens.file.lens, out.max_theta_rad, camera.project);
      EXPECT_LE(source.rms, 1.05 * out.residual_rms_px + 1e-4);
      EXPECT_LE(source.max, 1.05 * out.residual_max_px + 1e-4);
      if (format != "ocam") {
        EXPECT_GE(source.rms, 0.95 * out.residual_rms_px - 1e-4);
      }

      const ForeignFit back = fitForeignCamera(camera, "spline");
      const double field = std::min(out.max_theta_rad, back.fit.lens->maxTheta());
      EXPECT_GT(field, out.max_theta_rad - 0.02);
      const Residual there_and_back = residual(
          *lens.file.lens, field, [&](const Vector3d& n) { return back.fit.lens->project(n); });
      EXPECT_LE(there_and_back.rms, 1.05 * out.residual_rms_px + 0.02);
      ++round_trips;
    }
  }
  EXPECT_EQ(round_trips, 7 * 3);
}

std::string kalibr(const std::string& model, const std::string& intrinsics,
                   const std::string& distortion, const std::string& coefficients) {
  return "cam0:\n  camera_model: " + model + "\n  intrinsics: " + intrinsics +
         "\n  distortion_model: " + distortion + "\n  distortion_coeffs: " + coefficients +
         "\n  resolution: [1280, 960]\n  rostopic: /cam0/image_raw\n";
}

TEST(LensExport, FindsTheKalibrModelALensCameFrom) {
  struct Row {
    std::string model;
    std::string text;
  };
  const std::vector<Row> rows{
      {"eucm", kalibr("eucm", "[0.6, 1.1, 300, 310, 640, 480]", "none", "[]")},
      {"ds", kalibr("ds", "[-0.2, 0.59, 300, 310, 640, 480]", "none", "[]")},
      {"omni-radtan",
       kalibr("omni", "[1.13, 640, 645, 640, 480]", "radtan", "[-0.25, 0.01, 0.001, -0.0005]")},
      {"pinhole-equidistant",
       kalibr("pinhole", "[330, 331, 640, 480]", "equidistant", "[-0.02, 0.015, -0.012, 0.003]")}};
  for (const Row& row : rows) {
    SCOPED_TRACE(row.model);
    const ForeignCamera camera = readForeignCamera(row.text, row.model);
    const ForeignFit fit = fitForeignCamera(camera, "spline");
    ASSERT_LT(fit.fit.rms_px, 0.05);
    LensFile file;
    file.image_size = camera.image_size;
    file.lens = fit.fit.lens;
    const LensExport out = exportLens(file, "kalibr");
    EXPECT_EQ(out.model, row.model);
    EXPECT_LT(out.residual_rms_px, fit.fit.rms_px + 0.02);
    ASSERT_EQ(out.tried.size(), kalibrExportModels().size());
    for (const auto& [name, rms] : out.tried) {
      EXPECT_GE(rms, name == out.model ? 0.0 : out.residual_rms_px) << name;
      const LensExport alone = [&] {
        try {
          return exportLens(file, "kalibr", name);
        } catch (const Error&) {
          return LensExport();
        }
      }();
      if (std::isfinite(rms)) {
        EXPECT_EQ(alone.model, name);
        EXPECT_EQ(alone.residual_rms_px, rms) << name;
      } else {
        EXPECT_EQ(alone.text, "") << name;
      }
    }
  }
}

TEST(LensExport, AConicIsExactlyEucm) {
  const Named lens = lenses()[4];
  const LensExport out = exportLens(lens.file, "kalibr");
  EXPECT_EQ(out.model, "eucm");
  EXPECT_LT(out.residual_max_px, 1e-5);
  EXPECT_EQ(exportLens(lens.file, "kalibr").text, out.text);
  EXPECT_THAT(out.text, HasSubstr("camera_model: eucm"));
}

TEST(LensExport, EquidistantIsWhatOpenCvReads) {
  for (const Named& lens : lenses()) {
    SCOPED_TRACE(lens.name);
    const LensExport out = exportLens(lens.file, "equidistant");
    const auto data = [&](const std::string& key) {
      const std::size_t block = out.text.find("\n" + key + ":");
      const std::size_t begin = out.text.find('[', block) + 1;
      return *parseNumbers(out.text.substr(begin, out.text.find(']', begin) - begin));
    };
    const std::vector<double> k = data("camera_matrix");
    const std::vector<double> D = data("distortion_coefficients");
    ASSERT_EQ(k.size(), 9u);
    ASSERT_EQ(D.size(), 4u);
    const cv::Matx33d K(k.data());
    const Residual found =
        residual(*lens.file.lens, std::min(1.5, out.max_theta_rad),
                 [&](const Vector3d& n) -> std::optional<Vector2d> {
                   const std::vector<cv::Point3d> points{{n.x(), n.y(), n.z()}};
                   std::vector<cv::Point2d> pixels;
                   cv::fisheye::projectPoints(points, pixels, cv::Vec3d(), cv::Vec3d(), K, D);
                   return Vector2d(pixels[0].x, pixels[0].y);
                 });
    EXPECT_LE(found.max, 1.05 * out.residual_max_px + 1e-4);
  }
}

// cam2world and world2cam as OCamCalib's own C code has them.
TEST(LensExport, BothPolynomialsOfOCamCalibSayTheSame) {
  for (const Named& lens : lenses()) {
    SCOPED_TRACE(lens.name);
    const LensExport out = exportLens(lens.file, "ocam");
    std::istringstream text(out.text);
    std::vector<double> numbers;
    for (std::string line; std::getline(text, line);) {
      const auto found = parseNumbers(line.substr(0, line.find('#')));
      ASSERT_TRUE(found) << line;
      numbers.insert(numbers.end(), found->begin(), found->end());
    }
    std::size_t next = 0;
    const auto take = [&](std::size_t count) {
      std::vector<double> taken;
      while (taken.size() < count) taken.push_back(numbers.at(next++));
      return taken;
    };
    const std::vector<double> pol = take(static_cast<std::size_t>(take(1)[0]));
    const std::vector<double> invpol = take(static_cast<std::size_t>(take(1)[0]));
    const std::vector<double> center = take(2);
    const std::vector<double> cde = take(3);
    const std::vector<double> size = take(2);
    EXPECT_EQ(next, numbers.size());
    EXPECT_EQ(size[0], lens.file.image_size.height);
    EXPECT_EQ(pol.at(1), 0.0);

    double worst_angle = 0.0;
    const Residual found = residual(
        *lens.file.lens, out.max_theta_rad, [&](const Vector3d& n) -> std::optional<Vector2d> {
          // Its frame: x down, y right, z backward.
          const Vector3d M(n.y(), n.x(), -n.z());
          const double norm = M.head<2>().norm();
          if (norm == 0.0) return Vector2d(center[1], center[0]);
          const double theta = std::atan(M.z() / norm);
          double rho = 0.0;
          for (std::size_t i = invpol.size(); i-- > 0;) rho = rho * theta + invpol[i];
          const double x = M.x() / norm * rho;
          const double y = M.y() / norm * rho;
          const Vector2d pixel(x * cde[2] + y + center[1], x * cde[0] + y * cde[1] + center[0]);
          // And back.
          const double invdet = 1.0 / (cde[0] - cde[1] * cde[2]);
          const double xp = invdet * ((pixel.y() - center[0]) - cde[1] * (pixel.x() - center[1]));
          const double yp =
              invdet * (-cde[2] * (pixel.y() - center[0]) + cde[0] * (pixel.x() - center[1]));
          const double r = std::hypot(xp, yp);
          double zp = 0.0;
          for (std::size_t i = pol.size(); i-- > 0;) zp = zp * r + pol[i];
          const Vector3d back = Vector3d(xp, yp, zp).normalized();
          worst_angle = std::max(worst_angle, std::acos(std::min(1.0, back.dot(M))));
          return pixel;
        });
    EXPECT_LE(found.rms, 1.05 * out.residual_rms_px + 1e-4);
    EXPECT_LE(found.max, 1.05 * out.residual_max_px + 1e-4);
    EXPECT_LT(worst_angle, 1e-4);
  }
}

TEST(LensExport, RefusesWhatHasNoSuchCamera) {
  LensFile beside;
  beside.image_size = {100, 100};
  beside.lens = makeLens(LensStructure{}, {5000, 50}, 100.0, 1.5);
  EXPECT_THROW(exportLens(beside, "kalibr"), Error);
  const Named lens = lenses()[0];
  EXPECT_THROW(exportLens(lens.file, "mrcal"), Error);
  EXPECT_THROW(exportLens(lens.file, "kalibr", "fov"), Error);
}

}  // namespace
}  // namespace omnister
