// SPDX-License-Identifier: Apache-2.0
#include "stereo/sweep/multi_position.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <numeric>

#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "omnister/stereo/matching_limits.h"
#include "stereo/sweep/pair/pair.h"
#include "stereo/sweep/refine/joint_refinement.h"

namespace omnister {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr float kAgree = 4.0f;  ///< standard deviations that two estimates of one point may differ

constexpr float kPriorSpread = 0.05f;  ///< of a prior range, relative
constexpr float kPriorScore = 0.1f;

}  // namespace

RangeFusion::RangeFusion(cv::Size size, int threads) : threads_(threads) {
  for (cv::Mat* plane : {&inverse, &weight, &score, &rival_, &rival_weight_})
    plane->create(size, CV_32FC1);
  support.create(size, CV_8UC1);
  rival_support_.create(size, CV_8UC1);
  clear();
}

void RangeFusion::clear() {
  count_ = 0;
  inverse.setTo(kNaN);
  rival_.setTo(kNaN);
  for (cv::Mat* plane : {&weight, &score, &rival_weight_, &support, &rival_support_})
    plane->setTo(0);
}

void RangeFusion::add(const MatchResult& pair) {
  ++count_;
  parallelFor(
      0, static_cast<std::size_t>(inverse.rows), threads_,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        const float* range = pair.range.ptr<float>(y);
        const float* sigma = pair.sigma.ptr<float>(y);
        const float* worth = pair.score.ptr<float>(y);
        float* w = inverse.ptr<float>(y);
        float* ww = weight.ptr<float>(y);
        float* best = score.ptr<float>(y);
        std::uint8_t* n = support.ptr(y);
        float* r = rival_.ptr<float>(y);
        float* rw = rival_weight_.ptr<float>(y);
        std::uint8_t* rn = rival_support_.ptr(y);
        for (int x = 0; x < inverse.cols; ++x) {
          if (std::isnan(range[x])) continue;
          const float value = 1 / range[x];
          const float spread = range[x] * range[x] / sigma[x];
          const float own = spread * spread;
          best[x] = std::max(best[x], worth[x]);
          const auto join = [&](float* to, float* to_weight, std::uint8_t* to_support) {
            const float apart = value - *to;
            if (*to_support > 0 && !(apart * apart <= kAgree * kAgree * (1 / own + 1 / *to_weight)))
              return false;
            // Positions share the reference, and with it most of what they are wrong by [px]: the
            // longer baseline counts by more than its weight.
            const float both = own * own + *to_weight * *to_weight;
            *to = *to_support > 0 ? *to + apart * own * own / both : value;
            *to_weight = std::sqrt(both);
            if (*to_support < 255) ++*to_support;
            return true;
          };
          if (join(&w[x], &ww[x], &n[x])) continue;
          if (!join(&r[x], &rw[x], &rn[x])) {
            if (rn[x] > 1 || own <= rw[x]) continue;
            r[x] = value;
            rw[x] = own;
            rn[x] = 1;
          }
          if (rn[x] < n[x] || (rn[x] == n[x] && rw[x] <= ww[x])) continue;
          std::swap(w[x], r[x]);
          std::swap(ww[x], rw[x]);
          std::swap(n[x], rn[x]);
        }
      },
      8);
}

void RangeFusion::addPrior(const cv::Mat& range) {
  parallelFor(
      0, static_cast<std::size_t>(inverse.rows), threads_,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        for (int x = 0; x < inverse.cols; ++x) {
          const float known = range.at<float>(y, x);
          if (!(known > 0) || std::isinf(known)) continue;
          std::uint8_t& n = support.at<std::uint8_t>(y, x);
          float& w = inverse.at<float>(y, x);
          if (n == 0) {
            w = 1 / known;
            weight.at<float>(y, x) = known * known / (kPriorSpread * kPriorSpread);
            score.at<float>(y, x) = kPriorScore;
            n = 1;
          } else if (std::fabs(w * known - 1) < kPriorSpread && n < 255) {
            ++n;
          }
        }
      },
      8);
}

