// SPDX-License-Identifier: Apache-2.0
#include "stereo_pair.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <opencv2/core.hpp>

#include "omnister/common/parallel.h"
#include "omnister/lens/lens_models.h"

namespace omnister::bench {
namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr double kDegree = 3.14159265358979324 / 180.0;

double median(std::vector<float>& values) {
  if (values.empty()) return kNan;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

double share(std::size_t part, std::size_t whole) {
  return whole == 0 ? kNan : static_cast<double>(part) / static_cast<double>(whole);
}

/// Parallax of a point at `range` along a unit ray, for a camera displaced by `t` [rad].
double parallax(const Eigen::Vector3d& ray, double range, const Eigen::Vector3d& t) {
  const Eigen::Vector3d other = range * ray - t;
  return std::atan2(other.cross(ray).norm(), other.dot(ray));
}

}  // namespace

const double kMaxParallax = std::atan(0.25);

LensPtr equidistant180(cv::Size size) {
  LensStructure structure;
  structure.model = "spline";  // exact for r = f theta
  structure.knots = 16;
  return makeLens(structure, {0.5 * (size.width - 1), 0.5 * (size.height - 1)},
                  size.width / (180.0 * kDegree), 90.0 * kDegree);
}

StereoCase makeCase(const std::string& name, const sim::Scene& scene, const LensPtr& lens,
                    cv::Size size, const CaseOptions& options) {
  StereoCase result;
  result.name = name;
  result.geometry.reference_lens = lens;
  result.geometry.reference_size = size;
  const Eigen::Vector2d ahead = *lens->project({0.0, 0.0, 1.0});
  result.focal_px = (*lens->project({std::sin(0.01), 0.0, std::cos(0.01)}) - ahead).norm() / 0.01;

  const sim::Renderer renderer(*lens, size);
  sim::RenderOptions render;
  render.color = false;
  render.noise_sigma = options.noise_sigma;
  const sim::Rendering reference = renderer.render(scene, options.T_world_reference, render);
  result.reference = reference.image;
  result.range = reference.range;

  double nearest = 0.0;
  cv::minMaxLoc(result.range, &nearest, nullptr, nullptr, nullptr, result.range == result.range);
  const double baseline =
      options.baseline > 0.0 ? options.baseline : std::tan(kMaxParallax) * nearest;
  for (int k = 1; k <= options.positions; ++k) {
    StereoGeometry::Displaced displaced;
    displaced.lens = lens;
    displaced.size = size;
    displaced.T_ref_disp.translation() = k * baseline * options.direction.normalized();
    render.seed = 1 + static_cast<std::uint64_t>(k);
    result.displaced.push_back(
        renderer.render(scene, options.T_world_reference * displaced.T_ref_disp, render).image);
    result.geometry.displaced.push_back(displaced);
  }

  result.kind.create(size, CV_8UC1);
  result.kind.setTo(kOutside);
  result.theta.create(size, CV_32FC1);
  result.theta.setTo(std::numeric_limits<float>::quiet_NaN());
  const Pose& T_ref_disp = result.geometry.displaced[0].T_ref_disp;
  const Pose T_disp_ref = T_ref_disp.inverse();
  const Eigen::Vector3d from = (options.T_world_reference * T_ref_disp).translation();
  parallelFor(
      0, static_cast<std::size_t>(size.height), 0,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        for (int x = 0; x < size.width; ++x) {
          const auto ray = lens->unproject(Eigen::Vector2d(x, y));
          if (!ray) continue;
          result.theta.at<float>(y, x) =
              static_cast<float>(std::atan2(ray->head<2>().norm(), ray->z()));
          const double range = result.range.at<float>(y, x);
          if (std::isnan(range)) continue;
          // Wider parallax than the comparison searches for is nobody's fault.
          if (parallax(*ray, range, T_ref_disp.translation()) > kMaxParallax) continue;
          const Eigen::Vector3d point = range * *ray;
          const auto pixel = lens->project(T_disp_ref * point);
          if (!pixel || pixel->x() < -0.5 || pixel->y() < -0.5 || pixel->x() > size.width - 0.5 ||
              pixel->y() > size.height - 0.5) {
            continue;
          }
          const Eigen::Vector3d across = options.T_world_reference * point - from;
          const auto seen = scene.rangeAlong(from, across);
          const bool hidden = seen && *seen < across.norm() * (1.0 - 1e-3);
          result.kind.at<uchar>(y, x) = hidden ? kOccluded : kTruth;
        }
      },
      8);
  return result;
}

