// SPDX-License-Identifier: Apache-2.0
#include "stereo/sweep/refine/weak_texture.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>
#include <utility>

#include "omnister/common/parallel.h"
#include "stereo/sweep/refine/filters.h"

namespace omnister::sweep {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr float kPi = 3.14159265f;
constexpr float kLeastShare = 0.02f;  ///< of the field that must be weak and fillable
constexpr int kWeakVariance = 49;     ///< of grey values where texture is weak
constexpr int kUnlit = 16;            ///< grey values below which nothing is seen
constexpr int kRadius = 2;            ///< over which a coarse surface is averaged [px of it]
constexpr int kCoherent = 60;         ///< least region of a coarse level [px of it]
constexpr float kSurface = 1.0f;      ///< steps that neighbours on a surface differ by at most
constexpr float kPrior = 0.1f;        ///< error of a coarse surface [px of the half image]
constexpr float kAgree = 9.0f;        ///< variances that two estimates of one pixel may differ by
constexpr float kSpread = 2.0f;       ///< of what neighbours share, in standard deviation
constexpr float kSame = 2.0f;         ///< coarse steps that two views of one spot may differ by

/// Mean over a window of those within `near` of the middle; rows first, then columns.
void averageSurface(cv::Mat* h, float near, int threads) {
  const int width = h->cols, height = h->rows;
  cv::Mat rows(h->size(), CV_32FC1);
  const auto mean = [&](const cv::Mat& in, cv::Mat* out, int dx, int dy) {
    parallelFor(
        0, static_cast<std::size_t>(height), threads,
        [&](std::size_t row) {
          const int y = static_cast<int>(row);
          const float* here = in.ptr<float>(y);
          float* to = out->ptr<float>(y);
          for (int x = 0; x < width; ++x) {
            float sum = 0;
            int n = 0;
            for (int k = -kRadius; k <= kRadius; ++k) {
              const int u = x + k * dx, v = y + k * dy;
              if (u < 0 || v < 0 || u >= width || v >= height) continue;
              const float apart = in.ptr<float>(v)[u] - here[x];
              if (!(std::fabs(apart) <= near)) continue;
              sum += apart;
              ++n;
            }
            to[x] = n > 0 ? here[x] + sum / static_cast<float>(n) : kNaN;
          }
        },
        16);
  };
  mean(*h, &rows, 1, 0);
  mean(rows, h, 0, 1);
}

/// Whether the grey values around a pixel hardly differ, though light falls there: what lies in the
/// field of the lens model but beyond the image circle is no wall.
bool isWeak(const cv::Mat& image, int x, int y) {
  constexpr int kReach = 6, kStep = 3;
  const int x0 = std::max(x - kReach, 0), x1 = std::min(x + kReach, image.cols - 1);
  const int y0 = std::max(y - kReach, 0), y1 = std::min(y + kReach, image.rows - 1);
  int sum = 0, squares = 0, n = 0;
  for (int v = y0; v <= y1; v += kStep) {
    const std::uint8_t* line = image.ptr(v);
    for (int u = x0; u <= x1; u += kStep) {
      sum += line[u];
      squares += line[u] * line[u];
      ++n;
    }
  }
  return sum >= kUnlit * n && squares * n - sum * sum < kWeakVariance * n * n;
}

/// Hypothesis of a coarse level at a pixel of the full image; NaN where it has none.
float coarseAt(const cv::Mat& h, float near, int scale, int x, int y) {
  const float u = std::clamp((static_cast<float>(x) + 0.5f) / static_cast<float>(scale) - 0.5f,
                             0.0f, static_cast<float>(h.cols - 1));
  const float v = std::clamp((static_cast<float>(y) + 0.5f) / static_cast<float>(scale) - 0.5f,
                             0.0f, static_cast<float>(h.rows - 1));
  const int i = static_cast<int>(u), j = static_cast<int>(v);
  const float a = u - static_cast<float>(i), b = v - static_cast<float>(j);
  const float* top = h.ptr<float>(j);
  const float* low = h.ptr<float>(std::min(j + 1, h.rows - 1));
  const int next = std::min(i + 1, h.cols - 1);
  const float corners[4] = {top[i], top[next], low[i], low[next]};
  const float weights[4] = {(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b};
  const int nearest = (a > 0.5f ? 1 : 0) + (b > 0.5f ? 2 : 0);
  const float middle = corners[nearest];
  if (std::isnan(middle)) return kNaN;
  float sum = 0, all = 0;
  for (int k = 0; k < 4; ++k) {
    if (!(std::fabs(corners[k] - middle) <= near)) continue;
    sum += weights[k] * corners[k];
    all += weights[k];
  }
  return sum / all;
}

/// Spots of the displaced image, by what was matched with them.
class Spots {
 public:
  explicit Spots(float step) : per_radian_(1 / (2 * step)) {
    width_ = static_cast<int>(kPi * per_radian_) + 3;
    height_ = static_cast<int>(2 * kPi * per_radian_) + 3;
    seen_.assign(static_cast<std::size_t>(width_) * height_, kNaN);
  }
  void see(const MapView& map, int x, int y, float h) {
    float& spot = seen_[at(map, x, y, h)];
    if (std::isnan(spot) || h > spot) spot = h;
  }
  /// Whether another range was seen there.
  bool taken(const MapView& map, int x, int y, float h, float tolerance) const {
    const float spot = seen_[at(map, x, y, h)];
    return std::fabs(spot - h) > tolerance;  // false for NaN
  }

 private:
  std::size_t at(const MapView& map, int x, int y, float h) const {
    const std::size_t i = map.at(x, y);
    const float phi = static_cast<float>(map.phi[i]) / static_cast<float>(kPhiUnits) - kPi;
    const float theta = map.a[i] + h;
    const int column = std::clamp(static_cast<int>(theta * per_radian_), 0, width_ - 1);
    const int row =
        std::clamp(static_cast<int>((phi * std::sin(theta) + kPi) * per_radian_), 0, height_ - 1);
    return static_cast<std::size_t>(row) * width_ + column;
  }
  float per_radian_;
  int width_ = 0, height_ = 0;
  std::vector<float> seen_;
};

}  // namespace

WeakFill::WeakFill(const StereoGeometry& geometry, int threads)
    : geometry_(geometry), threads_(threads) {}
WeakFill::~WeakFill() = default;

std::size_t WeakFill::fill(const Job& job, cv::Mat* h, cv::Mat* sigma) {
  const int width = job.map->size.width, height = job.map->size.height;
  // Views of rows: one of all pixels would be the largest thing here.
  const auto viewRow = [](const ReferenceMap& map, int y, MapView* view) {
    viewMap(map, cv::Rect(0, y, map.size.width, 1), view);
  };
  const auto hasRay = [](const MapView& map, int x) { return map.phi[x] != kNoRay; };
  MapView map;
  sigma->release();
  if (job.coarse.empty()) return 0;
  // A look at every sixteenth pixel tells whether there is anything to do. Most have a match, or
  // lie where no level has one: the map is made for few rows.
  std::size_t open = 0;
  for (int y = 2; y < height; y += 4) {
    const float* line = h->ptr<float>(y);
    bool viewed = false;
    for (int x = 2; x < width; x += 4) {
      if (!std::isnan(line[x])) continue;
      const bool seen = std::any_of(job.coarse.begin(), job.coarse.end(),
                                    [&, level = 1](const CoarseLevel& coarse) mutable {
                                      const int v = std::min(y >> level, coarse.h->rows - 1);
                                      const int u = std::min(x >> level, coarse.h->cols - 1);
                                      ++level;
                                      return !std::isnan(coarse.h->at<float>(v, u));
                                    });
      if (!seen || !isWeak(job.reference, x, y)) continue;
      if (!std::exchange(viewed, true)) viewRow(*job.map, y, &map);
      open += hasRay(map, x);
    }
  }
  const float field = static_cast<float>(job.map->field) / 16;
  if (static_cast<float>(open) < kLeastShare * field) return 0;

  // Surfaces of the half image, from the finest level that has one.
  std::vector<cv::Mat> surfaces;
  for (const CoarseLevel& coarse : job.coarse) {
    surfaces.push_back(coarse.h->clone());
    const float near = kSurface * coarse.step;
    removeSpeckles(&surfaces.back(), near, kCoherent, threads_);
    averageSurface(&surfaces.back(), near, threads_);
  }
  const cv::Size half = job.half->size;
  const float b = job.baseline;
  cv::Mat inverse(half, CV_32FC1), weight(half, CV_32FC1, cv::Scalar(0));
  const cv::Mat support(half, CV_8UC1, cv::Scalar(1));
  parallelFor(
      0, static_cast<std::size_t>(half.height), threads_,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        float* to = inverse.ptr<float>(y);
        MapView view;
        viewRow(*job.half, y, &view);
        for (int x = 0; x < half.width; ++x) {
          to[x] = kNaN;
          if (!hasRay(view, x)) continue;
          for (std::size_t l = 0; l < surfaces.size(); ++l) {
            const float found = coarseAt(surfaces[l], kSurface * job.coarse[l].step, 1 << l, x, y);
            if (!(found > 0) || !(view.a[x] + found < kPi)) continue;
            to[x] = std::sin(found) / (b * std::sin(view.a[x] + found));
            break;
          }
        }
      },
      8);
  surfaces.clear();
  if (!refinement_) refinement_ = std::make_unique<JointRefinement>(geometry_, threads_, 2, kPrior);
  refinement_->refine(job.reference, {job.displaced}, support, &inverse, &weight);
  // Back to hypotheses; weight becomes their standard deviation.
  parallelFor(
      0, static_cast<std::size_t>(half.height), threads_,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        float* w = inverse.ptr<float>(y);
        float* s = weight.ptr<float>(y);
        MapView view;
        viewRow(*job.half, y, &view);
        for (int x = 0; x < half.width; ++x) {
          if (std::isnan(w[x])) continue;
          const float a = view.a[x];
          const auto hypothesis = [&](float at) {
            return std::atan2(b * at * std::sin(a), 1 - b * at * std::cos(a));
          };
          const float spread = s[x] > 0 ? 1 / std::sqrt(s[x]) : w[x];
          const float found = hypothesis(w[x]);
          s[x] = std::fabs(hypothesis(w[x] + spread) - found);
          w[x] = found;
        }
      },
      8);

  Spots spots(job.step);
  for (int y = 0; y < height; y += 2) {
    const float* line = h->ptr<float>(y);
    viewRow(*job.map, y, &map);
    for (int x = 0; x < width; x += 2)
      if (!std::isnan(line[x])) spots.see(map, x, y, line[x]);
  }
  sigma->create(height, width, CV_32FC1);
  sigma->setTo(kNaN);
  const float step = job.coarse[0].step;
  parallelFor(
      0, static_cast<std::size_t>(height), threads_,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        float* line = h->ptr<float>(y);
        float* to = sigma->ptr<float>(y);
        MapView view;
        viewRow(*job.map, y, &view);
        for (int x = 0; x < width; ++x) {
          if (!hasRay(view, x)) continue;
          const float found = coarseAt(inverse, kSurface * step, 2, x, y);
          if (std::isnan(found)) continue;
          float spread = weight.at<float>(y / 2, x / 2);
          if (!(spread > 0)) spread = 0.5f * step;
          if (std::isnan(line[x])) {
            if (spots.taken(view, x, y, found, kSame * step)) continue;
            line[x] = found;
            to[x] = kSpread * spread;
            continue;
          }
          const float own = job.certainty(x, y), theirs = 1 / (spread * spread);
          const float apart = found - line[x];
          if (theirs < own || apart * apart > kAgree * (1 / own + 1 / theirs)) continue;
          line[x] += apart * theirs / (own + theirs);
          to[x] = kSpread / std::sqrt(own + theirs);
        }
      },
      8);
  removeSpeckles(h, kSurface * step, job.least_region, threads_);
  std::atomic<std::size_t> filled{0};
  parallelFor(0, static_cast<std::size_t>(height), threads_, [&](std::size_t row) {
    const float* line = h->ptr<float>(static_cast<int>(row));
    float* to = sigma->ptr<float>(static_cast<int>(row));
    std::size_t count = 0;
    for (int x = 0; x < width; ++x) {
      if (std::isnan(line[x])) to[x] = kNaN;
      count += !std::isnan(to[x]);
    }
    filled += count;
  });
  return filled;
}

}  // namespace omnister::sweep
