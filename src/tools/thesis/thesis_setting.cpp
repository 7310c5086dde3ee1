// SPDX-License-Identifier: Apache-2.0
#include "tools/thesis/thesis_setting.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>

#include "omnister/calibration/calibrate.h"
#include "omnister/common/error.h"
#include "omnister/lens/lens_fit.h"
#include "omnister/lens/lens_models.h"

namespace omnister::tools::thesis {

LensPtr lensOf(const std::function<double(double)>& radius, const Vector2d& center,
               double max_theta, double aspect) {
  std::vector<Vector3d> bearings;
  std::vector<Vector2d> pixels;
  for (int i = 1; i <= 120; ++i) {
    const double theta = max_theta * (i - 1e-6) / 120.0;
    for (int j = 0; j < 8; ++j) {
      const double azimuth = (j + 0.5) * kPi / 4.0;
      bearings.emplace_back(std::sin(theta) * std::cos(azimuth),
                            std::sin(theta) * std::sin(azimuth), std::cos(theta));
      pixels.push_back(center +
                       radius(theta) * Vector2d(std::cos(azimuth) * aspect, std::sin(azimuth)));
    }
  }
  LensStructure structure;
  structure.model = "spline";
  structure.knots = 24;
  structure.affinity = aspect != 1.0;
  const LensPtr start = makeLens(structure, center, radius(1e-3) / 1e-3, max_theta);
  return fitLens(*start, bearings, pixels).lens;
}

std::vector<Shape> lensShapes(double scale) {
  const cv::Size size(static_cast<int>(std::lround(kWidth * scale)),
                      static_cast<int>(std::lround(kHeight * scale)));
  const Vector2d center(0.5 * (size.width - 1) + 8.0 * scale,
                        0.5 * (size.height - 1) - 6.0 * scale);
  const double f = kFocalPx * scale;
  std::vector<Shape> shapes;
  shapes.push_back(
      {"equisolid", "r = 2 f sin(theta/2), f = 16 mm",
       lensOf([=](double t) { return 2.0 * f * std::sin(0.5 * t); }, center, 75.0 * kDegree),
       size});
  shapes.push_back({"equidistant", "r = f theta, f = 16 mm",
                    lensOf([=](double t) { return f * t; }, center, 75.0 * kDegree), size});
  // OpenCV's fisheye test rig, left camera: modules/calib3d/test/test_fisheye.cpp of opencv/opencv.
  const double k[4] = {-0.0014613319981768, -0.00329861110580401, 0.00605760088590183,
                       -0.00374209380722371};
  const double real = 559.492426609594 * size.width / 1280.0;
  shapes.push_back(
      {"real lens", "fisheye of OpenCV's test rig (Kannala-Brandt, test_fisheye.cpp), enlarged",
       lensOf(
           [=](double t) {
             const double t2 = t * t;
             return real * t * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
           },
           center, 80.0 * kDegree),
       size});
  return shapes;
}

double slopeOf(const LensModel& lens) {
  Jacobian23 d;
  if (!lens.project(Vector3d::UnitZ(), &d)) return std::numeric_limits<double>::quiet_NaN();
  return std::sqrt(std::abs(d.leftCols<2>().determinant()));
}

bool inside(const Vector2d& pixel, cv::Size size, double border) {
  return pixel.x() > border && pixel.y() > border && pixel.x() < size.width - 1 - border &&
         pixel.y() < size.height - 1 - border;
}

ViewDetections squareBoard(const Shape& shape, double limit, double pitch, std::mt19937& random) {
  std::normal_distribution<double> noise(0.0, kNoisePx);
  ViewDetections view;
  view.name = "dot board square to the axis";
  const int reach = static_cast<int>(std::tan(limit) / pitch) + 1;
  for (int y = -reach; y <= reach; ++y) {
    for (int x = -reach; x <= reach; ++x) {
      const Vector3d point(pitch * x, pitch * y, 1.0);
      if (std::atan(point.head<2>().norm()) > limit) continue;
      const auto pixel = shape.lens->project(point);
      if (!pixel || !inside(*pixel, shape.size)) continue;
      view.pixels.push_back(*pixel + Vector2d(noise(random), noise(random)));
      view.points.emplace_back(point.x(), point.y(), 0.0);
    }
  }
  return view;
}

Detections tiltedBoards(const Shape& shape, std::mt19937& random) {
  std::normal_distribution<double> noise(0.0, kNoisePx);
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  Detections detections;
  detections.image_size = shape.size;
  for (int i = 0; i < 400 && detections.views.size() < 16; ++i) {
    Pose pose = Pose::Identity();
    pose.linear() = (Eigen::AngleAxisd(40.0 * kDegree * uniform(random), Vector3d::UnitX()) *
                     Eigen::AngleAxisd(40.0 * kDegree * uniform(random), Vector3d::UnitY()) *
                     Eigen::AngleAxisd(kPi * uniform(random), Vector3d::UnitZ()))
                        .toRotationMatrix();
    const double distance = 0.55 + 0.2 * uniform(random);
    pose.translation() = Vector3d(0.8 * uniform(random), 0.5 * uniform(random), distance);
    ViewDetections view;
    view.name = "board " + std::to_string(i);
    for (int y = 0; y < 10; ++y) {
      for (int x = 0; x < 14; ++x) {
        const Vector3d point(0.06 * (x - 6.5), 0.06 * (y - 4.5), 0.0);
        const Vector3d X = pose * point;
        if (X.z() < 0.1) continue;
        const auto pixel = shape.lens->project(X);
        if (!pixel || !inside(*pixel, shape.size)) continue;
        view.pixels.push_back(*pixel + Vector2d(noise(random), noise(random)));
        view.points.push_back(point);
      }
    }
    if (view.pixels.size() >= 40) detections.views.push_back(std::move(view));
  }
  return detections;
}

Detections straightEdges(const Shape& shape, std::mt19937& random) {
  std::normal_distribution<double> noise(0.0, kNoisePx);
  Detections detections;
  detections.image_size = shape.size;
  const double half = 0.5 * std::min(shape.size.width, shape.size.height);
  for (int i = 0; i < 8; ++i) {
    // The tangent plane's line at this distance from the axis, to this side.
    const double azimuth = i * kPi / 4.0 + 0.1;
    const Vector2d side(std::cos(azimuth), std::sin(azimuth));
    const auto foot =
        shape.lens->unproject(shape.lens->center() + (i % 2 == 0 ? 0.65 : 0.85) * half * side);
    if (!foot) continue;
    const double away = foot->head<2>().norm() / foot->z();
    ViewDetections line;
    line.name = "edge " + std::to_string(i + 1);
    for (int k = -150; k <= 150; ++k) {
      const Vector2d at = away * side + 0.01 * k * Vector2d(-side.y(), side.x());
      if (std::atan(at.norm()) > kDewarpLimit) continue;
      const auto pixel = shape.lens->project(Vector3d(at.x(), at.y(), 1.0));
      if (!pixel || !inside(*pixel, shape.size)) continue;
      line.pixels.push_back(*pixel + Vector2d(noise(random), noise(random)));
      line.points.emplace_back(0.0, 0.0, 0.0);
    }
    detections.views.push_back(std::move(line));
  }
  return detections;
}

Found findModels(const Shape& shape, const ViewDetections& board, const Detections& boards,
                 const Detections& edges, int threads) {
  Found found;
  ProcedureOptions procedure;
  try {
    ProcedureOptions with_center;
    with_center.center = findCenterOfDistortion(board, shape.size).center;
    found.models.push_back(
        {"spherical (thesis: straight lines)", calibrateByLines(edges, with_center).file.lens, ""});
  } catch (const Error& error) {
    found.models.push_back({"spherical (thesis: straight lines)", nullptr, error.what()});
  }
  try {
    found.quadric = calibrateQuadric(board, shape.size, procedure);
    found.models.push_back({"quadric (thesis procedure)", found.quadric->file.lens, ""});
  } catch (const Error& error) {
    found.models.push_back({"quadric (thesis procedure)", nullptr, error.what()});
  }
  for (const char* name : {"quadric", "conic", "asphere"}) {
    CalibrationOptions options;
    options.threads = threads;
    LensStructure structure;
    structure.model = name;
    structure.even_terms = std::string(name) == "asphere" ? 2 : 0;
    options.structure = structure;
    options.board_warp = false;
    try {
      found.models.push_back(
          {std::string(name) + " (our fit)", calibrate(boards, options).file.lens, ""});
    } catch (const Error& error) {
      found.models.push_back({std::string(name) + " (our fit)", nullptr, error.what()});
    }
  }
  try {
    found.models.push_back(
        {"spherical (dot board)", calibrateByDots(board, shape.size, procedure).file.lens, ""});
  } catch (const Error& error) {
    found.models.push_back({"spherical (dot board)", nullptr, error.what()});
  }
  return found;
}

}  // namespace omnister::tools::thesis
