// SPDX-License-Identifier: Apache-2.0
/// @file One range out of several positions.
#pragma once

#include <memory>
#include <opencv2/core/mat.hpp>

#include "omnister/stereo/matcher.h"

namespace omnister {

/// A running estimate of inverse range, image by image. Estimates that agree are averaged by their
/// weight; where they do not, two stand side by side until more positions speak for one of them, so
/// that a point hidden from one position does not lose to a mismatch there.
class RangeFusion {
 public:
  /// @param size of the reference image  @param threads 0: every core
  RangeFusion(cv::Size size, int threads);

  void clear();
  /// @param pair range, sigma and score of one position
  void add(const MatchResult& pair);
  /// What was known before, where nothing was found; where it agrees it supports what was found.
  /// @param range CV_32FC1 [m], NaN where unknown
  void addPrior(const cv::Mat& range);
  int count() const { return count_; }  ///< positions since clear()

  cv::Mat inverse;  ///< CV_32FC1, 1 / range [1/m]; NaN where unknown
  cv::Mat weight;   ///< CV_32FC1, one over the variance of it [m^2]
  cv::Mat score;    ///< CV_32FC1, the best of the positions
  cv::Mat support;  ///< CV_8UC1, how many positions agree

 private:
  int threads_;
  int count_ = 0;
  cv::Mat rival_, rival_weight_, rival_support_;
};

/// Range, sigma and score of an estimate, within the limits of `options`.
void concludeRange(const cv::Mat& inverse, const cv::Mat& weight, const cv::Mat& score,
                   const MatcherOptions& options, MatchResult* out);

/// @throws Error as makeMatcher()
std::unique_ptr<Matcher> makeMultiPositionMatcher(const StereoGeometry& geometry,
                                                  const MatcherOptions& options);

}  // namespace omnister