Score score(const StereoCase& pair, const cv::Mat& range, const cv::Mat& subset) {
  const double edges[] = {0, 40, 60, 70, 80, 90, 180};
  struct Sums {
    std::size_t truth = 0, matched = 0, off = 0, far = 0;
    std::vector<float> errors;
  };
  Sums all;
  std::vector<Sums> bands(std::size(edges) - 1);
  std::size_t occluded = 0;
  std::size_t filled = 0;
  const StereoGeometry& geometry = pair.geometry;
  const Pose T_disp_ref = geometry.displaced[0].T_ref_disp.inverse();
  for (int y = 0; y < range.rows; ++y) {
    for (int x = 0; x < range.cols; ++x) {
      if (!subset.empty() && subset.at<uchar>(y, x) == 0) continue;
      const uchar kind = pair.kind.at<uchar>(y, x);
      if (kind == kOutside) continue;
      const float found = range.at<float>(y, x);
      const bool matched = std::isfinite(found);
      if (kind == kOccluded) {
        ++occluded;
        if (matched) ++filled;
        continue;
      }
      const double theta = pair.theta.at<float>(y, x) / kDegree;
      std::size_t band = 0;
      while (band + 2 < std::size(edges) && theta >= edges[band + 1]) ++band;
      ++all.truth;
      ++bands[band].truth;
      if (!matched) continue;
      const float truth = pair.range.at<float>(y, x);
      const float error = std::abs(found - truth) / truth * 100.0f;
      const Eigen::Vector3d ray = *geometry.reference_lens->unproject(Eigen::Vector2d(x, y));
      const auto there = geometry.displaced[0].lens->project(T_disp_ref * (truth * ray));
      const auto where = geometry.displaced[0].lens->project(T_disp_ref * (found * ray));
      const bool off = !where || !there || (*where - *there).norm() > 1.0;
      for (Sums* sums : {&all, &bands[band]}) {
        ++sums->matched;
        if (off) ++sums->off;
        if (error > 2.0f) ++sums->far;
        sums->errors.push_back(error);
      }
    }
  }
  Score result;
  result.truth = all.truth;
  result.density = share(all.matched, all.truth);
  result.median_percent = median(all.errors);
  result.over_1px = share(all.off, all.matched);
  result.over_2percent = share(all.far, all.matched);
  result.occluded_filled = share(filled, occluded);
  for (std::size_t b = 0; b < bands.size(); ++b) {
    if (bands[b].truth == 0) continue;
    result.bands.push_back({edges[b], edges[b + 1], bands[b].truth,
                            share(bands[b].matched, bands[b].truth), median(bands[b].errors),
                            share(bands[b].off, bands[b].matched)});
  }
  return result;
}

std::vector<double> biasByPhase(const StereoCase& pair, const cv::Mat& range, int bins) {
  std::vector<double> sums(bins, 0.0);
  std::vector<int> counts(bins, 0);
  const Eigen::Vector3d t = pair.geometry.displaced[0].T_ref_disp.translation();
  for (int y = 0; y < range.rows; ++y) {
    for (int x = 0; x < range.cols; ++x) {
      const float found = range.at<float>(y, x);
      if (pair.kind.at<uchar>(y, x) != kTruth || !std::isfinite(found)) continue;
      const Eigen::Vector3d ray = *pair.geometry.reference_lens->unproject(Eigen::Vector2d(x, y));
      const double truth = parallax(ray, pair.range.at<float>(y, x), t) * pair.focal_px;
      const double error = parallax(ray, found, t) * pair.focal_px - truth;
      if (std::abs(error) > 1.0) continue;  // a mismatch, not a bias
      const int bin = std::min(static_cast<int>((truth - std::floor(truth)) * bins), bins - 1);
      sums[bin] += error;
      ++counts[bin];
    }
  }
  for (int i = 0; i < bins; ++i) sums[i] = counts[i] > 0 ? sums[i] / counts[i] : kNan;
  return sums;
}

}  // namespace omnister::bench
