// SPDX-License-Identifier: Apache-2.0
#include "tools/thesis/thesis_depth.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <optional>

#include "omnister/sim/renderer.h"
#include "tools/report/html_plot.h"

namespace omnister::tools::thesis {
namespace {

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

}  // namespace

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

std::string depthMap(const DepthStatistics& s, cv::Size size, double step) {
  Plot plot(520, 520.0 * size.height / size.width + 40, 0, size.width, size.height, 0);
  const double most = 0.1 * s.distance_m;
  for (const auto& point : s.points) {
    plot.errorCell(point.pixel.x() - 0.5 * step, point.pixel.y() - 0.5 * step,
                   point.pixel.x() + 0.5 * step, point.pixel.y() + 0.5 * step,
                   point.residual / most);
  }
  return asImage(plot.finish("u [px]", "v [px]"));
}

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
  return asImage(plot.finish("x [mm]", "error [mm]"));
}

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

}  // namespace omnister::tools::thesis
