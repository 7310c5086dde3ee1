// SPDX-License-Identifier: Apache-2.0
#include "evaluate_thesis.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <map>
#include <opencv2/imgproc.hpp>
#include <optional>
#include <random>
#include <set>
#include <vector>

#include "html_plot.h"
#include "omnister/calibration/calibrate.h"
#include "omnister/calibration/thesis_procedures.h"
#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "omnister/lens/lens_fit.h"
#include "omnister/lens/lens_models.h"
#include "omnister/sim/renderer.h"
#include "omnister/stereo/thesis_matcher.h"
#include "omnister/view/view.h"

namespace omnister::tools {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;
using Json = nlohmann::ordered_json;

constexpr double kPi = 3.14159265358979323846;
constexpr double kDegree = kPi / 180.0;
constexpr double kInch = 0.0254;

// Kodak DCS460c: 27.6 x 18.4 mm, 3060 x 2036 pixels of 9 um (Johnson 1997, sec. 4.3).
constexpr int kWidth = 3060;
constexpr int kHeight = 2036;
constexpr double kFocalPx = 16.0 / 0.009;
// Table 5.1: 3.635 mm are 2.10 %, 16.38 mm are 9.48 % of this distance.
constexpr double kBoardDistance = 0.173;
constexpr double kBaseline = 2.0 * kInch;
/// Of simulated corners, an axis [px].
constexpr double kNoisePx = 0.1;
/// Beyond this off-axis angle a dewarped picture has no use any more.
constexpr double kDewarpLimit = 60.0 * kDegree;

/// A lens that is taken for the truth.
struct Shape {
  std::string name;
  std::string formula;
  LensPtr lens;
  cv::Size size;
};

/// A lens found from boards, and which way.
struct Model {
  std::string name;
  LensPtr lens;     ///< null where the way to it failed
  std::string why;  ///< then the reason
};

LensPtr lensOf(const std::function<double(double)>& radius, const Vector2d& center,
               double max_theta, double aspect = 1.0) {
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

/// Pixels per radian on the axis: Johnson's R0.
double slopeOf(const LensModel& lens) {
  Jacobian23 d;
  if (!lens.project(Vector3d::UnitZ(), &d)) return std::numeric_limits<double>::quiet_NaN();
  return std::sqrt(std::abs(d.leftCols<2>().determinant()));
}

std::optional<Vector2d> dewarp(const LensModel& lens, double R0, const Vector2d& pixel) {
  const auto ray = lens.unproject(pixel);
  if (!ray || ray->z() < 0.05) return std::nullopt;
  return Vector2d(R0 * ray->head<2>() / ray->z());
}

bool inside(const Vector2d& pixel, cv::Size size, double border = 2.0) {
  return pixel.x() > border && pixel.y() > border && pixel.x() < size.width - 1 - border &&
         pixel.y() < size.height - 1 - border;
}

/// A dot board square to the axis, a row and a column through the centre; unit: its distance.
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

/// Boards held by hand, tilted to all sides, over the whole image.
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

/// Edge pixels of straight edges that cross the image between half radius and border (sec. 4.1.1).
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

struct Found {
  /// By straight lines, by the thesis' quadric, by our quadric, conic and asphere, by dots.
  std::vector<Model> models;
  std::optional<QuadricProcedure> quadric;
};

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

/// Table 4.1 for one lens.
struct DewarpStatistics {
  double mean_px = 0.0, max_px = 0.0, min_px = 1e9, mean_percent = 0.0;
  double ray_rms_deg = 0.0, ray_max_deg = 0.0;
  double R0 = 0.0, R0_error = 0.0;
  int points = 0, lost = 0;
  std::vector<std::pair<Vector2d, Vector2d>> pairs;  ///< true and dewarped (u, v) [px]
};

DewarpStatistics dewarpStatistics(const Shape& shape, const LensModel& lens,
                                  const ViewDetections& board) {
  DewarpStatistics s;
  const double truth = slopeOf(*shape.lens);
  s.R0 = slopeOf(lens);
  s.R0_error = s.R0 / truth - 1.0;
  double percent = 0.0;
  int percents = 0;
  for (std::size_t i = 0; i < board.pixels.size(); ++i) {
    const Vector2d wanted = truth * board.points[i].head<2>();
    const auto uv = dewarp(lens, s.R0, board.pixels[i]);
    if (!uv) {
      ++s.lost;
      continue;
    }
    const double error = (*uv - wanted).norm();
    s.pairs.emplace_back(wanted, *uv);
    s.mean_px += error;
    s.max_px = std::max(s.max_px, error);
    s.min_px = std::min(s.min_px, error);
    ++s.points;
    if (wanted.norm() > 1.0) {
      percent += 100.0 * error / wanted.norm();
      ++percents;
    }
  }
  s.mean_px /= std::max(1, s.points);
  s.mean_percent = percent / std::max(1, percents);
  double sum = 0.0;
  int count = 0;
  const int step = std::max(4, shape.size.width / 100);
  for (int v = 0; v < shape.size.height; v += step) {
    for (int u = 0; u < shape.size.width; u += step) {
      const auto a = shape.lens->unproject(Vector2d(u, v));
      const auto b = lens.unproject(Vector2d(u, v));
      if (!a || !b) continue;
      const double angle = std::atan2(a->cross(*b).norm(), a->dot(*b)) / kDegree;
      sum += angle * angle;
      s.ray_max_deg = std::max(s.ray_max_deg, angle);
      ++count;
    }
  }
  s.ray_rms_deg = std::sqrt(sum / std::max(1, count));
  return s;
}

// ---------------------------------------------------------------- stereo on the random board

sim::ScenePtr randomBoard(double distance) {
  char text[800];
  std::snprintf(text, sizeof text,
                "version: 1\nbackground: [0, 0, 0]\nambient: 1.0\ntextures:\n"
                "  pattern: {type: noise, colors: [[0, 0, 0], [255, 255, 255]], scale: %.5f, "
                "octaves: 5, persistence: 0.8, seed: 7}\nobjects:\n"
                "  - {type: plane, position: [0, 0, %.5f], size: [%.3f, %.3f], texture: pattern}\n",
                0.05 * distance, distance, 40.0 * distance, 40.0 * distance);
  return sim::parseScene(text, "random-pattern board");
}

struct StereoPair {
  cv::Mat reference, displaced;
  cv::Mat mask;
  Pose T_ref_disp = Pose::Identity();
  int asked = 0;
  int corners_asked = 0;
};

/// Images of the random-pattern board, and a grid of pixels to measure.
StereoPair renderPair(const Shape& shape, double distance, double baseline, int step, double limit,
                      int threads) {
  StereoPair pair;
  pair.T_ref_disp.translation() = Vector3d(-baseline, 0.0, 0.0);
  const sim::Renderer renderer(*shape.lens, shape.size, threads);
  const sim::ScenePtr scene = randomBoard(distance);
  sim::RenderOptions options;
  options.adaptive = true;
  options.color = false;
  options.noise_sigma = 1.0;
  options.threads = threads;
  pair.reference = renderer.render(*scene, Pose::Identity(), options).image;
  options.seed = 2;
  pair.displaced = renderer.render(*scene, pair.T_ref_disp, options).image;
  pair.mask = cv::Mat::zeros(shape.size, CV_8UC1);
  for (int v = step / 2; v < shape.size.height; v += step) {
    for (int u = step / 2; u < shape.size.width; u += step) {
      const auto ray = shape.lens->unproject(Vector2d(u, v));
      if (!ray || std::acos(ray->z()) > limit) continue;
      // Only what the other image shows as well can be matched.
      const Vector3d X = distance / ray->z() * *ray - pair.T_ref_disp.translation();
      const auto other = shape.lens->project(X);
      if (!other || !inside(*other, shape.size, 12.0)) continue;
      if (!inside(Vector2d(u, v), shape.size, 12.0)) continue;
      pair.mask.at<uchar>(v, u) = 255;
      ++pair.asked;
      if (std::acos(ray->z()) > 45.0 * kDegree) ++pair.corners_asked;
    }
  }
  return pair;
}

/// Table 5.1 for one lens: distances of the measured points from a plane fitted to them.
struct DepthStatistics {
  double mean_mm = 0.0, max_mm = 0.0, mean_percent = 0.0, max_percent = 0.0;
  double rms_mm = 0.0;
  double distance_m = 0.0;  ///< of the fitted plane
  double matched = 0.0;     ///< share of the pixels asked for whose match is right to 5 % in depth
                            ///< of the plane
  double corners_matched = 0.0;  ///< the same beyond 45 degrees off the axis
  double seconds = 0.0;
  struct Point {
    Vector2d pixel;
    Vector3d X;
    double residual = 0.0;  ///< along the axis [m]
  };
  std::vector<Point> points;  ///< right matches
};

DepthStatistics depthStatistics(const Shape& shape, const LensModel& model, LensPtr lens,
                                const StereoPair& pair, double distance, ThesisMask mask,
                                int threads) {
  StereoGeometry geometry;
  geometry.reference_lens = lens;
  geometry.reference_size = shape.size;
  geometry.displaced = {{lens, shape.size, pair.T_ref_disp}};
  MatcherOptions options;
  options.min_range = 0.55 * distance;
  options.max_range = 6.0 * distance;
  options.threads = threads;
  options.mask = pair.mask;
  ThesisOptions thesis;
  thesis.mask = mask;
  const MatchResult match =
      makeThesisMatcher(geometry, options, thesis)->match(pair.reference, {pair.displaced});
  DepthStatistics s;
  s.seconds = match.statistics.seconds.count("total") ? match.statistics.seconds.at("total") : 0.0;
  std::vector<DepthStatistics::Point> all;
  for (int v = 0; v < shape.size.height; ++v) {
    for (int u = 0; u < shape.size.width; ++u) {
      if (pair.mask.at<uchar>(v, u) == 0) continue;
      const float range = match.range.at<float>(v, u);
      const auto ray = model.unproject(Vector2d(u, v));
      if (!std::isfinite(range) || !ray) continue;
      all.push_back({Vector2d(u, v), range * *ray, 0.0});
    }
  }
  if (all.size() < 10) return s;
  // z = a x + b y + c, robustly: half of the points at least are supposed to be right.
  std::vector<char> good(all.size(), 1);
  Vector3d plane(0.0, 0.0, distance);
  std::vector<double> depths;
  for (const auto& point : all) depths.push_back(point.X.z());
  std::nth_element(depths.begin(), depths.begin() + static_cast<std::ptrdiff_t>(depths.size() / 2),
                   depths.end());
  plane.z() = depths[depths.size() / 2];
  for (int iteration = 0; iteration < 12; ++iteration) {
    // From coarse to the final bound, which table 5.1's worst figure (9.48 %) is within.
    const double bound = std::max(0.12, 0.4 * std::pow(0.8, iteration)) * plane.z();
    Eigen::Matrix3d M = Eigen::Matrix3d::Zero();
    Vector3d rhs = Vector3d::Zero();
    for (std::size_t i = 0; i < all.size(); ++i) {
      const Vector3d row(all[i].X.x(), all[i].X.y(), 1.0);
      good[i] = std::abs(row.dot(plane) - all[i].X.z()) < bound;
      if (!good[i]) continue;
      M += row * row.transpose();
      rhs += row * all[i].X.z();
    }
    const Vector3d next = M.ldlt().solve(rhs);
    if (!next.allFinite()) break;
    plane = next;
  }
  s.distance_m = plane.z() / std::sqrt(1.0 + plane.head<2>().squaredNorm());
  int corners = 0;
  for (std::size_t i = 0; i < all.size(); ++i) {
    if (!good[i]) continue;
    auto point = all[i];
    point.residual = point.X.z() - plane.dot(Vector3d(point.X.x(), point.X.y(), 1.0));
    const double mm = std::abs(point.residual) * 1e3;
    s.mean_mm += mm;
    s.rms_mm += mm * mm;
    s.max_mm = std::max(s.max_mm, mm);
    const auto ray = shape.lens->unproject(point.pixel);
    if (ray && std::acos(ray->z()) > 45.0 * kDegree) ++corners;
    s.points.push_back(point);
  }
  const double count = std::max<std::size_t>(1, s.points.size());
  s.mean_mm /= count;
  s.rms_mm = std::sqrt(s.rms_mm / count);
  s.mean_percent = 0.1 * s.mean_mm / s.distance_m;
  s.max_percent = 0.1 * s.max_mm / s.distance_m;
  s.matched = static_cast<double>(s.points.size()) / std::max(1, pair.asked);
  s.corners_matched =
      pair.corners_asked > 0 ? static_cast<double>(corners) / pair.corners_asked : 0.0;
  return s;
}

// ---------------------------------------------------------------- drawings

struct Range {
  double low = 1e300, high = -1e300;
  void add(double value) {
    low = std::min(low, value);
    high = std::max(high, value);
  }
  void widen(double share = 0.05) {
    const double room = std::max(1e-9, high - low) * share;
    low -= room;
    high += room;
  }
};

std::string dewarpPlot(const DewarpStatistics& s) {
  Range x, y;
  for (const auto& [wanted, uv] : s.pairs) {
    x.add(wanted.x());
    y.add(wanted.y());
  }
  x.widen();
  y.widen();
  Plot plot(520, 520.0 * (y.high - y.low) / (x.high - x.low) + 40, x.low, x.high, y.high, y.low);
  plot.color(0.0, 0.0, 0.0);
  for (const auto& [wanted, uv] : s.pairs) plot.dot(wanted.x(), wanted.y(), 2.0);
  plot.color(0.8, 0.1, 0.1);
  for (const auto& [wanted, uv] : s.pairs) {
    plot.line(wanted.x(), wanted.y(), uv.x(), uv.y());
    plot.dot(uv.x(), uv.y(), 1.5);
  }
  return asImage(plot.finish("u [px]", "v [px]"));
}

std::string depthMap(const DepthStatistics& s, cv::Size size, double step) {
  Plot plot(520, 520.0 * size.height / size.width + 40, 0, size.width, size.height, 0);
  const double most = 0.1 * s.distance_m;
  for (const auto& point : s.points) {
    const double level = std::clamp(point.residual / most, -1.0, 1.0);
    plot.color(level > 0 ? 1.0 : 1.0 + level, 1.0 - std::abs(level), level < 0 ? 1.0 : 1.0 - level);
    plot.box(point.pixel.x() - 0.5 * step, point.pixel.y() - 0.5 * step,
             point.pixel.x() + 0.5 * step, point.pixel.y() + 0.5 * step);
    plot.color(0.6, 0.6, 0.6);
    plot.dot(point.pixel.x(), point.pixel.y(), 0.7);
  }
  return asImage(plot.finish("u [px]", "v [px]"));
}

/// The plane seen from below: depth over x.
std::string depthProfile(const DepthStatistics& s) {
  Range x, z;
  for (const auto& point : s.points) {
    x.add(1e3 * point.X.x());
    z.add(1e3 * point.X.z());
  }
  x.widen();
  z.add(0.9e3 * s.distance_m);
  z.add(1.1e3 * s.distance_m);
  Plot plot(520, 300, x.low, x.high, z.low, z.high);
  plot.color(0.1, 0.3, 0.8);
  for (const auto& point : s.points) plot.dot(1e3 * point.X.x(), 1e3 * point.X.z());
  return asImage(plot.finish("x [mm]", "depth [mm]"));
}

std::string axisErrorPlot(const DepthStatistics& s, double center_v, double step) {
  Range x, e;
  e.add(-2.0);
  e.add(2.0);
  std::vector<DepthStatistics::Point> row;
  for (const auto& point : s.points) {
    if (std::abs(point.pixel.y() - center_v) > 1.6 * step) continue;
    row.push_back(point);
    x.add(1e3 * point.X.x());
    e.add(1e3 * point.residual);
  }
  if (row.size() < 2) return "<p>no match along the axis</p>";
  x.widen();
  e.widen();
  Plot plot(520, 260, x.low, x.high, e.low, e.high);
  plot.color(0.7, 0.7, 0.7);
  plot.line(x.low, 0, x.high, 0);
  plot.color(0.1, 0.3, 0.8);
  for (const auto& point : row) plot.dot(1e3 * point.X.x(), 1e3 * point.residual, 2.0);
  return asImage(plot.finish("x [mm]", "error [mm]", 1));
}

cv::Mat shrunk(const cv::Mat& image, int width) {
  if (image.cols <= width) return image;
  cv::Mat small;
  cv::resize(image, small, cv::Size(width, std::max(1, image.rows * width / image.cols)), 0, 0,
             cv::INTER_AREA);
  return small;
}

/// Forward mapping: every pixel of the image goes to its place in the dewarped plane (figs 4.2 and
/// 4.12).
struct Forward {
  cv::Mat picture;
  double gaps = 0.0;      ///< share of the dewarped pixels that get nothing, within the field
  double gaps_rim = 0.0;  ///< beyond 45 degrees
};

Forward forwardMap(const LensModel& lens, const cv::Mat& image, double limit) {
  const double R0 = slopeOf(lens);
  const double reach = R0 * std::tan(limit);
  const int side = 2 * static_cast<int>(reach) + 1;
  // The image shows less than a square of that reach.
  cv::Mat1b picture(side, side, uchar{0});
  cv::Mat1b hit(side, side, uchar{0});
  int top = side, bottom = 0, left = side, right = 0;
  for (int v = 0; v < image.rows; ++v) {
    for (int u = 0; u < image.cols; ++u) {
      const auto uv = dewarp(lens, R0, Vector2d(u, v));
      if (!uv || uv->norm() > reach) continue;
      const int x = static_cast<int>(std::lround(uv->x() + side / 2));
      const int y = static_cast<int>(std::lround(uv->y() + side / 2));
      if (x < 0 || y < 0 || x >= side || y >= side) continue;
      picture(y, x) = image.at<uchar>(v, u);
      hit(y, x) = 1;
      top = std::min(top, y);
      bottom = std::max(bottom, y);
      left = std::min(left, x);
      right = std::max(right, x);
    }
  }
  Forward result;
  std::size_t seen = 0, empty = 0, seen_rim = 0, empty_rim = 0;
  for (int y = top; y <= bottom; ++y) {
    for (int x = left; x <= right; ++x) {
      const Vector3d ray(x - side / 2, y - side / 2, R0);
      if (ray.head<2>().norm() > reach) continue;
      const auto pixel = lens.project(ray);
      if (!pixel || !inside(*pixel, image.size(), 1.0)) continue;
      const bool rim = ray.head<2>().norm() > R0;
      ++seen;
      seen_rim += rim;
      if (hit(y, x) == 0) {
        ++empty;
        empty_rim += rim;
      }
    }
  }
  result.gaps = static_cast<double>(empty) / std::max<std::size_t>(1, seen);
  result.gaps_rim = static_cast<double>(empty_rim) / std::max<std::size_t>(1, seen_rim);
  // A part towards the corner at full size shows the gaps.
  const int part = std::min({400, right - left + 1, bottom - top + 1});
  const int x0 = std::clamp(side / 2 + static_cast<int>(0.62 * reach), left, right - part + 1);
  const int y0 = std::clamp(side / 2 + static_cast<int>(0.3 * reach), top, bottom - part + 1);
  result.picture = picture(cv::Rect(x0, y0, part, part)).clone();
  return result;
}

/// How many dewarped pixels lie in each distorted one (fig. 5.1), and how large the dewarped
/// picture is.
struct ManyToOne {
  cv::Mat picture;
  int most = 0;
  std::vector<std::pair<double, double>> by_radius;  ///< radius as a share of the half diagonal
  double dewarped_pixels = 0.0;                      ///< of the rectangle around the picture
  int width = 0, height = 0;
};

ManyToOne manyToOne(const LensModel& lens, cv::Size size) {
  ManyToOne result;
  const double R0 = slopeOf(lens);
  double right = 0.0, bottom = 0.0, left = 0.0, top = 0.0;
  for (int i = 0; i <= 400; ++i) {
    const double s = i / 400.0;
    for (const Vector2d& pixel :
         {Vector2d(s * (size.width - 1), 0.0), Vector2d(s * (size.width - 1), size.height - 1.0),
          Vector2d(0.0, s * (size.height - 1)),
          Vector2d(size.width - 1.0, s * (size.height - 1))}) {
      const auto uv = dewarp(lens, R0, pixel);
      if (!uv) continue;
      left = std::min(left, uv->x());
      right = std::max(right, uv->x());
      top = std::min(top, uv->y());
      bottom = std::max(bottom, uv->y());
    }
  }
  result.width = static_cast<int>(std::ceil(right - left)) + 1;
  result.height = static_cast<int>(std::ceil(bottom - top)) + 1;
  result.dewarped_pixels = static_cast<double>(result.width) * result.height;
  cv::Mat1w count(size, ushort{0});
  for (int y = static_cast<int>(top); y <= static_cast<int>(bottom); ++y) {
    for (int x = static_cast<int>(left); x <= static_cast<int>(right); ++x) {
      const auto pixel = lens.project(Vector3d(x, y, R0));
      if (!pixel) continue;
      const int u = static_cast<int>(std::lround(pixel->x()));
      const int v = static_cast<int>(std::lround(pixel->y()));
      if (u < 0 || v < 0 || u >= size.width || v >= size.height) continue;
      ++count(v, u);
    }
  }
  const Vector2d center = lens.center();
  const double half = 0.5 * std::hypot(size.width, size.height);
  std::vector<double> sums(12, 0.0), counts(12, 0.0);
  for (int v = 0; v < size.height; ++v) {
    for (int u = 0; u < size.width; ++u) {
      result.most = std::max(result.most, static_cast<int>(count(v, u)));
      const int ring =
          std::min(11, static_cast<int>(12.0 * (Vector2d(u, v) - center).norm() / half));
      sums[ring] += count(v, u);
      counts[ring] += 1.0;
    }
  }
  for (int i = 0; i < 12; ++i) {
    if (counts[i] > 0) result.by_radius.emplace_back((i + 0.5) / 12.0, sums[i] / counts[i]);
  }
  cv::Mat grey;
  count.convertTo(grey, CV_8U, 255.0 / std::max(1, result.most));
  result.picture = shrunk(grey, 520);
  return result;
}

cv::Mat boardPicture(const Shape& shape, int threads) {
  const sim::ScenePtr scene = sim::parseScene(
      "version: 1\nbackground: [90, 90, 90]\nambient: 1.0\ntextures:\n"
      "  dots: {type: dots, size: 0.12, radius: 0.035, share: 1.0, seed: 1, "
      "colors: [[245, 245, 245], [20, 20, 20]]}\n"
      "objects:\n  - {type: plane, position: [0, 0, 1], size: [3.6, 2.4], texture: dots}\n",
      "dot board");
  sim::RenderOptions options;
  options.adaptive = true;
  options.color = false;
  options.threads = threads;
  return sim::render(*scene, *shape.lens, shape.size, Pose::Identity(), options).image;
}

/// Distinct reference pixels in a mask that is a square of the dewarped plane (fig. 5.4), as a
/// share of the mask, around a pixel so far off the axis.
double distinctShare(const LensModel& lens, const Vector2d& pixel, int window) {
  const double R0 = slopeOf(lens);
  const auto middle = dewarp(lens, R0, pixel);
  if (!middle) return std::numeric_limits<double>::quiet_NaN();
  std::set<std::pair<long, long>> distinct;
  for (int y = -window / 2; y <= window / 2; ++y) {
    for (int x = -window / 2; x <= window / 2; ++x) {
      const auto at = lens.project(Vector3d(middle->x() + x, middle->y() + y, R0));
      if (at) distinct.emplace(std::lround(at->x()), std::lround(at->y()));
    }
  }
  return static_cast<double>(distinct.size()) / (window * window);
}

/// The outline of a mask of the reference image as the displaced one sees it (figs 5.3 and 5.5).
std::string windowPlot(const Shape& shape, double distance, double baseline) {
  const double half = 0.02 * shape.size.width;
  Plot plot(520, 520.0 * shape.size.height / shape.size.width + 40, 0, shape.size.width,
            shape.size.height, 0);
  const auto outline = [&](const Vector2d& middle, bool displaced) {
    std::optional<Vector2d> last;
    for (int i = 0; i <= 80; ++i) {
      const double s = i % 20 / 10.0 - 1.0;
      const int side = i / 20 % 4;
      const Vector2d offset = side == 0   ? Vector2d(s, -1)
                              : side == 1 ? Vector2d(1, s)
                              : side == 2 ? Vector2d(-s, 1)
                                          : Vector2d(-1, -s);
      std::optional<Vector2d> at = Vector2d(middle + half * offset);
      if (displaced) {
        const auto ray = shape.lens->unproject(*at);
        at.reset();
        if (ray && ray->z() > 0.05) {
          at = shape.lens->project(distance / ray->z() * *ray + Vector3d(baseline, 0, 0));
        }
      }
      if (at && last) plot.line(last->x(), last->y(), at->x(), at->y());
      last = at;
    }
  };
  for (double v : {0.12, 0.32, 0.5, 0.7, 0.88}) {
    for (double u : {0.1, 0.28, 0.46, 0.64}) {
      const Vector2d middle(u * shape.size.width, v * shape.size.height);
      plot.color(0.6, 0.6, 0.6);
      outline(middle, false);
      plot.color(0.8, 0.1, 0.1);
      outline(middle, true);
    }
  }
  return asImage(plot.finish("u [px]", "v [px]"));
}

std::string percent(double share, int digits = 1) { return fixed(100.0 * share, digits) + " %"; }

struct Claim {
  std::string text;
  bool holds = false;
  std::string evidence;
};

}  // namespace

ThesisEvaluation evaluateThesis(const ThesisEvaluationOptions& options) {
  if (!(options.scale >= 0.1 && options.scale <= 2.0)) {
    throw Error("--scale is " + fixed(options.scale, 3) + ", expected 0.1 to 2");
  }
  if (options.grid < 8 || options.grid > 400) {
    throw Error("--grid is " + std::to_string(options.grid) + ", expected 8 to 400");
  }
  const int threads = threadCount(options.threads);
  const auto progress = [&](double done, const std::string& stage) {
    if (options.progress) options.progress(done, stage);
  };
  ThesisEvaluation out;
  Json& json = out.json;
  std::string& html = out.html;
  std::vector<Claim> claims;
  std::string body;
  const auto heading = [&](const std::string& text) { body += "<h2>" + text + "</h2>\n"; };
  const auto paragraph = [&](const std::string& text) { body += "<p>" + text + "</p>\n"; };

  // ---------------------------------------------------------------- chapter 3
  progress(0.0, "chapter 3: the 3 mm lens");
  {
    // Equisolid, its focal length and the stretch of x chosen so that x is served best by R = 470
    // and y by R = 451, as the thesis found.
    const cv::Size size(static_cast<int>(std::lround(768 * options.scale)),
                        static_cast<int>(std::lround(576 * options.scale)));
    const Vector2d center(0.5 * (size.width - 1), 0.5 * (size.height - 1));
    const double wanted = 470.0 * options.scale;
    double f = wanted;
    double stretch = 1.0;
    Shape shape;
    ViewDetections board;
    std::mt19937 random(3);
    for (int i = 0; i < 15; ++i) {
      shape = {"3 mm lens", "r = 2 f sin(theta/2), x stretched by " + fixed(stretch, 3),
               lensOf([=](double t) { return 2.0 * f * std::sin(0.5 * t); }, center, 75.0 * kDegree,
                      stretch),
               size};
      random.seed(3);
      // The field of the thesis' stereo test: 93 x 79 degrees.
      board = squareBoard(shape, 46.5 * kDegree, 0.15, random);
      ProcedureOptions procedure;
      procedure.center = center;
      const DotRadius found = calibrateByDots(board, size, procedure);
      const double x = found.best_x.radius / wanted;
      const double y = found.best_y.radius / (wanted * 451.0 / 470.0);
      if (std::abs(x - 1.0) < 2e-3 && std::abs(y - 1.0) < 2e-3) break;
      // Slowly: the errors of x and y both follow either number.
      f /= std::sqrt(y);
      stretch *= std::pow(y / x, 0.4);
    }
    ProcedureOptions procedure;
    procedure.center = center;
    procedure.min_radius = 420.0 * options.scale;
    procedure.max_radius = 500.0 * options.scale;
    const DotRadius dots = calibrateByDots(board, size, procedure);
    heading("Chapter 3: one radius for an asymmetric 3 mm lens");
    paragraph("A simulated lens, " + shape.formula + ", " + std::to_string(size.width) + "x" +
              std::to_string(size.height) + ", " + std::to_string(board.pixels.size()) +
              " dots seen with " + fixed(kNoisePx, 1) + " px of noise.");
    Range r, e;
    for (const SweepStep& step : dots.sweep) {
      r.add(step.radius);
      e.add(step.error_x);
      e.add(step.error_y);
    }
    e.add(0.0);
    e.widen();
    Plot plot(520, 320, r.low, r.high, e.low, e.high);
    for (std::size_t i = 1; i < dots.sweep.size(); ++i) {
      const SweepStep& a = dots.sweep[i - 1];
      const SweepStep& b = dots.sweep[i];
      plot.color(0.8, 0.1, 0.1);
      plot.line(a.radius, a.error_x, b.radius, b.error_x);
      plot.color(0.1, 0.3, 0.8);
      plot.line(a.radius, a.error_y, b.radius, b.error_y);
      plot.color(0.0, 0.0, 0.0);
      plot.line(a.radius, a.combined, b.radius, b.combined);
    }
    body += figure(asImage(plot.finish("dewarp factor R [px]", "mean error [px]", 1)),
                   "Fig. 3.3: mean error along x (red), y (blue) and of both (black) against R. "
                   "Best for x " +
                       fixed(dots.best_x.radius, 0) + " (thesis 470), for y " +
                       fixed(dots.best_y.radius, 0) + " (thesis 451), for both " +
                       fixed(dots.best.radius, 0) + " (thesis 470)");
    const auto sphere = [&](double radius) {
      std::map<std::string, std::vector<double>> named{{"R", {radius}}};
      return makeLens("spherical", center, named, 80.0 * kDegree, "fig. 3.2");
    };
    for (const double radius : {dots.best_y.radius, dots.best_x.radius}) {
      body += figure(
          dewarpPlot(dewarpStatistics(shape, *sphere(radius), board)),
          "Fig. 3.2: dewarped dots (red) and their true places (black), R = " + fixed(radius, 0));
    }
    const double distance = 7.9 * kInch;
    const int step = std::max(4, static_cast<int>(16 * options.scale));
    const StereoPair pair = renderPair(shape, distance, kBaseline, step, 50.0 * kDegree, threads);
    const LensPtr lens = sphere(dots.best.radius);
    const DepthStatistics depth =
        depthStatistics(shape, *lens, lens, pair, distance, ThesisMask::kDistortedPixels, threads);
    body += figure(depthMap(depth, size, step),
                   "Fig. 3.5: the random-pattern board at 7.9 in, baseline 2 in, by the spherical "
                   "lens of fig. 3.3; red is too far, blue too near, full colour 10 %");
    body += figure(depthProfile(depth), "Fig. 3.5 from below: depth over x");
    body += "<table>\n" + row({"sec. 3.2.1", "average error", "largest error"}, "th") +
            row({"thesis", "2.9 %", "8.0 %"}) +
            row({"here", fixed(depth.mean_percent, 2) + " %", fixed(depth.max_percent, 2) + " %"}) +
            "</table>\n";
    json["chapter_3"] = {{"best_R_x", dots.best_x.radius},
                         {"best_R_y", dots.best_y.radius},
                         {"best_R", dots.best.radius},
                         {"depth_mean_percent", depth.mean_percent},
                         {"depth_max_percent", depth.max_percent},
                         {"thesis",
                          {{"best_R_x", 470},
                           {"best_R_y", 451},
                           {"best_R", 470},
                           {"depth_mean_percent", 2.9},
                           {"depth_max_percent", 8.0}}}};
    const double apart = dots.best_x.radius / dots.best_y.radius - 1.0;
    claims.push_back(
        {"No single R serves both axes of an asymmetric lens (fig. 3.3).", apart > 0.01,
         "x wants " + fixed(dots.best_x.radius, 0) + ", y " + fixed(dots.best_y.radius, 0)});
  }

  // ---------------------------------------------------------------- chapters 4 and 5
  const std::vector<Shape> shapes = lensShapes(options.scale);
  const int step = std::max(4, static_cast<int>(options.grid * options.scale));
  const double stages = static_cast<double>(shapes.size()) * 7.0 + 1.0;
  double stage = 1.0;
  bool quadric_dewarps_better = true, quadric_depth_better = true, corners_better = true;
  bool r0_wrong = true, linear_fits = true, better_surfaces = true, many_to_one = true;
  std::string quadric_evidence, depth_evidence, corner_evidence, r0_evidence, linear_evidence,
      surface_evidence, many_evidence;
  for (const Shape& shape : shapes) {
    progress(stage / stages, shape.name + ": boards");
    std::mt19937 random(5);
    const ViewDetections board = squareBoard(shape, kDewarpLimit, 0.12, random);
    const Detections boards = tiltedBoards(shape, random);
    const Found found = findModels(shape, board, boards, straightEdges(shape, random), threads);
    Json lens_json;
    lens_json["formula"] = shape.formula;
    heading("Chapters 4 and 5 on the " + escaped(shape.name) + " shape");
    paragraph(escaped(shape.formula) + "; " + std::to_string(shape.size.width) + "x" +
              std::to_string(shape.size.height) + "; " + std::to_string(board.pixels.size()) +
              " dots of a board square to the axis to " + fixed(kDewarpLimit / kDegree, 0) +
              " degrees for the thesis' procedures, " + std::to_string(boards.views.size()) +
              " tilted boards for our fits, " + fixed(kNoisePx, 1) + " px of noise.");

    // Table 4.1.
    std::vector<DewarpStatistics> dewarped(found.models.size());
    body += "<h3>Table 4.1: dewarping</h3>\n<table>\n" +
            row({"surface", "avg [px]", "max [px]", "min [px]", "avg [%]", "R0 [px]", "R0 error",
                 "rays, RMS [deg]", "rays, max [deg]"},
                "th") +
            row({"thesis: spherical", "18.5", "29.9", "3.74", "1.35", "-", "-", "-", "-"}) +
            row({"thesis: quadric", "4.1", "11.7", "0.76", "0.253", "2405", "-", "-", "-"});
    for (std::size_t m = 0; m < found.models.size(); ++m) {
      const Model& model = found.models[m];
      Json entry;
      if (!model.lens) {
        body +=
            row({escaped(model.name), "failed: " + escaped(model.why), "", "", "", "", "", "", ""});
        entry["failed"] = model.why;
      } else {
        dewarped[m] = dewarpStatistics(shape, *model.lens, board);
        const DewarpStatistics& d = dewarped[m];
        body += row({escaped(model.name), fixed(d.mean_px, 3), fixed(d.max_px, 3),
                     fixed(d.min_px, 4), fixed(d.mean_percent, 4), fixed(d.R0, 1),
                     percent(d.R0_error, 2), fixed(d.ray_rms_deg, 3), fixed(d.ray_max_deg, 3)});
        entry = {{"mean_px", d.mean_px},
                 {"max_px", d.max_px},
                 {"min_px", d.min_px},
                 {"mean_percent", d.mean_percent},
                 {"R0_px", d.R0},
                 {"R0_error", d.R0_error},
                 {"ray_rms_deg", d.ray_rms_deg},
                 {"ray_max_deg", d.ray_max_deg}};
      }
      lens_json["table_4_1"][model.name] = entry;
    }
    body += "</table>\n";
    stage += 1.0;
    const DewarpStatistics& sphere = dewarped[0];
    const DewarpStatistics& quadric = dewarped[1];
    const bool both = found.models[0].lens && found.models[1].lens;
    quadric_dewarps_better = quadric_dewarps_better && both && quadric.mean_px < sphere.mean_px;
    quadric_evidence +=
        shape.name + " " + fixed(sphere.mean_px, 1) + " and " + fixed(quadric.mean_px, 1) + " px; ";
    if (found.models[1].lens) {
      r0_wrong = r0_wrong && std::abs(quadric.R0_error) > 0.02;
      r0_evidence += shape.name + " " + percent(quadric.R0_error, 1) + "; ";
    }
    if (found.models[3].lens && found.models[4].lens && found.models[2].lens) {
      better_surfaces = better_surfaces &&
                        dewarped[4].ray_rms_deg < 0.2 * dewarped[2].ray_rms_deg &&
                        dewarped[3].ray_rms_deg < dewarped[2].ray_rms_deg;
      surface_evidence += shape.name + " " + fixed(dewarped[2].ray_rms_deg, 3) + ", " +
                          fixed(dewarped[3].ray_rms_deg, 3) + ", " +
                          fixed(dewarped[4].ray_rms_deg, 4) + " degrees; ";
    }

    // Figs 4.9 and 4.10.
    if (found.quadric) {
      const QuadricProcedure& q = *found.quadric;
      Plot plot(520, 300, 0, slopeOf(*shape.lens) * std::tan(kDewarpLimit), 0.5 * q.R0, 1.2 * q.R0);
      Plot heights(520, 300, -0.5 * shape.size.width, 0.5 * shape.size.width,
                   q.R0 - 0.5 * q.inverse_a2 * shape.size.width * shape.size.width * 0.5,
                   1.05 * q.R0);
      Range used;
      for (std::size_t i = 0; i < board.pixels.size(); ++i) {
        const Vector2d b = board.points[i].head<2>() - q.center.board_point;
        const bool on_row = std::abs(b.y()) < 1e-3 && std::abs(b.x()) > 1e-3;
        const bool on_column = std::abs(b.x()) < 1e-3 && std::abs(b.y()) > 1e-3;
        if (!on_row && !on_column) continue;
        const double u = q.pixels_per_unit * (on_row ? b.x() : b.y());
        const double x = on_row ? board.pixels[i].x() - q.center.center.x()
                                : board.pixels[i].y() - q.center.center.y();
        const double R = x * std::sqrt(u * u + q.R0 * q.R0) / u;  // eq. 4.22
        used.add(std::abs(u));
        plot.color(on_row ? 0.8 : 0.1, 0.2, on_row ? 0.1 : 0.8);
        plot.dot(std::abs(u), R, 2.0);
        const double beta = std::atan2(u, q.R0);  // eqs 4.24 and 4.25
        heights.color(on_row ? 0.8 : 0.1, 0.2, on_row ? 0.1 : 0.8);
        heights.dot(R * std::sin(beta), R * std::cos(beta), 2.0);
      }
      plot.color(0, 0, 0);
      plot.line(0, q.R0, used.high, q.R0 + q.slope_u * used.high);
      heights.color(0, 0, 0);
      for (int i = -50; i < 50; ++i) {
        const double a = 0.01 * i * shape.size.width;
        const double b = 0.01 * (i + 1) * shape.size.width;
        heights.line(a, q.R0 - q.inverse_a2 * a * a, b, q.R0 - q.inverse_a2 * b * b);
      }
      body += figure(asImage(plot.finish("u, v [px]", "R(u), R(v) [px]")),
                     "Fig. 4.9: radius of the surface along u (red) and v (blue) with the line of "
                     "the fit, R0 = " +
                         fixed(q.R0, 0));
      body += figure(
          asImage(heights.finish("x, y [px]", "h [px]")),
          "Fig. 4.10: height along x (red) and y (blue); 1/a^2 = " + fixed(1e4 * q.inverse_a2, 4) +
              "e-4 (thesis 3.2215e-4), R^2 = " + fixed(q.r_squared_x, 4) +
              " (0.972); 1/b^2 = " + fixed(1e4 * q.inverse_b2, 4) +
              "e-4 (3.3610e-4), R^2 = " + fixed(q.r_squared_y, 4) + " (0.942)");
      lens_json["fig_4_10"] = {{"R0", q.R0},
                               {"inverse_a2", q.inverse_a2},
                               {"inverse_b2", q.inverse_b2},
                               {"r_squared_x", q.r_squared_x},
                               {"r_squared_y", q.r_squared_y}};
      linear_fits = linear_fits && q.r_squared_x > 0.94 && q.r_squared_y > 0.94;
      linear_evidence += shape.name + " R^2 = " + fixed(q.r_squared_x, 3) + " and " +
                         fixed(q.r_squared_y, 3) + "; ";
      // Fig. 4.13: the surface over the undistorted plane, spherical beside it.
      if (found.models[0].lens && found.models[1].lens) {
        const double reach = slopeOf(*shape.lens) * std::tan(kDewarpLimit);
        Plot surface(520, 300, -reach, reach, 0, 1.05 * q.R0);
        for (int m = 0; m < 2; ++m) {
          const LensModel& lens = *found.models[m].lens;
          surface.color(m == 0 ? 0.1 : 0.8, 0.2, m == 0 ? 0.8 : 0.1);
          std::optional<Vector2d> last;
          for (int i = -100; i <= 100; ++i) {
            const double u = reach * i / 100.0;
            const auto pixel = lens.project(Vector3d(u, 0, slopeOf(lens)));
            std::optional<Vector2d> now;
            if (pixel) {
              const Vector2d offset = *pixel - lens.center();
              if (const auto h = lens.surfaceHeight(offset.x(), offset.y())) now = Vector2d(u, *h);
            }
            if (now && last) surface.line(last->x(), last->y(), now->x(), now->y());
            last = now;
          }
        }
        body += figure(asImage(surface.finish("u [px]", "h [px]")),
                       "Figs 4.11 and 4.13: height of the quadric (red) and the spherical surface "
                       "(blue) over the undistorted plane");
      }
    }
    for (int m = 0; m < 2; ++m) {
      if (!found.models[m].lens) continue;
      body += figure(dewarpPlot(dewarped[m]),
                     "Fig. 4.15: dewarped dots (red) and true places "
                     "(black), " +
                         escaped(found.models[m].name));
    }

    // Figs 4.2, 4.5, 4.12 and 4.14.
    progress(stage / stages, shape.name + ": pictures");
    const cv::Mat picture = boardPicture(shape, threads);
    body += figure(asImage(shrunk(picture, 520), 520), "The simulated dot board (fig. 4.8)");
    const char* forward_names[] = {"Fig. 4.2", "Fig. 4.12"};
    const char* backward_names[] = {"Fig. 4.5", "Fig. 4.14"};
    for (int m = 0; m < 2; ++m) {
      if (!found.models[m].lens) continue;
      const LensModel& lens = *found.models[m].lens;
      const Forward forward = forwardMap(lens, picture, kDewarpLimit);
      body += figure(asImage(forward.picture, 400),
                     std::string(forward_names[m]) + ": forward mapping, " +
                         escaped(found.models[m].name) + ", a part at full size; " +
                         percent(forward.gaps) + " of the dewarped pixels get nothing, " +
                         percent(forward.gaps_rim) + " beyond 45 degrees");
      lens_json["forward_mapping"][found.models[m].name] = {
          {"gaps", forward.gaps}, {"gaps_beyond_45_deg", forward.gaps_rim}};
      ViewGeometry geometry = makeViewGeometry(Projection::kPinhole, {900, 620}, 2.0 * kDewarpLimit,
                                               Eigen::Matrix3d::Identity());
      // The same scale of the middle for every model, so that R0 does not change the picture.
      geometry.focal_px *= slopeOf(lens) / slopeOf(*shape.lens);
      const View view(lens, shape.size, geometry, true, threads);
      body += figure(
          asImage(shrunk(view.render(picture), 520), 520),
          std::string(backward_names[m]) + ": backward mapping, " + escaped(found.models[m].name));
    }

    // Fig. 5.1 and memory.
    if (found.models[1].lens) {
      const ManyToOne many = manyToOne(*found.models[1].lens, shape.size);
      const double distorted = 2.0 * shape.size.area();
      const double full = 2.0 * many.dewarped_pixels;
      Plot plot(
          520, 260, 0, 1, 0,
          1.1 * std::max_element(many.by_radius.begin(), many.by_radius.end(),
                                 [](const auto& a, const auto& b) { return a.second < b.second; })
                    ->second);
      plot.color(0.1, 0.3, 0.8);
      Json radii = Json::array();
      for (std::size_t i = 0; i < many.by_radius.size(); ++i) {
        plot.dot(many.by_radius[i].first, many.by_radius[i].second, 3.0);
        radii.push_back({many.by_radius[i].first, many.by_radius[i].second});
      }
      body += figure(asImage(many.picture, 520),
                     "Fig. 5.1: dewarped pixels that show one distorted pixel, quadric; white is " +
                         std::to_string(many.most) + " (thesis: up to 8)");
      body += figure(asImage(plot.finish("radius / half diagonal", "mean count", 1)),
                     "Fig. 5.1: mean count against radius");
      body += "<table>\n" + row({"memory, two 8-bit images", "distorted", "dewarped"}, "th") +
              row({"thesis", "12.5 MB", "42 MB"}) +
              row({"here", fixed(distorted / 1e6, 1) + " MB",
                   fixed(full / 1e6, 1) + " MB (" + std::to_string(many.width) + "x" +
                       std::to_string(many.height) + " each)"}) +
              "</table>\n";
      lens_json["fig_5_1"] = {{"most", many.most}, {"mean_by_radius", radii}};
      lens_json["memory_mb"] = {{"distorted", distorted / 1e6}, {"dewarped", full / 1e6}};
      double densest = 0.0;
      for (const auto& [radius, count] : many.by_radius) densest = std::max(densest, count);
      many_to_one = many_to_one && many.most >= 4 && full > 1.5 * distorted &&
                    densest > 1.5 * many.by_radius.front().second;
      many_evidence += shape.name + " up to " + std::to_string(many.most) + ", " +
                       fixed(full / distorted, 1) + " times the memory; ";
    }
    stage += 1.0;

    // Table 5.1.
    const StereoPair pair =
        renderPair(shape, kBoardDistance, kBaseline, step, kDewarpLimit, threads);
    body += figure(windowPlot(shape, kBoardDistance, kBaseline),
                   "Fig. 5.3: square windows of the right image (grey) and what they become in the "
                   "left one (red), board at " +
                       fixed(1e3 * kBoardDistance, 0) + " mm, baseline 2 in");
    std::vector<DepthStatistics> depths(found.models.size());
    body += "<h3>Table 5.1: depth of the random-pattern board</h3>\n<table>\n" +
            row({"surface", "avg [mm]", "max [mm]", "avg [%]", "max [%]", "matched",
                 "beyond 45 deg", "distance [mm]"},
                "th") +
            row({"thesis: spherical", "3.635", "16.38", "2.10", "9.48", "corners lost", "", ""}) +
            row({"thesis: quadric", "2.340", "5.545", "1.35", "3.184", "to the corners", "", ""});
    const auto depthRow = [&](const std::string& name, const DepthStatistics& d) {
      body += row({escaped(name), fixed(d.mean_mm, 3), fixed(d.max_mm, 2), fixed(d.mean_percent, 3),
                   fixed(d.max_percent, 2), percent(d.matched), percent(d.corners_matched),
                   fixed(1e3 * d.distance_m, 1)});
      lens_json["table_5_1"][name] = {{"mean_mm", d.mean_mm},
                                      {"max_mm", d.max_mm},
                                      {"mean_percent", d.mean_percent},
                                      {"max_percent", d.max_percent},
                                      {"matched", d.matched},
                                      {"matched_beyond_45_deg", d.corners_matched},
                                      {"distance_mm", 1e3 * d.distance_m}};
    };
    for (std::size_t m = 0; m < found.models.size(); ++m) {
      progress(stage / stages, shape.name + ": depth by " + found.models[m].name);
      if (found.models[m].lens) {
        depths[m] = depthStatistics(shape, *found.models[m].lens, found.models[m].lens, pair,
                                    kBoardDistance, ThesisMask::kDistortedPixels, threads);
        depthRow(found.models[m].name, depths[m]);
      }
      stage += 0.8;
    }
    body += "</table>\n";
    paragraph(
        "Residuals along the axis from a plane fitted to the matches, those within 12 % of it; "
        "the true distance is " +
        fixed(1e3 * kBoardDistance, 0) +
        " mm. A lens whose R0 is wrong finds a plane at the "
        "wrong distance.");
    const char* names[] = {"Fig. 5.6", "Fig. 5.7"};
    for (int m = 0; m < 2; ++m) {
      if (depths[m].points.empty()) continue;
      const std::string name = escaped(found.models[m].name);
      body += figure(depthMap(depths[m], shape.size, step),
                     std::string(names[m]) + ": " + name +
                         "; red is too far, blue too near, full colour 10 %; white: no match");
      body += figure(depthProfile(depths[m]), std::string(names[m]) + " from below, " + name);
      body += figure(axisErrorPlot(depths[m], shape.lens->center().y(), step),
                     std::string("Fig. 5.8") + (m == 0 ? "a" : "b") +
                         ": depth error along the x axis, " + name);
    }
    if (depths.size() > 4 && !depths[4].points.empty()) {
      body += figure(axisErrorPlot(depths[4], shape.lens->center().y(), step),
                     "The same by our asphere");
    }
    if (!depths[0].points.empty() && !depths[1].points.empty()) {
      quadric_depth_better =
          quadric_depth_better && depths[1].mean_percent < depths[0].mean_percent;
      corners_better =
          corners_better && depths[1].corners_matched > depths[0].corners_matched + 0.05;
      depth_evidence += shape.name + " " + fixed(depths[0].mean_percent, 2) + " and " +
                        fixed(depths[1].mean_percent, 2) + " %; ";
      corner_evidence += shape.name + " " + percent(depths[0].corners_matched, 0) + " and " +
                         percent(depths[1].corners_matched, 0) + "; ";
    }

    // Fig. 5.4 against fig. 5.5, by the lens itself, so that nothing but the mask differs.
    {
      progress(stage / stages, shape.name + ": masks");
      const DepthStatistics square =
          depthStatistics(shape, *shape.lens, shape.lens, pair, kBoardDistance,
                          ThesisMask::kDewarpedSquare, threads);
      const DepthStatistics warped =
          depthStatistics(shape, *shape.lens, shape.lens, pair, kBoardDistance,
                          ThesisMask::kDistortedPixels, threads);
      const Vector2d rim(0.06 * shape.size.width, 0.5 * shape.size.height);
      const Vector2d corner(0.04 * shape.size.width, 0.04 * shape.size.height);
      const double at_rim = distinctShare(*shape.lens, rim, 11);
      const double at_corner = distinctShare(*shape.lens, corner, 11);
      body += "<h3>Fig. 5.4 against fig. 5.5</h3>\n<table>\n" +
              row({"mask", "avg [mm]", "matched", "beyond 45 deg",
                   "distinct pixels at the left rim", "in the corner", "seconds"},
                  "th") +
              row({"fig. 5.4: square when dewarped", fixed(square.mean_mm, 3),
                   percent(square.matched), percent(square.corners_matched), percent(at_rim, 0),
                   percent(at_corner, 0), fixed(square.seconds, 1)}) +
              row({"fig. 5.5: distinct pixels", fixed(warped.mean_mm, 3), percent(warped.matched),
                   percent(warped.corners_matched), "100 %", "100 %", fixed(warped.seconds, 1)}) +
              "</table>\n";
      lens_json["masks"] = {{"fig_5_4",
                             {{"mean_mm", square.mean_mm},
                              {"matched", square.matched},
                              {"matched_beyond_45_deg", square.corners_matched},
                              {"distinct_at_rim", at_rim},
                              {"distinct_in_corner", at_corner}}},
                            {"fig_5_5",
                             {{"mean_mm", warped.mean_mm},
                              {"matched", warped.matched},
                              {"matched_beyond_45_deg", warped.corners_matched}}}};
    }
    stage = std::ceil(stage - 1e-9);
    json["lenses"][shape.name] = lens_json;
  }

  // ---------------------------------------------------------------- claims
  claims.push_back({"The quadric dewarps better than the sphere (table 4.1: 4.1 against 18.5 px).",
                    quadric_dewarps_better, "averages, sphere and quadric: " + quadric_evidence});
  claims.push_back(
      {"Surface heights along the axes follow a second-order curve (fig. 4.10: R^2 of "
       "0.972 and 0.942).",
       linear_fits, linear_evidence});
  claims.push_back(
      {"R0 of the procedure is the lens' focal length in pixels, so that the surface "
       "gives viewing rays.",
       !r0_wrong,
       "its error: " + r0_evidence +
           "boards square to the axis do not determine it; tilted boards do"});
  claims.push_back(
      {"Dewarping maps several pixels to one, more with radius, and takes several times "
       "the memory (fig. 5.1, sec. 5.1).",
       many_to_one, many_evidence});
  claims.push_back(
      {"Depth of a plane is flatter with the quadric than with the sphere (table 5.1: "
       "1.35 against 2.10 %).",
       quadric_depth_better, "averages, sphere and quadric: " + depth_evidence});
  claims.push_back(
      {"With the sphere the corners cannot be matched, with the quadric they can (figs "
       "5.6 and 5.7).",
       corners_better, "matched beyond 45 degrees, sphere and quadric: " + corner_evidence});
  claims.push_back({"Better surfaces than the paraboloid exist (chapter 6, future work).",
                    better_surfaces,
                    "RMS of the rays by our fits of quadric, conic, asphere: " + surface_evidence});
  html = pageHead("Johnson 1997, measured again on simulated boards");
  html +=
      "<p>Numbers called \"thesis\" are those that K. B. Johnson measured with real cameras in "
      "1997; everything else was computed by this command. Errors of dewarping are in pixels of "
      "the dewarped plane with the scale of the image's middle.</p>\n<h2>Claims</h2>\n<table>\n" +
      row({"claim", "holds here", "by"}, "th");
  json["claims"] = Json::array();
  for (const Claim& claim : claims) {
    std::string evidence = claim.evidence;
    while (!evidence.empty() && (evidence.back() == ' ' || evidence.back() == ';')) {
      evidence.pop_back();
    }
    html += row({escaped(claim.text), claim.holds ? "yes" : "no", escaped(evidence)});
    json["claims"].push_back({{"claim", claim.text}, {"holds", claim.holds}, {"by", evidence}});
  }
  html += "</table>\n" + body + "</body></html>\n";
  json["scale"] = options.scale;
  json["grid_px"] = options.grid;
  progress(1.0, "done");
  return out;
}

}  // namespace omnister::tools
