// SPDX-License-Identifier: Apache-2.0
/// @file A scene small enough to be right at sight: textured rectangles, ray-traced without any
/// code of the product but the lens.
#pragma once

#include <Eigen/Core>
#include <cmath>
#include <limits>
#include <opencv2/core.hpp>
#include <optional>
#include <random>
#include <vector>

#include "omnister/common/pose.h"
#include "omnister/lens/lens_model.h"

namespace omnister::test {

/// Grey levels around 128: a sum of plane waves of random direction over a plane.
class Waves {
 public:
  /// @param shortest, longest wavelength [m]
  Waves(double shortest, double longest, unsigned seed) {
    std::mt19937 random(seed);
    const auto uniform = [&] { return static_cast<double>(random()) / 4294967296.0; };
    for (int i = 0; i < kWaves; ++i) {
      const double length = shortest * std::pow(longest / shortest, uniform());
      const double direction = 2.0 * M_PI * uniform();
      waves_.push_back({2.0 * M_PI / length * std::cos(direction),
                        2.0 * M_PI / length * std::sin(direction), 2.0 * M_PI * uniform()});
    }
  }

  double operator()(double s, double t) const {
    double sum = 0.0;
    for (const Eigen::Vector3d& wave : waves_)
      sum += std::cos(wave.x() * s + wave.y() * t + wave.z());
    return 128.0 + 100.0 * std::tanh(sum / std::sqrt(kWaves / 2.0) / 1.5);
  }

 private:
  static constexpr int kWaves = 20;
  std::vector<Eigen::Vector3d> waves_;
};

struct Rectangle {
  Eigen::Vector3d center;
  Eigen::Vector3d normal;
  double half_side;  ///< [m], both ways
  Waves texture;
};

struct View {
  cv::Mat image;  ///< CV_8UC1
  cv::Mat range;  ///< CV_64FC1 along the ray of the pixel's centre [m]; NaN where nothing
};

inline std::optional<double> hit(const Rectangle& rectangle, const Eigen::Vector3d& origin,
                                 const Eigen::Vector3d& ray, double* grey) {
  const double slope = rectangle.normal.dot(ray);
  if (std::abs(slope) < 1e-12) return std::nullopt;
  const double range = rectangle.normal.dot(rectangle.center - origin) / slope;
  if (!(range > 0.0)) return std::nullopt;
  const Eigen::Vector3d right = rectangle.normal.unitOrthogonal();
  const Eigen::Vector3d offset = origin + range * ray - rectangle.center;
  const double s = right.dot(offset);
  const double t = rectangle.normal.cross(right).dot(offset);
  if (std::abs(s) > rectangle.half_side || std::abs(t) > rectangle.half_side) return std::nullopt;
  if (grey != nullptr) *grey = rectangle.texture(s, t);
  return range;
}

/// @param T_world_camera maps the optical frame into the frame of the rectangles
inline View look(const std::vector<Rectangle>& scene, const LensModel& lens, cv::Size size,
                 const Pose& T_world_camera, int supersampling = 3) {
  View view{cv::Mat(size, CV_8UC1, cv::Scalar(0)),
            cv::Mat(size, CV_64FC1, cv::Scalar(std::numeric_limits<double>::quiet_NaN()))};
  const Eigen::Vector3d origin = T_world_camera.translation();
  const auto trace = [&](double u, double v, double* grey) {
    std::optional<double> nearest;
    const auto bearing = lens.unproject({u, v});
    if (!bearing) return nearest;
    const Eigen::Vector3d ray = T_world_camera.linear() * *bearing;
    for (const Rectangle& rectangle : scene) {
      double here = 0.0;
      const auto range = hit(rectangle, origin, ray, grey != nullptr ? &here : nullptr);
      if (range && (!nearest || *range < *nearest)) {
        nearest = range;
        if (grey != nullptr) *grey = here;
      }
    }
    return nearest;
  };
  for (int v = 0; v < size.height; ++v) {
    for (int u = 0; u < size.width; ++u) {
      if (const auto range = trace(u, v, nullptr)) view.range.at<double>(v, u) = *range;
      double sum = 0.0;
      for (int j = 0; j < supersampling; ++j) {
        for (int i = 0; i < supersampling; ++i) {
          double grey = 0.0;
          trace(u + (i + 0.5) / supersampling - 0.5, v + (j + 0.5) / supersampling - 0.5, &grey);
          sum += grey;
        }
      }
      view.image.at<uchar>(v, u) = cv::saturate_cast<uchar>(sum / (supersampling * supersampling));
    }
  }
  return view;
}

/// A plane far larger than the field at a depth along the axis.
inline std::vector<Rectangle> wall(double depth, double shortest_wave, unsigned seed = 1) {
  return {{{0.0, 0.0, depth},
           {0.0, 0.0, -1.0},
           100.0 * depth,
           Waves(shortest_wave, 8.0 * shortest_wave, seed)}};
}

/// A room seen from inside: six walls at `distance` from the origin, turned so that none is square
/// to an axis of the camera.
inline std::vector<Rectangle> room(double distance, double shortest_wave, unsigned seed = 1) {
  const Eigen::Matrix3d R =
      Eigen::AngleAxisd(0.4, Eigen::Vector3d(0.3, 1.0, 0.2).normalized()).toRotationMatrix();
  std::vector<Rectangle> walls;
  for (int axis = 0; axis < 3; ++axis) {
    for (double sign : {-1.0, 1.0}) {
      const Eigen::Vector3d normal = sign * R.col(axis);
      walls.push_back({distance * normal, -normal, distance,
                       Waves(shortest_wave, 8.0 * shortest_wave, seed + walls.size())});
    }
  }
  return walls;
}

inline Pose pose(double x, double y, double z, double angle = 0.0,
                 const Eigen::Vector3d& axis = Eigen::Vector3d::UnitY()) {
  Pose result = Pose::Identity();
  result.translation() = Eigen::Vector3d(x, y, z);
  result.linear() = Eigen::AngleAxisd(angle, axis.normalized()).toRotationMatrix();
  return result;
}

}  // namespace omnister::test
