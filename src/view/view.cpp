// SPDX-License-Identifier: Apache-2.0
#include "omnister/view/view.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <opencv2/imgproc.hpp>
#include <string>

#include "omnister/common/error.h"
#include "omnister/common/parallel.h"

namespace omnister {
namespace {

constexpr double kPi = 3.14159265358979324;
constexpr int kMostSide = 32766;  // fixed maps hold 16 bits
constexpr float kOutside = -16.0f;

Eigen::Vector2d middle(cv::Size size) { return {0.5 * (size.width - 1), 0.5 * (size.height - 1)}; }

void checkSize(cv::Size size, const char* what) {
  if (size.width < 1 || size.height < 1 || size.width > kMostSide || size.height > kMostSide) {
    throw Error(std::string(what) + " is " + std::to_string(size.width) + "x" +
                std::to_string(size.height) + " pixels, expected 1 to " +
                std::to_string(kMostSide) + " a side");
  }
}

/// fine = (1 - share) fine + share coarse, in place.
template <typename T>
void mixRows(const cv::Mat& coarse, const cv::Mat& share, cv::Mat& fine) {
  const int channels = fine.channels();
  for (int y = 0; y < fine.rows; ++y) {
    const float* weight = share.ptr<float>(y);
    const T* from = coarse.ptr<T>(y);
    T* to = fine.ptr<T>(y);
    for (int x = 0; x < fine.cols; ++x) {
      if (weight[x] <= 0.0f) continue;
      for (int c = 0; c < channels; ++c) {
        const int k = x * channels + c;
        to[k] = cv::saturate_cast<T>(static_cast<float>(to[k]) +
                                     weight[x] *
                                         (static_cast<float>(from[k]) - static_cast<float>(to[k])));
      }
    }
  }
}

}  // namespace

Projection projectionOf(std::string_view name) {
  if (name == "pinhole") return Projection::kPinhole;
  if (name == "cylindrical") return Projection::kCylindrical;
  if (name == "equirectangular") return Projection::kEquirectangular;
  throw Error("projection is '" + printable(name, 60) +
              "', expected pinhole, cylindrical or equirectangular");
}

Eigen::Matrix3d viewRotation(double pan, double tilt, double roll) {
  return (Eigen::AngleAxisd(pan, Eigen::Vector3d::UnitY()) *
          Eigen::AngleAxisd(-tilt, Eigen::Vector3d::UnitX()) *
          Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitZ()))
      .toRotationMatrix();
}

Eigen::Matrix3d omniviewRotation(double beta, double delta, double theta) {
  return (Eigen::AngleAxisd(delta, Eigen::Vector3d::UnitZ()) *
          Eigen::AngleAxisd(beta, Eigen::Vector3d::UnitX()) *
          Eigen::AngleAxisd(theta, Eigen::Vector3d::UnitZ()))
      .toRotationMatrix();
}

ViewGeometry makeViewGeometry(Projection projection, cv::Size size, double hfov,
                              const Eigen::Matrix3d& rotation) {
  checkSize(size, "view");
  const bool pinhole = projection == Projection::kPinhole;
  if (!(hfov > 0.0 && (pinhole ? hfov < kPi : hfov <= 2.0 * kPi + 1e-9))) {
    throw Error("horizontal field is " + std::to_string(hfov * 180.0 / kPi) +
                " degrees, expected more than 0 and " +
                (pinhole ? "less than 180 for a pinhole view" : "at most 360"));
  }
  ViewGeometry geometry;
  geometry.projection = projection;
  geometry.size = size;
  geometry.focal_px = pinhole ? 0.5 * size.width / std::tan(0.5 * hfov) : size.width / hfov;
  geometry.rotation = rotation;
  return geometry;
}

std::optional<Eigen::Vector3d> viewRay(const ViewGeometry& geometry, const Eigen::Vector2d& pixel) {
  const Eigen::Vector2d at = (pixel - middle(geometry.size)) / geometry.focal_px;
  Eigen::Vector3d ray;
  switch (geometry.projection) {
    case Projection::kPinhole:
      ray = {at.x(), at.y(), 1.0};
      break;
    case Projection::kCylindrical:
      ray = {std::sin(at.x()), at.y(), std::cos(at.x())};
      break;
    case Projection::kEquirectangular:
      if (std::abs(at.y()) > 0.5 * kPi) return std::nullopt;
      ray = {std::sin(at.x()) * std::cos(at.y()), std::sin(at.y()),
             std::cos(at.x()) * std::cos(at.y())};
      break;
  }
  return geometry.rotation * ray.normalized();
}

