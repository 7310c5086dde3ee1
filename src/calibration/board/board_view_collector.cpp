// SPDX-License-Identifier: Apache-2.0
#include "calibration/board/board_view_collector.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>
#include <map>
#include <opencv2/imgproc.hpp>

#include "omnister/common/error.h"

namespace omnister {
namespace {

/// Mean distance between corners that both views hold [px]; infinite when they share less than half
/// of the smaller one.
double meanMove(const ViewDetections& a, const ViewDetections& b) {
  std::map<std::pair<double, double>, Eigen::Vector2d> known;
  for (std::size_t i = 0; i < a.points.size(); ++i)
    known[{a.points[i].x(), a.points[i].y()}] = a.pixels[i];
  double sum = 0.0;
  std::size_t shared = 0;
  for (std::size_t i = 0; i < b.points.size(); ++i) {
    const auto found = known.find({b.points[i].x(), b.points[i].y()});
    if (found == known.end()) continue;
    sum += (found->second - b.pixels[i]).norm();
    ++shared;
  }
  if (shared == 0 || 2 * shared < std::min(a.points.size(), b.points.size()))
    return std::numeric_limits<double>::infinity();
  return sum / static_cast<double>(shared);
}

/// White on black, from the upper left corner on.
void write(const std::vector<std::string>& lines, cv::Mat& picture) {
  const double scale = std::clamp(picture.cols / 1100.0, 0.3, 2.0);
  const int step = static_cast<int>(std::lround(30.0 * scale));
  for (std::size_t i = 0; i < lines.size(); ++i) {
    const cv::Point at(step / 2, step * (static_cast<int>(i) + 1));
    const int width = std::max(1, static_cast<int>(std::lround(2.0 * scale)));
    cv::putText(picture, lines[i], at, cv::FONT_HERSHEY_SIMPLEX, scale, cv::Scalar::all(0),
                3 * width, cv::LINE_AA);
    cv::putText(picture, lines[i], at, cv::FONT_HERSHEY_SIMPLEX, scale, cv::Scalar::all(255), width,
                cv::LINE_AA);
  }
}

}  // namespace

ViewCollector::ViewCollector(cv::Size image_size, const CollectorOptions& options)
    : options_(options), cells_(image_size, CV_32SC1) {
  if (image_size.width < 2 || image_size.height < 2)
    throw Error("an image of less than 2x2 pixels");
  detections_.image_size = image_size;
  const auto cells = static_cast<std::size_t>(options_.rings * options_.sectors);
  brightness_.assign(cells, 0.0);
  corners_.assign(cells, 0);
  for (int v = 0; v < image_size.height; ++v)
    for (int u = 0; u < image_size.width; ++u) cells_.at<int>(v, u) = cellOf(u, v);
}

int ViewCollector::cellOf(double u, double v) const {
  const double x = u - 0.5 * (cells_.cols - 1);
  const double y = v - 0.5 * (cells_.rows - 1);
  const double radius = std::hypot(x, y) / (0.5 * std::hypot(cells_.cols, cells_.rows));
  const double turn = std::atan2(y, x) / (2.0 * CV_PI) + 1.0;
  const int ring = std::clamp(static_cast<int>(radius * options_.rings), 0, options_.rings - 1);
  // The first sector is centred on the right-hand direction.
  const int sector = static_cast<int>(std::floor(turn * options_.sectors + 0.5)) % options_.sectors;
  return ring * options_.sectors + sector;
}

ViewCollector::Verdict ViewCollector::add(const cv::Mat& gray,
                                          const std::optional<ViewDetections>& found) {
  if (gray.size() != cells_.size() || gray.type() != CV_8UC1)
    throw Error("images changed their size while views were collected");
  ++images_;
  last_image_ = gray;
  std::vector<double> sum(brightness_.size(), 0.0);
  std::vector<double> count(brightness_.size(), 0.0);
  for (int v = 0; v < gray.rows; v += 4) {
    const auto* row = gray.ptr<std::uint8_t>(v);
    const auto* cell = cells_.ptr<int>(v);
    for (int u = 0; u < gray.cols; u += 4) {
      sum[static_cast<std::size_t>(cell[u])] += row[u];
      count[static_cast<std::size_t>(cell[u])] += 1.0;
    }
  }
  for (std::size_t i = 0; i < sum.size(); ++i)
    if (count[i] > 0.0) brightness_[i] = std::max(brightness_[i], sum[i] / count[i]);

  const std::optional<ViewDetections> before = std::exchange(previous_, found);
  if (!found) return Verdict::kNotFound;
  if (!before || !(meanMove(*before, *found) <= options_.still_px)) return Verdict::kMoving;
  const double least = options_.min_move * std::hypot(cells_.cols, cells_.rows);
  for (const ViewDetections& view : detections_.views)
    if (meanMove(view, *found) < least) return Verdict::kAlike;
  ViewDetections view = *found;
  char name[24];
  std::snprintf(name, sizeof name, "view_%03zu", detections_.views.size());
  view.name = name;
  for (const Eigen::Vector2d& pixel : view.pixels)
    ++corners_[static_cast<std::size_t>(cellOf(pixel.x(), pixel.y()))];
  detections_.views.push_back(std::move(view));
  return Verdict::kTaken;
}

double ViewCollector::coverage() const {
  int inside = 0;
  int covered = 0;
  for (std::size_t i = 0; i < corners_.size(); ++i) {
    if (!bright(static_cast<int>(i)) && corners_[i] == 0) continue;
    ++inside;
    covered += corners_[i] > 0 ? 1 : 0;
  }
  return inside == 0 ? 0.0 : static_cast<double>(covered) / inside;
}

int ViewCollector::wanted() const {
  // The emptiest cell, inner rings first: outwards it gets harder to hold the target still.
  int best = -1;
  for (int cell = 0; cell < static_cast<int>(corners_.size()); ++cell) {
    if (!bright(cell)) continue;
    if (best < 0 ||
        corners_[static_cast<std::size_t>(cell)] < corners_[static_cast<std::size_t>(best)])
      best = cell;
  }
  return best;
}

std::string ViewCollector::hint() const {
  const int best = wanted();
  if (best < 0) return "the image is black";
  const int ring = best / options_.sectors;
  const double turn = 2.0 * CV_PI * (best % options_.sectors) / options_.sectors;
  const double x = std::cos(turn);
  const double y = std::sin(turn);
  std::string place = y > 0.4 ? "lower" : y < -0.4 ? "upper" : "";
  if (std::abs(x) > 0.4)
    place += std::string(place.empty() ? "" : " ") + (x > 0.0 ? "right" : "left");
  if (ring == 0) return place + ", near the middle, tilted";
  if (ring == options_.rings - 1) return place + ", at the edge";
  return place + ", half way out";
}

cv::Mat ViewCollector::draw(const std::vector<std::string>& lines) const {
  if (last_image_.empty()) {
    cv::Mat nothing(cells_.size(), CV_8UC3, cv::Scalar::all(0));
    write(lines, nothing);
    return nothing;
  }
  const int next = wanted();
  cv::Mat picture;
  cv::cvtColor(last_image_, picture, cv::COLOR_GRAY2BGR);
  for (int v = 0; v < picture.rows; ++v) {
    auto* row = picture.ptr<cv::Vec3b>(v);
    const auto* cell = cells_.ptr<int>(v);
    for (int u = 0; u < picture.cols; ++u) {
      const int n = corners_[static_cast<std::size_t>(cell[u])];
      const bool edge =
          (u > 0 && cell[u - 1] != cell[u]) || (v > 0 && cells_.at<int>(v - 1, u) != cell[u]);
      cv::Vec3b tint(0, 0, 0);
      if (n > 0)
        tint = cv::Vec3b(0, static_cast<std::uint8_t>(std::min(40 + 4 * n, 110)), 0);
      else if (bright(cell[u]))
        tint = cv::Vec3b(0, 0, 60);
      if (edge && next >= 0 &&
          (cell[u] == next || (u > 0 && cell[u - 1] == next) ||
           (v > 0 && cells_.at<int>(v - 1, u) == next))) {
        row[u] = cv::Vec3b(60, 230, 255);
        continue;
      }
      for (int k = 0; k < 3; ++k)
        row[u][k] = cv::saturate_cast<std::uint8_t>((edge ? 40 : 0) + 0.6 * row[u][k] + tint[k]);
    }
  }
  const auto at = [](const Eigen::Vector2d& pixel) {
    return cv::Point(static_cast<int>(std::lround(pixel.x())),
                     static_cast<int>(std::lround(pixel.y())));
  };
  for (const ViewDetections& view : detections_.views)
    for (const Eigen::Vector2d& pixel : view.pixels)
      cv::circle(picture, at(pixel), 1, cv::Scalar(60, 220, 60), -1);
  if (previous_)
    for (const Eigen::Vector2d& pixel : previous_->pixels)
      cv::circle(picture, at(pixel), 4, cv::Scalar(0, 220, 255), 1, cv::LINE_AA);
  write(lines, picture);
  return picture;
}

cv::Mat drawResiduals(const Detections& detections,
                      const std::vector<std::vector<Eigen::Vector2d>>& residuals,
                      double magnification, const std::vector<std::string>& lines) {
  cv::Mat picture(detections.image_size, CV_8UC3, cv::Scalar::all(30));
  constexpr int kFractionBits = 4;
  const auto fixed = [](const Eigen::Vector2d& p) {
    const auto scaled = [](double x) {
      return static_cast<int>(std::lround(std::clamp(x, -1e5, 1e5) * (1 << kFractionBits)));
    };
    return cv::Point(scaled(p.x()), scaled(p.y()));
  };
  for (std::size_t i = 0; i < detections.views.size(); ++i) {
    const ViewDetections& view = detections.views[i];
    for (std::size_t k = 0; k < view.pixels.size(); ++k) {
      const Eigen::Vector2d& pixel = view.pixels[k];
      if (i >= residuals.size() || k >= residuals[i].size()) {
        const Eigen::Vector2d arm(3.0, 3.0);
        cv::line(picture, fixed(pixel - arm), fixed(pixel + arm), cv::Scalar::all(120), 1,
                 cv::LINE_AA, kFractionBits);
        continue;
      }
      const Eigen::Vector2d& residual = residuals[i][k];
      const double size = residual.norm();
      const cv::Scalar colour = size < 0.5   ? cv::Scalar(90, 230, 90)
                                : size < 1.0 ? cv::Scalar(60, 220, 255)
                                             : cv::Scalar(80, 80, 255);
      cv::circle(picture, fixed(pixel), 1 << kFractionBits, colour, -1, cv::LINE_AA, kFractionBits);
      cv::line(picture, fixed(pixel), fixed(pixel + magnification * residual), colour, 1,
               cv::LINE_AA, kFractionBits);
    }
  }
  write(lines, picture);
  return picture;
}

}  // namespace omnister
