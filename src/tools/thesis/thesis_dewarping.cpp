// SPDX-License-Identifier: Apache-2.0
#include "tools/thesis/thesis_dewarping.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>
#include <set>

#include "omnister/sim/renderer.h"
#include "tools/report/html_plot.h"

namespace omnister::tools::thesis {

std::optional<Vector2d> dewarp(const LensModel& lens, double R0, const Vector2d& pixel) {
  const auto ray = lens.unproject(pixel);
  if (!ray || ray->z() < 0.05) return std::nullopt;
  return Vector2d(R0 * ray->head<2>() / ray->z());
}

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

cv::Mat shrunk(const cv::Mat& image, int width) {
  if (image.cols <= width) return image;
  cv::Mat small;
  cv::resize(image, small, cv::Size(width, std::max(1, image.rows * width / image.cols)), 0, 0,
             cv::INTER_AREA);
  return small;
}

Forward forwardMap(const LensModel& lens, const cv::Mat& image, double limit) {
  const double R0 = slopeOf(lens);
  const double reach = R0 * std::tan(limit);
  const int side = 2 * static_cast<int>(reach) + 1;
  // The image shows less than a square of that reach.
  const int half = side / 2;
  cv::Mat1b picture(side, side, uchar{0});
  cv::Mat1b hit(side, side, uchar{0});
  int top = side, bottom = 0, left = side, right = 0;
  for (int v = 0; v < image.rows; ++v) {
    for (int u = 0; u < image.cols; ++u) {
      const auto uv = dewarp(lens, R0, Vector2d(u, v));
      if (!uv || uv->norm() > reach) continue;
      const int x = static_cast<int>(std::lround(uv->x() + half));
      const int y = static_cast<int>(std::lround(uv->y() + half));
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
      const Vector3d ray(x - half, y - half, R0);
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
  const int x0 = std::clamp(half + static_cast<int>(0.62 * reach), left, right - part + 1);
  const int y0 = std::clamp(half + static_cast<int>(0.3 * reach), top, bottom - part + 1);
  result.picture = picture(cv::Rect(x0, y0, part, part)).clone();
  return result;
}

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

}  // namespace omnister::tools::thesis
