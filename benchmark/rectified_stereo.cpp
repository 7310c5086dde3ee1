// SPDX-License-Identifier: Apache-2.0
#include "rectified_stereo.h"

#include <chrono>
#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>

#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "stereo_pair.h"

namespace omnister::bench {
namespace {

constexpr double kDegree = 3.14159265358979324 / 180.0;
constexpr double kMargin = 1.0 * kDegree;  // left out at each end of both angles
constexpr int kSixteenth = 16;             // OpenCV's fixed-point disparity

using Clock = std::chrono::steady_clock;
double seconds(Clock::time_point from, Clock::time_point to) {
  return std::chrono::duration<double>(to - from).count();
}

}  // namespace

RectifiedStereo::RectifiedStereo(const std::string& method, const StereoGeometry& geometry,
                                 double focal_px, int threads)
    : focal_(focal_px), threads_(threads) {
  const auto& displaced = geometry.displaced.at(0);
  const Eigen::Vector3d t = displaced.T_ref_disp.translation();
  baseline_ = t.norm();
  disparities_ = (static_cast<int>(std::ceil(kMaxParallax * focal_)) + 15) / 16 * 16;
  const int side = static_cast<int>(std::lround((180.0 * kDegree - 2.0 * kMargin) * focal_));
  // OpenCV finds nothing in the first `disparities` columns: they stay empty.
  size_ = {side + disparities_, side};

  const Eigen::Vector3d e = t / baseline_;
  Eigen::Vector3d n = Eigen::Vector3d::UnitZ() - e.z() * e;
  if (n.norm() < 0.1) n = Eigen::Vector3d::UnitY() - e.y() * e;
  n.normalize();
  const Eigen::Vector3d m = n.cross(e);
  const Eigen::Matrix3d R_disp_ref = displaced.T_ref_disp.linear().transpose();

  cv::Mat reference(size_, CV_32FC2, cv::Scalar(-16, -16));
  cv::Mat other(size_, CV_32FC2, cv::Scalar(-16, -16));
  parallelFor(
      0, static_cast<std::size_t>(size_.height), 0,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        const double phi = (y - 0.5 * (side - 1)) / focal_;
        for (int x = disparities_; x < size_.width; ++x) {
          const double theta = 180.0 * kDegree - kMargin - (x - disparities_ + 0.5) / focal_;
          const Eigen::Vector3d ray =
              std::cos(theta) * e + std::sin(theta) * (std::cos(phi) * n + std::sin(phi) * m);
          const auto a = geometry.reference_lens->project(ray);
          if (a)
            reference.at<cv::Vec2f>(y, x) = {static_cast<float>(a->x()),
                                             static_cast<float>(a->y())};
          const auto b = displaced.lens->project(R_disp_ref * ray);
          if (b)
            other.at<cv::Vec2f>(y, x) = {static_cast<float>(b->x()), static_cast<float>(b->y())};
        }
      },
      8);
  cv::convertMaps(reference, cv::noArray(), map_reference_[0], map_reference_[1], CV_16SC2);
  cv::convertMaps(other, cv::noArray(), map_displaced_[0], map_displaced_[1], CV_16SC2);