std::optional<Eigen::Vector2d> viewPixel(const ViewGeometry& geometry, const Eigen::Vector3d& ray) {
  const Eigen::Vector3d d = geometry.rotation.transpose() * ray;
  const double across = std::hypot(d.x(), d.z());
  Eigen::Vector2d at(0.0, 0.0);
  switch (geometry.projection) {
    case Projection::kPinhole:
      if (!(d.z() > 0.0)) return std::nullopt;
      at = d.head<2>() / d.z();
      break;
    case Projection::kCylindrical:
      if (!(across > 0.0)) return std::nullopt;
      at = {std::atan2(d.x(), d.z()), d.y() / across};
      break;
    case Projection::kEquirectangular:
      if (!(d.squaredNorm() > 0.0)) return std::nullopt;
      at = {std::atan2(d.x(), d.z()), std::atan2(d.y(), across)};
      break;
  }
  return Eigen::Vector2d(middle(geometry.size) + geometry.focal_px * at);
}

View::View(const LensModel& lens, cv::Size lens_size, const ViewGeometry& geometry, bool anti_alias,
           int threads)
    : lens_size_(lens_size), geometry_(geometry) {
  checkSize(geometry.size, "view");
  checkSize(lens_size, "camera image");
  if (!(geometry.focal_px > 0.0 && std::isfinite(geometry.focal_px)) ||
      !geometry.rotation.allFinite()) {
    throw Error("view has a focal length or rotation that is no number above zero");
  }
  const cv::Size size = geometry.size;
  cv::Mat source(size, CV_32FC2);
  // How many pixels of the image one of the view covers, as a level of the pyramid.
  cv::Mat level(size, CV_32FC1, cv::Scalar(0));
  mask_.create(size, CV_8UC1);
  parallelFor(
      0, static_cast<std::size_t>(size.height), threads,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        for (int x = 0; x < size.width; ++x) {
          const auto ray = viewRay(geometry, Eigen::Vector2d(x, y));
          const auto pixel = ray ? lens.project(*ray) : std::nullopt;
          const bool seen = pixel && pixel->x() >= -0.5 && pixel->y() >= -0.5 &&
                            pixel->x() <= lens_size.width - 0.5 &&
                            pixel->y() <= lens_size.height - 0.5;
          source.at<cv::Vec2f>(y, x) =
              seen ? cv::Vec2f(static_cast<float>(pixel->x()), static_cast<float>(pixel->y()))
                   : cv::Vec2f(kOutside, kOutside);
          mask_.at<uchar>(y, x) = seen ? 255 : 0;
        }
      },
      8);
  double coarsest = 0.0;
  if (anti_alias) {
    parallelFor(
        0, static_cast<std::size_t>(size.height), threads,
        [&](std::size_t row) {
          const int y = static_cast<int>(row);
          // The wider of the steps to the neighbours on either side.
          const auto step = [&](int x, int x2, int y2) {
            if (x2 < 0 || y2 < 0 || x2 >= size.width || y2 >= size.height ||
                mask_.at<uchar>(y2, x2) == 0) {
              return 0.0;
            }
            return cv::norm(source.at<cv::Vec2f>(y, x) - source.at<cv::Vec2f>(y2, x2));
          };
          for (int x = 0; x < size.width; ++x) {
            if (mask_.at<uchar>(y, x) == 0) continue;
            const double scale = std::max(
                {step(x, x - 1, y), step(x, x + 1, y), step(x, x, y - 1), step(x, x, y + 1), 1.0});
            level.at<float>(y, x) = static_cast<float>(std::log2(scale));
          }
        },
        8);
    // At the seam of a whole turn neighbours lie far apart: a median takes such lines away.
    cv::medianBlur(level, level, 3);
    cv::minMaxLoc(level, nullptr, &coarsest);
    const double most = std::log2(std::max(1, std::min(lens_size.width, lens_size.height) / 8));
    coarsest = std::clamp(coarsest, 0.0, std::max(most, 0.0));
  }
  const int levels = 1 + static_cast<int>(std::ceil(coarsest - 1e-3));
  for (int l = 0; l < levels; ++l) {
    Level made;
    cv::Mat share;
    if (l == 0) {
      made.area = cv::boundingRect(mask_);
    } else {
      // Up to half an octave the finer level is sharp and free of aliasing enough.
      share = level - (l - 0.75f);
      share = cv::max(cv::min(share, 1.0), 0.0);
      made.area = cv::boundingRect(share > 0.0);
      if (!made.area.empty()) made.share = share(made.area).clone();
    }
    if (made.area.empty()) break;
    // pyrDown() keeps the even pixels where they are.
    cv::Mat map = source(made.area).clone();
    if (l > 0) {
      const float shrink = std::ldexp(1.0f, -l);
      for (int y = 0; y < map.rows; ++y) {
        for (int x = 0; x < map.cols; ++x) {
          auto& at = map.at<cv::Vec2f>(y, x);
          if (at[0] != kOutside) at *= shrink;
        }
      }
    }
    cv::convertMaps(map, cv::noArray(), made.xy, made.fraction, CV_16SC2);
    levels_.push_back(made);
  }
  for (int y = 0; y < size.height; ++y) {
    const uchar* seen = mask_.ptr<uchar>(y);
    for (int x = 0; x < size.width; ++x) {
      if (seen[x] != 0) continue;
      if (x == 0 || seen[x - 1] != 0) unseen_.push_back({y, x, x});
      unseen_.back().end = x + 1;
    }
  }
}