void concludeRange(const cv::Mat& inverse, const cv::Mat& weight, const cv::Mat& score,
                   const MatcherOptions& options, MatchResult* out) {
  const cv::Size size = inverse.size();
  // Planes of their own: what the result holds may belong to a matcher.
  for (cv::Mat* plane : {&out->range, &out->sigma, &out->score}) *plane = cv::Mat(size, CV_32FC1);
  std::vector<std::size_t> valid(size.height, 0);
  parallelFor(
      0, static_cast<std::size_t>(size.height), options.threads,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        const float* w = inverse.ptr<float>(y);
        const float* certain = weight.ptr<float>(y);
        const float* best = score.ptr<float>(y);
        float* range = out->range.ptr<float>(y);
        float* sigma = out->sigma.ptr<float>(y);
        float* worth = out->score.ptr<float>(y);
        for (int x = 0; x < size.width; ++x) {
          range[x] = sigma[x] = worth[x] = kNaN;
          // Where the parallax drowns in its own error there is no range.
          if (!(w[x] > 0) || !(w[x] * w[x] * certain[x] > 4)) continue;
          const float r = 1 / w[x];
          if (r < options.min_range || (options.max_range > 0 && r > options.max_range)) continue;
          range[x] = r;
          sigma[x] = r * r / std::sqrt(certain[x]);
          worth[x] = best[x];
          ++valid[row];
        }
      },
      8);
  out->statistics.valid = std::accumulate(valid.begin(), valid.end(), std::size_t{0});
}

namespace {

class MultiPositionMatcher : public Matcher {
 public:
  MultiPositionMatcher(const StereoGeometry& geometry, const MatcherOptions& options)
      : geometry_(geometry),
        options_(options),
        fusion_(geometry.reference_size, options.threads),
        refinement_(geometry, options.threads) {
    options_.prior = options.prior.clone();
    // From the shortest baseline on: what is near and hidden from far positions is known first.
    order_.resize(geometry.displaced.size());
    std::iota(order_.begin(), order_.end(), std::size_t{0});
    std::stable_sort(order_.begin(), order_.end(),
                     [&](std::size_t a, std::size_t b) { return baseline(a) < baseline(b); });
    const MatchingLimits limits = checkMatching(geometry, options);
    MatcherOptions common = options;
    common.min_range = limits.min_range;
    for (const std::size_t i : order_) {
      StereoGeometry pair = geometry;
      pair.displaced = {geometry.displaced[i]};
      pairs_.push_back(makeSweepPair(
          pair, common,
          geometry.displaced.size() > 1 ? PairChecks::kStrict : PairChecks::kByTexture));
      if (pairs_.size() > 1) pairs_.back()->takeBuffers(pairs_[pairs_.size() - 2].get());
    }
  }

  bool setPrior(const cv::Mat& prior) override {
    checkPrior(geometry_, prior);
    options_.prior = prior.clone();
    return true;
  }

  MatchResult match(const cv::Mat& reference, const std::vector<cv::Mat>& displaced) override {
    checkImages(geometry_, reference, displaced);
    const auto start = std::chrono::steady_clock::now();
    MatchResult out;
    auto& statistics = out.statistics;
    fusion_.clear();
    for (std::size_t i = 0; i < pairs_.size(); ++i) {
      if (pairs_.size() > 1)
        pairs_[i]->takeBuffers(pairs_[(i + pairs_.size() - 1) % pairs_.size()].get());
      const MatchResult pair = pairs_[i]->match(reference, {displaced[order_[i]]});
      for (const auto& [name, seconds] : pair.statistics.seconds)
        if (name != "total") statistics.seconds[name] += seconds;
      for (const auto& [name, count] : pair.statistics.rejected) statistics.rejected[name] += count;
      fusion_.add(pair);
    }
    if (!options_.prior.empty()) fusion_.addPrior(options_.prior);
    const auto fused = std::chrono::steady_clock::now();
    statistics.rejected["not confirmed"] = refinement_.refine(reference, displaced, fusion_.support,
                                                              &fusion_.inverse, &fusion_.weight);
    concludeRange(fusion_.inverse, fusion_.weight, fusion_.score, options_, &out);
    const auto end = std::chrono::steady_clock::now();
    statistics.seconds["refine"] = std::chrono::duration<double>(end - fused).count();
    statistics.seconds["total"] = std::chrono::duration<double>(end - start).count();
    return out;
  }

 private:
  double baseline(std::size_t i) const {
    return geometry_.displaced[i].T_ref_disp.translation().norm();
  }

  StereoGeometry geometry_;
  MatcherOptions options_;
  RangeFusion fusion_;
  JointRefinement refinement_;
  std::vector<std::size_t> order_;                 ///< of displaced images, by baseline
  std::vector<std::unique_ptr<SweepPair>> pairs_;  ///< in that order
};

}  // namespace

std::unique_ptr<Matcher> makeMultiPositionMatcher(const StereoGeometry& geometry,
                                                  const MatcherOptions& options) {
  return std::make_unique<MultiPositionMatcher>(geometry, options);
}

}  // namespace omnister
