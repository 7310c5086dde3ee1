// SPDX-License-Identifier: Apache-2.0
/// @file What every matcher checks before it allocates anything.
#pragma once

#include <string>
#include <string_view>
#include <vector>

#include "omnister/stereo/matcher.h"

namespace omnister {

/// The search limits with their defaults filled in.
struct MatchingLimits {
  double min_range = 0.0;         ///< along the ray, > 0 [m]
  double max_range = 0.0;         ///< along the ray, > min_range; may be infinity [m]
  int hypotheses = 0;             ///< most candidates a pixel, 2 to kMaxHypotheses
  double longest_baseline = 0.0;  ///< over the displaced cameras, > 0 [m]
  double longest_path_px = 0.0;   ///< the longest epipolar path between the limits [px]

  double minInverseRange() const { return 1.0 / max_range; }  ///< [1/m], 0 for infinity
  double maxInverseRange() const { return 1.0 / min_range; }  ///< [1/m]
};

constexpr int kMaxHypotheses = 16384;
constexpr int kMaxImageSide = 32766;  ///< OpenCV's remap counts in 16 bits [px]
constexpr int kMaxThreads = 1024;

/// Checks geometry and options: lenses, sizes, finite and rigid poses, a baseline, limits the right
/// way round, hypotheses, mask; and that some epipolar path between the limits lies in a displaced
/// field and is longer than a tenth of a pixel.
/// @throws Error with one line that says what is wrong
MatchingLimits checkMatching(const StereoGeometry& geometry, const MatcherOptions& options);

/// @throws Error unless a prior range is empty or an image of floats of the reference size
void checkPrior(const StereoGeometry& geometry, const cv::Mat& prior);

/// To be called before a large allocation.
/// @param what e.g. "the cost volume"
/// @throws Error when it is more than half of the machine's memory
void checkMemory(double bytes, std::string_view what);

/// @throws Error unless the images have the sizes of the geometry, are CV_8UC1 and as many
void checkImages(const StereoGeometry& geometry, const cv::Mat& reference,
                 const std::vector<cv::Mat>& displaced);

/// What is wrong with images that were taken all the same, one line each: black, saturated, without
/// contrast, or of a very different exposure than the reference.
std::vector<std::string> imageRemarks(const cv::Mat& reference,
                                      const std::vector<cv::Mat>& displaced);

}  // namespace omnister
