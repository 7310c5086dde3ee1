// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/drift_monitor.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>
#include <opencv2/video/tracking.hpp>

#include "omnister/common/error.h"
#include "omnister/stereo/epipolar.h"

namespace omnister {
namespace {

const cv::Size kWindow(17, 17);
constexpr int kPyramid = 2;  // levels above the image: drift of some pixels is followed
/// There and back again a feature has to come to where it was [px].
constexpr float kReturn = 0.3f;
/// Further off than this is a wrong match, not drift [px].
constexpr double kGate = 15.0;
/// Sine of the least angle from the baseline: along it everything is on the curve.
constexpr double kLeastAcross = 0.15;

float medianOf(std::vector<float> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// Mean without what is far from the median, and its standard error.
struct Part {
  double mean = 0.0, error = 0.0, deviation = 0.0;
  int count = 0;
};

/// @param pairs of images that the values are from: the same feature seen again is no new evidence
Part summarise(const std::vector<float>& values, int pairs) {
  const float median = medianOf(values);
  std::vector<float> distances;
  for (const float value : values) distances.push_back(std::abs(value - median));
  const float most = std::max(0.3f, 3.0f * 1.4826f * medianOf(distances));
  Part part;
  double sum = 0.0, squares = 0.0;
  for (const float value : values) {
    if (std::abs(value - median) > most) continue;
    sum += value;
    squares += static_cast<double>(value) * value;
    ++part.count;
  }
  part.mean = sum / part.count;
  part.deviation = std::sqrt(std::max(0.0, squares / part.count - part.mean * part.mean));
  const double independent = std::max(1.0, static_cast<double>(part.count) / pairs);
  // With few features their scatter says little about their scatter: Student's widening.
  const double freedom = std::max(1.0, independent - 1.0);
  part.error = part.deviation * std::sqrt((1.0 + 2.0 / freedom) / independent);
  return part;
}

}  // namespace

DriftMonitor::DriftMonitor(const DriftOptions& options) : options_(options) {
  if (options.features < 1 || options.columns < 1 || options.rows < 1 ||
      options.least_in_part < 2 || options.least_parts < 2 || !(options.window > 0.0) ||
      !(options.warn_px > 0.0) || !(options.error_px >= options.warn_px)) {
    throw Error(
        "drift monitor: features, parts, window and limits are expected above zero, and the "
        "limit of an error not below that of a warning");
  }
}

int DriftMonitor::add(double time, const StereoGeometry& geometry, const cv::Mat& reference,
                      const cv::Mat& displaced, const cv::Mat& range) {
  const StereoGeometry::Displaced& other = geometry.displaced.at(0);
  if (reference.type() != CV_8UC1 || displaced.type() != CV_8UC1 ||
      reference.size() != geometry.reference_size || displaced.size() != other.size ||
      range.type() != CV_32FC1 || range.size() != reference.size()) {
    throw Error("drift monitor: images and range are not those of the geometry");
  }
  if (reference_lens_ != geometry.reference_lens || displaced_lens_ != other.lens ||
      (!pairs_.empty() && time < pairs_.back().time)) {
    reset();
  }
  reference_lens_ = geometry.reference_lens;
  displaced_lens_ = other.lens;

  // As many corners from every part, so that no part speaks for the others.
  const cv::Mat matched = range > 0.0;  // not NaN
  const int parts = options_.columns * options_.rows;
  std::vector<cv::Point2f> corners;
  std::vector<int> part_of;
  for (int part = 0; part < parts; ++part) {
    const int column = part % options_.columns;
    const int row = part / options_.columns;
    const cv::Rect area(
        cv::Point(column * reference.cols / options_.columns, row * reference.rows / options_.rows),
        cv::Point((column + 1) * reference.cols / options_.columns,
                  (row + 1) * reference.rows / options_.rows));
    if (area.width < kWindow.width || area.height < kWindow.height) continue;
    std::vector<cv::Point2f> found;
    cv::goodFeaturesToTrack(reference(area), found, std::max(1, options_.features / parts), 0.02,
                            8.0, matched(area));
    for (const cv::Point2f& corner : found) {
      corners.push_back(corner + cv::Point2f(area.tl()));
      part_of.push_back(part);
    }
  }

  struct Feature {
    int part;
    Eigen::Vector3d ray;
  };
  std::vector<Feature> features;
  std::vector<cv::Point2f> from, to;
  const Eigen::Vector3d baseline = other.T_ref_disp.translation();
  for (std::size_t i = 0; i < corners.size(); ++i) {
    const auto ray = geometry.reference_lens->unproject({corners[i].x, corners[i].y});
    const float along = range.at<float>(cvRound(corners[i].y), cvRound(corners[i].x));
    if (!ray || !(along > 0.0f)) continue;
    if (ray->cross(baseline.normalized()).norm() < kLeastAcross) continue;
    const auto seen =
        EpipolarCurve(*ray, other.T_ref_disp, *other.lens).pixel(1.0 / static_cast<double>(along));
    if (!seen) continue;
    features.push_back({part_of[i], *ray});
    from.push_back(corners[i]);
    to.emplace_back(static_cast<float>(seen->x()), static_cast<float>(seen->y()));
  }

  Pair pair;
  pair.time = time;
  if (!features.empty()) {
    std::vector<cv::Mat> pyramids[2];
    cv::buildOpticalFlowPyramid(reference, pyramids[0], kWindow, kPyramid);
    cv::buildOpticalFlowPyramid(displaced, pyramids[1], kWindow, kPyramid);
    const cv::TermCriteria stop(cv::TermCriteria::COUNT | cv::TermCriteria::EPS, 20, 0.01);
    std::vector<cv::Point2f> back = from;
    std::vector<uchar> followed, returned;
    std::vector<float> ignored;
    cv::calcOpticalFlowPyrLK(pyramids[0], pyramids[1], from, to, followed, ignored, kWindow,
                             kPyramid, stop, cv::OPTFLOW_USE_INITIAL_FLOW, 1e-3);
    cv::calcOpticalFlowPyrLK(pyramids[1], pyramids[0], to, back, returned, ignored, kWindow,
                             kPyramid, stop, cv::OPTFLOW_USE_INITIAL_FLOW, 1e-3);
    for (std::size_t i = 0; i < features.size(); ++i) {
      if (followed[i] == 0 || returned[i] == 0 || cv::norm(back[i] - from[i]) > kReturn) continue;
      Jacobian32 d;
      const auto ray = other.lens->unproject({to[i].x, to[i].y}, &d);
      if (!ray) continue;
      const Eigen::Vector3d there = other.T_ref_disp.linear() * *ray;
      if (there.cross(baseline.normalized()).norm() < kLeastAcross) continue;
      // Off the plane of baseline and reference ray. The sign stays when the two cameras change
      // places, so that a stage that goes to and fro does not cancel it.
      const double sine = baseline.cross(features[i].ray).normalized().dot(there);
      const double px_per_rad = 1.0 / std::max(1e-9, std::sqrt(0.5) * d.norm());
      const double px = std::asin(std::clamp(sine, -1.0, 1.0)) * px_per_rad;
      if (std::abs(px) < kGate)
        pair.residuals.push_back({features[i].part, static_cast<float>(px)});
    }
  }
  pairs_.push_back(std::move(pair));
  while (time - pairs_.front().time > options_.window) pairs_.pop_front();
  return static_cast<int>(pairs_.back().residuals.size());
}

DriftVerdict DriftMonitor::verdict() const {
  DriftVerdict verdict;
  std::vector<std::vector<float>> values(
      static_cast<std::size_t>(options_.columns * options_.rows));
  std::vector<int> pairs_seen(values.size(), 0);
  for (const Pair& pair : pairs_) {
    if (pair.residuals.empty()) continue;
    ++verdict.pairs;
    std::vector<char> seen(values.size(), 0);
    for (const Residual& residual : pair.residuals) {
      const auto part = static_cast<std::size_t>(residual.part);
      values[part].push_back(residual.px);
      pairs_seen[part] += seen[part] == 0;
      seen[part] = 1;
    }
  }
  double squares = 0.0, variance = 0.0, scatter = 0.0;
  for (std::size_t i = 0; i < values.size(); ++i) {
    if (static_cast<int>(values[i].size()) < options_.least_in_part) continue;
    const Part part = summarise(values[i], pairs_seen[i]);
    const double m2 = part.mean * part.mean;
    const double s2 = part.error * part.error;
    squares += m2 - s2;
    // Of the square of a normal variable.
    variance += 4.0 * m2 * s2 + 2.0 * s2 * s2;
    scatter += part.deviation * part.deviation;
    verdict.features += part.count;
    ++verdict.parts;
  }
  if (verdict.parts < options_.least_parts) return verdict;
  squares /= verdict.parts;
  const double sigma = std::sqrt(variance) / verdict.parts;
  verdict.drift_px = std::sqrt(std::max(0.0, squares));
  verdict.at_least_px = std::sqrt(std::max(0.0, squares - 2.0 * sigma));
  verdict.noise_px = std::sqrt(scatter / verdict.parts);
  using State = DriftVerdict::State;
  verdict.state = verdict.at_least_px > options_.error_px  ? State::kError
                  : verdict.at_least_px > options_.warn_px ? State::kWarning
                                                           : State::kGood;
  return verdict;
}

}  // namespace omnister