Eigen::Matrix3d View::cameraMatrix() const {
  const Eigen::Vector2d c = middle(geometry_.size);
  Eigen::Matrix3d K = Eigen::Matrix3d::Identity();
  K(0, 0) = K(1, 1) = geometry_.focal_px;
  K.block<2, 1>(0, 2) = c;
  return K;
}

cv::Mat View::render(const cv::Mat& image) const {
  cv::Mat view;
  render(image, view);
  return view;
}

void View::render(const cv::Mat& image, cv::Mat& view) const {
  if (image.size() != lens_size_) {
    throw Error("image is " + std::to_string(image.cols) + "x" + std::to_string(image.rows) +
                ", but the lens belongs to " + std::to_string(lens_size_.width) + "x" +
                std::to_string(lens_size_.height));
  }
  const int depth = image.depth();
  if ((depth != CV_8U && depth != CV_16U && depth != CV_32F) || image.channels() > 4) {
    throw Error("image has a type that views cannot show, expected 8 or 16 bits or float");
  }
  view.create(geometry_.size, image.type());
  cv::Mat reduced = image;
  for (std::size_t l = 0; l < levels_.size(); ++l) {
    const Level& level = levels_[l];
    if (l == 0) {
      // Half a pixel beyond the border still belongs to the border's pixels.
      cv::Mat part = view(level.area);
      cv::remap(image, part, level.xy, level.fraction, cv::INTER_LINEAR, cv::BORDER_REPLICATE);
      continue;
    }
    cv::Mat next;
    cv::pyrDown(reduced, next);
    reduced = next;
    cv::Mat coarse;
    cv::remap(reduced, coarse, level.xy, level.fraction, cv::INTER_LINEAR, cv::BORDER_REPLICATE);
    cv::Mat fine = view(level.area);
    if (depth == CV_8U) {
      mixRows<uchar>(coarse, level.share, fine);
    } else if (depth == CV_16U) {
      mixRows<ushort>(coarse, level.share, fine);
    } else {
      mixRows<float>(coarse, level.share, fine);
    }
  }
  for (const Unseen& run : unseen_) {
    std::memset(view.ptr(run.y, run.begin), 0,
                view.elemSize() * static_cast<std::size_t>(run.end - run.begin));
  }
}

DepthView::DepthView(const LensModel& lens, cv::Size lens_size, const ViewGeometry& geometry,
                     int threads)
    : lens_size_(lens_size) {
  checkSize(geometry.size, "view");
  checkSize(lens_size, "camera image");
  const cv::Size size = geometry.size;
  nearest_.create(size, CV_16SC2);
  if (geometry.projection == Projection::kPinhole) cosine_.create(size, CV_32FC1);
  const Eigen::Vector3d axis = geometry.rotation.col(2);
  parallelFor(
      0, static_cast<std::size_t>(size.height), threads,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        for (int x = 0; x < size.width; ++x) {
          const auto ray = viewRay(geometry, Eigen::Vector2d(x, y));
          const auto pixel = ray ? lens.project(*ray) : std::nullopt;
          const cv::Point at =
              pixel && pixel->allFinite() && pixel->cwiseAbs().maxCoeff() < kMostSide
                  ? cv::Point(static_cast<int>(std::lround(pixel->x())),
                              static_cast<int>(std::lround(pixel->y())))
                  : cv::Point(-1, -1);
          const bool seen = cv::Rect({0, 0}, lens_size).contains(at);
          nearest_.at<cv::Vec2s>(y, x) =
              seen ? cv::Vec2s(static_cast<short>(at.x), static_cast<short>(at.y))
                   : cv::Vec2s(-1, -1);
          if (!cosine_.empty())
            cosine_.at<float>(y, x) = ray ? static_cast<float>(ray->dot(axis)) : 0.0f;
        }
      },
      8);
}

cv::Mat DepthView::render(const cv::Mat& range) const {
  if (range.size() != lens_size_ || range.type() != CV_32FC1) {
    throw Error("range image is " + std::to_string(range.cols) + "x" + std::to_string(range.rows) +
                ", expected 32-bit floats of the lens' " + std::to_string(lens_size_.width) + "x" +
                std::to_string(lens_size_.height));
  }
  cv::Mat depth;
  cv::remap(range, depth, nearest_, cv::noArray(), cv::INTER_NEAREST, cv::BORDER_CONSTANT,
            cv::Scalar::all(std::numeric_limits<double>::quiet_NaN()));
  if (!cosine_.empty()) cv::multiply(depth, cosine_, depth);
  return depth;
}

}  // namespace omnister
