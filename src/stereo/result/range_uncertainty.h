// SPDX-License-Identifier: Apache-2.0
/// @file What calibration leaves unknown of a range.
///
/// A matcher's sigma is that of the match. Lenses and poses are known to their covariances only,
/// and what they are wrong by moves both rays of a point. With e the unit baseline, b its length,
/// theta and theta' the angles from it of the two rays, delta = theta' - theta,
///     range = b sin(theta') / sin(delta)                                   (law of sines)
///     d(range) = b / sin(delta)^2 (sin(theta') cos(delta) d(theta) - sin(theta) d(theta'))
///                + range / b d(b)
/// and theta, theta' and b move with the parameters of the lenses and with the pose. One camera
/// that moves has one lens: what it is wrong by moves both rays, and much of it cancels. Two
/// cameras have two, whose covariances are independent but for a rotation of each camera, which was
/// answered by the pose that was calibrated with them and is left out.
#pragma once

#include <memory>
#include <opencv2/core/mat.hpp>
#include <vector>

#include "omnister/stereo/matcher.h"

namespace omnister {

/// Whether anything of a geometry has a covariance.
bool hasCovariance(const StereoGeometry& geometry);

class RangeUncertainty {
 public:
  /// With several displaced cameras each has its say by how far its image of a point moves with
  /// the range. @param min_range the least that will be asked for, > 0 [m]
  RangeUncertainty(const StereoGeometry& geometry, double min_range, int threads);

  /// Standard deviation of range by calibration alone [m]. @param range > 0 [m]
  double sigma(double u, double v, double range) const;

  /// Adds it, squared, to the sigma of every pixel that has a range.
  void addTo(MatchResult* match) const;

 private:
  static constexpr int kStep = 32;   ///< pixels between nodes
  static constexpr int kLevels = 6;  ///< of inverse range, evenly spaced
  cv::Size size_, nodes_;
  double most_ = 0.0;  ///< inverse range of the last level [1/m]
  int threads_;
  /// Standard deviation of inverse range [1/m], nodes_.height rows of nodes_.width by kLevels.
  std::vector<float> table_;
};

/// A matcher whose sigma tells what calibration leaves unknown as well; the matcher itself where
/// nothing of the geometry has a covariance. @throws Error for a covariance of another size
std::unique_ptr<Matcher> withCalibrationSigma(std::unique_ptr<Matcher> matcher,
                                              const StereoGeometry& geometry,
                                              const MatcherOptions& options);

}  // namespace omnister