  place_.create(geometry.reference_size, CV_32FC2);
  place_.setTo(cv::Scalar(-1, -1));
  parallelFor(
      0, static_cast<std::size_t>(place_.rows), 0,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        for (int x = 0; x < place_.cols; ++x) {
          const auto ray = geometry.reference_lens->unproject(Eigen::Vector2d(x, y));
          if (!ray) continue;
          const double theta = std::acos(std::clamp(ray->dot(e), -1.0, 1.0));
          const double phi = std::atan2(ray->dot(m), ray->dot(n));
          const double u = (180.0 * kDegree - kMargin - theta) * focal_ - 0.5 + disparities_;
          const double v = phi * focal_ + 0.5 * (side - 1);
          if (u < disparities_ || v < 0 || u > size_.width - 1 || v > size_.height - 1) continue;
          place_.at<cv::Vec2f>(y, x) = {static_cast<float>(u), static_cast<float>(v)};
        }
      },
      8);
  for (int d = 0; d <= disparities_ * kSixteenth; ++d) {
    tangents_.push_back(static_cast<float>(std::tan(d / (kSixteenth * focal_))));
  }
  for (int x = 0; x < size_.width; ++x) {
    const double theta = 180.0 * kDegree - kMargin - (x - disparities_ + 0.5) / focal_;
    sines_.push_back(static_cast<float>(std::sin(theta)));
    cosines_.push_back(static_cast<float>(std::cos(theta)));
  }

  if (method == "bm") {
    auto bm = cv::StereoBM::create(disparities_, 15);
    bm->setUniquenessRatio(5);
    bm->setDisp12MaxDiff(1);
    bm->setSpeckleWindowSize(100);
    bm->setSpeckleRange(2);
    matcher_ = bm;
  } else if (method == "sgbm" || method == "3way") {
    constexpr int kBlock = 5;
    matcher_ = cv::StereoSGBM::create(
        0, disparities_, kBlock, 8 * kBlock * kBlock, 32 * kBlock * kBlock, 1, 31, 5, 100, 2,
        method == "sgbm" ? cv::StereoSGBM::MODE_SGBM : cv::StereoSGBM::MODE_SGBM_3WAY);
  } else {
    throw Error("method is '" + printable(method) + "', expected bm, sgbm or 3way");
  }
}

cv::Mat RectifiedStereo::match(const cv::Mat& reference, const cv::Mat& displaced, Times* times) {
  const auto start = Clock::now();
  cv::Mat left, right, disparity;
  cv::remap(reference, left, map_reference_[0], map_reference_[1], cv::INTER_LINEAR);
  cv::remap(displaced, right, map_displaced_[0], map_displaced_[1], cv::INTER_LINEAR);
  const auto rectified = Clock::now();
  matcher_->compute(left, right, disparity);
  const auto matched = Clock::now();
  cv::Mat range(place_.size(), CV_32FC1);
  const auto b = static_cast<float>(baseline_);
  parallelFor(
      0, static_cast<std::size_t>(range.rows), threads_,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        const cv::Vec2f* place = place_.ptr<cv::Vec2f>(y);
        float* out = range.ptr<float>(y);
        for (int x = 0; x < range.cols; ++x) {
          out[x] = std::numeric_limits<float>::quiet_NaN();
          const float u = place[x][0];
          const float v = place[x][1];
          if (u < 0.0f) continue;
          const int u0 = static_cast<int>(u);
          const int v0 = static_cast<int>(v);
          const int u1 = std::min(u0 + 1, size_.width - 1);
          const int v1 = std::min(v0 + 1, size_.height - 1);
          const short* top = disparity.ptr<short>(v0);
          const short* bottom = disparity.ptr<short>(v1);
          const short a = top[u0], c = top[u1], f = bottom[u0], g = bottom[u1];
          const short least = std::min(std::min(a, c), std::min(f, g));
          const short most = std::max(std::max(a, c), std::max(f, g));
          float d;
          if (least > 0 && most - least <= kSixteenth) {
            const float tu = u - static_cast<float>(u0);
            const float tv = v - static_cast<float>(v0);
            const float upper = static_cast<float>(a) + tu * static_cast<float>(c - a);
            const float lower = static_cast<float>(f) + tu * static_cast<float>(g - f);
            d = upper + tv * (lower - upper);
          } else {  // across an edge: the nearest one
            const short* nearest = v - static_cast<float>(v0) < 0.5f ? top : bottom;
            d = nearest[u - static_cast<float>(u0) < 0.5f ? u0 : u1];
          }
          if (!(d > 0.0f)) continue;
          const int step = std::min(static_cast<int>(d), disparities_ * kSixteenth - 1);
          const float tangent = tangents_[step] + (d - static_cast<float>(step)) *
                                                      (tangents_[step + 1] - tangents_[step]);
          // b sin(theta + delta) / sin(delta)
          const float share = u - static_cast<float>(u0);
          const float sine = sines_[u0] + share * (sines_[u1] - sines_[u0]);
          const float cosine = cosines_[u0] + share * (cosines_[u1] - cosines_[u0]);
          out[x] = b * (sine / tangent + cosine);
        }
      },
      16);
  const auto done = Clock::now();
  if (times != nullptr) {
    times->rectify = seconds(start, rectified);
    times->match = seconds(rectified, matched);
    times->transfer = seconds(matched, done);
  }
  return range;
}

}  // namespace omnister::bench
