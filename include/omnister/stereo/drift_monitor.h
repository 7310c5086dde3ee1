// SPDX-License-Identifier: Apache-2.0
/// @file Are lens and pose still true while the rig runs? Features of matched images, followed off
/// their epipolar curves, over time.
///
/// A match lies on the epipolar curve by construction; where the feature really is, an ordinary
/// tracker finds in both directions of the image from there on. What is left across the curve is
/// the epipolar residual. Single residuals are noise of the tracker; what stays in a part of the
/// image, feature after feature, is drift of lens or pose. Not everything shows: a scale of the
/// surface's height along with a move square to the axis, and a turn about the baseline, leave all
/// points on their curves.
#pragma once

#include <deque>
#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

#include "omnister/stereo/matcher.h"

namespace omnister {

struct DriftOptions {
  int features = 300;    ///< followed in one pair of images at most
  double window = 60.0;  ///< pairs of so many seconds are looked at together [s]
  int columns = 6;       ///< parts of the image
  int rows = 4;
  int least_in_part = 8;  ///< features, over the window, that a part needs to count
  int least_parts = 6;    ///< parts that have to count for a verdict
  double warn_px = 0.5;   ///< drift that is told
  double error_px = 1.5;  ///< drift that makes clouds worthless
};

struct DriftVerdict {
  enum class State { kUnknown, kGood, kWarning, kError };
  State state = State::kUnknown;
  /// RMS over the parts of the image of their mean residual, less what its noise adds [px].
  double drift_px = 0.0;
  /// Drift that there is with 97.5 % confidence at least [px]; this one is held against the limits.
  double at_least_px = 0.0;
  double noise_px = 0.0;  ///< scatter of single features about their part's mean [px]
  int pairs = 0;          ///< of images in the window
  int features = 0;       ///< in those parts
  int parts = 0;          ///< of the image that count
};

class DriftMonitor {
 public:
  /// @throws Error for options out of range
  explicit DriftMonitor(const DriftOptions& options = {});

  /// One matched pair. A geometry with other lenses begins anew; so does a time before the last.
  /// @param time of the reference image [s]
  /// @param reference, displaced CV_8UC1 of the geometry's first pair
  /// @param range of the match, CV_32FC1 [m]
  /// @return how many features were followed
  int add(double time, const StereoGeometry& geometry, const cv::Mat& reference,
          const cv::Mat& displaced, const cv::Mat& range);

  DriftVerdict verdict() const;
  void reset() { pairs_.clear(); }

 private:
  struct Residual {
    int part = 0;
    float px = 0.0f;
  };
  struct Pair {
    double time = 0.0;
    std::vector<Residual> residuals;
  };

  DriftOptions options_;
  LensPtr reference_lens_, displaced_lens_;
  std::deque<Pair> pairs_;
};

}  // namespace omnister
