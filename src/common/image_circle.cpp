// SPDX-License-Identifier: Apache-2.0
#include "omnister/common/image_circle.h"

#include <Eigen/Dense>
#include <algorithm>
#include <array>
#include <cmath>
#include <opencv2/imgproc.hpp>

namespace omnister {
namespace {

constexpr int kLargestSide = 480;  // [px] of the copy that is looked at
constexpr int kRays = 360;

double medianOf(std::vector<float> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// Brightest channel as floats, small.
cv::Mat smallGray(const cv::Mat& image, cv::Size size) {
  cv::Mat plain;
  image.convertTo(plain, CV_32F);
  if (plain.channels() > 1) {
    std::vector<cv::Mat> channels;
    cv::split(plain, channels);
    // A fourth channel is opacity.
    plain = channels[0];
    for (std::size_t c = 1; c < std::min<std::size_t>(3, channels.size()); ++c) {
      plain = cv::max(plain, channels[c]);
    }
  }
  cv::patchNaNs(plain, 0.0);
  cv::Mat small;
  cv::resize(plain, small, size, 0, 0, cv::INTER_AREA);
  return small;
}

struct Disc {
  Eigen::Vector2d center = Eigen::Vector2d::Zero();
  double radius = 0.0;
};

/// Least squares of x^2 + y^2 - 2 a x - 2 b y - c (Kasa 1976).
std::optional<Disc> discThrough(const std::vector<Eigen::Vector2d>& points) {
  if (points.size() < 12) return std::nullopt;
  Eigen::MatrixXd rows(static_cast<Eigen::Index>(points.size()), 3);
  Eigen::VectorXd right(static_cast<Eigen::Index>(points.size()));
  for (std::size_t i = 0; i < points.size(); ++i) {
    rows.row(static_cast<Eigen::Index>(i)) << 2 * points[i].x(), 2 * points[i].y(), 1.0;
    right(static_cast<Eigen::Index>(i)) = points[i].squaredNorm();
  }
  const Eigen::Vector3d found = rows.colPivHouseholderQr().solve(right);
  Disc disc;
  disc.center = found.head<2>();
  const double squared = found(2) + disc.center.squaredNorm();
  if (!found.allFinite() || !(squared > 0.0)) return std::nullopt;
  disc.radius = std::sqrt(squared);
  return disc;
}

}  // namespace

std::optional<ImageCircle> findImageCircle(const std::vector<cv::Mat>& images) {
  if (images.empty() || images[0].empty()) return std::nullopt;
  const cv::Size full = images[0].size();
  const double scale =
      std::min(1.0, static_cast<double>(kLargestSide) / std::max(full.width, full.height));
  const cv::Size size(std::max(1, static_cast<int>(std::lround(full.width * scale))),
                      std::max(1, static_cast<int>(std::lround(full.height * scale))));
  if (std::min(size.width, size.height) < 24) return std::nullopt;
  cv::Mat most;
  for (const cv::Mat& image : images) {
    if (image.size() != full) return std::nullopt;
    const cv::Mat small = smallGray(image, size);
    most = most.empty() ? small : cv::Mat(cv::max(most, small));
  }
  // How dark the corners are, and how bright the middle.
  const int patch = std::max(3, std::min(size.width, size.height) / 30);
  std::vector<double> corners;
  for (const int x : {0, size.width - patch}) {
    for (const int y : {0, size.height - patch}) {
      const cv::Mat part = most(cv::Rect(x, y, patch, patch)).clone();
      corners.push_back(medianOf(std::vector<float>(part.begin<float>(), part.end<float>())));
    }
  }
  std::sort(corners.begin(), corners.end());
  const cv::Mat middle =
      most(cv::Rect(size.width / 4, size.height / 4, size.width / 2, size.height / 2)).clone();
  const double bright = medianOf(std::vector<float>(middle.begin<float>(), middle.end<float>()));
  const double black = corners[0];
  // Two corners at least are as black as each other, and far below the picture.
  if (!(bright > 0.0) || black > 0.2 * bright || corners[1] > black + 0.08 * (bright - black)) {
    return std::nullopt;
  }
  const double level = black + 0.12 * (bright - black);
  const Eigen::Vector2d from(0.5 * (size.width - 1), 0.5 * (size.height - 1));
  std::vector<Eigen::Vector2d> edge;
  for (int ray = 0; ray < kRays; ++ray) {
    const double angle = 2.0 * M_PI * ray / kRays;
    const Eigen::Vector2d way(std::cos(angle), std::sin(angle));
    // From outside inwards: what is dark within the picture does not matter.
    double reach = HUGE_VAL;
    for (int axis = 0; axis < 2; ++axis) {
      if (std::abs(way[axis]) > 1e-9) reach = std::min(reach, from[axis] / std::abs(way[axis]));
    }
    const auto at = [&](double r) {
      const Eigen::Vector2d p = from + r * way;
      return static_cast<double>(
          most.at<float>(std::clamp(static_cast<int>(std::lround(p.y())), 0, size.height - 1),
                         std::clamp(static_cast<int>(std::lround(p.x())), 0, size.width - 1)));
    };
    double r = reach;
    while (r > 0.0 && at(r) <= level) r -= 0.5;
    // A ray along which the picture goes on to the border tells nothing.
    if (reach - r < 2.0 || r <= 0.1 * reach) continue;
    // Between the last dark and the first bright place.
    const double inner = at(r);
    const double outer = at(r + 0.5);
    const double share =
        inner > outer ? std::clamp((inner - level) / (inner - outer), 0.0, 1.0) : 0.5;
    edge.push_back(from + (r + 0.5 * share) * way);
  }
  // Without rays in two quadrants a circle is a guess.
  if (edge.size() < kRays / 8) return std::nullopt;
  std::vector<Eigen::Vector2d> used = edge;
  std::optional<Disc> disc;
  for (int round = 0; round < 8; ++round) {
    disc = discThrough(used);
    if (!disc) return std::nullopt;
    std::vector<float> off;
    for (const Eigen::Vector2d& point : edge) {
      off.push_back(static_cast<float>(std::abs((point - disc->center).norm() - disc->radius)));
    }
    const double limit = std::max(1.0, 2.5 * medianOf(off));
    std::vector<Eigen::Vector2d> next;
    for (std::size_t i = 0; i < edge.size(); ++i) {
      if (off[i] <= limit) next.push_back(edge[i]);
    }
    used = std::move(next);
  }
  std::size_t near = 0;
  std::array<int, 4> quadrants{};
  for (const Eigen::Vector2d& point : edge) {
    const Eigen::Vector2d offset = point - disc->center;
    if (std::abs(offset.norm() - disc->radius) > std::max(1.5, 0.015 * disc->radius)) continue;
    ++near;
    ++quadrants[static_cast<std::size_t>((offset.x() > 0 ? 1 : 0) + (offset.y() > 0 ? 2 : 0))];
  }
  const auto told =
      std::count_if(quadrants.begin(), quadrants.end(), [](int count) { return count >= 5; });
  const bool about = (disc->center - from).norm() < 0.35 * std::min(size.width, size.height);
  const bool sized = disc->radius > 0.2 * std::min(size.width, size.height) &&
                     disc->radius < std::hypot(from.x(), from.y());
  if (10 * near < 6 * edge.size() || told < 2 || !about || !sized) return std::nullopt;
  ImageCircle circle;
  const Eigen::Vector2d factor(static_cast<double>(full.width) / size.width,
                               static_cast<double>(full.height) / size.height);
  circle.center = (disc->center.array() + 0.5) * factor.array() - 0.5;
  circle.radius = disc->radius * 0.5 * factor.sum();
  return circle;
}

cv::Mat circleMask(const ImageCircle& circle, cv::Size size, double rim) {
  cv::Mat mask(size, CV_8UC1, cv::Scalar(0));
  const double radius = circle.radius - rim;
  for (int row = 0; row < size.height; ++row) {
    for (int col = 0; col < size.width; ++col) {
      const Eigen::Vector2d off = Eigen::Vector2d(col, row) - circle.center;
      if (radius > 0.0 && off.squaredNorm() < radius * radius) mask.at<uchar>(row, col) = 255;
    }
  }
  return mask;
}

}  // namespace omnister
