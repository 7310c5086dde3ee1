// SPDX-License-Identifier: Apache-2.0
/// @file Where the texture is too weak for the finest images, what coarser ones say.
///
/// A window of a reduced image covers more, and its pixels are means of many: walls without texture
/// and the plain squares of a board match there when they no longer do in full resolution.
#pragma once

#include <cstddef>
#include <functional>
#include <memory>
#include <opencv2/core/mat.hpp>
#include <vector>

#include "stereo/sweep/grid/geometry.h"
#include "stereo/sweep/refine/joint_refinement.h"

namespace omnister::sweep {

struct CoarseLevel {
  const cv::Mat* h = nullptr;  ///< CV_32FC1, hypotheses as they were matched
  float step = 0;              ///< finest hypothesis step of the level
};

/// One filler for a pair; its tables are made when they are first needed.
class WeakFill {
 public:
  /// @param geometry of one displaced camera
  WeakFill(const StereoGeometry& geometry, int threads);
  ~WeakFill();

  struct Job {
    cv::Mat reference, displaced;        ///< CV_8UC1
    const ReferenceMap* map = nullptr;   ///< of the full image, kAngle
    const ReferenceMap* half = nullptr;  ///< of the next level
    /// CV_32FC1, 1 / variance of the hypotheses matched in full resolution, in steps
    std::function<float(int x, int y)> certainty;
    float step = 0;                   ///< finest hypothesis step of the full image
    float baseline = 0;               ///< [m]
    std::vector<CoarseLevel> coarse;  ///< reduced 2, 4, ... times
    int least_region = 0;             ///< pixels of the smallest region that stays
  };

  /// Fills pixels of `h` that are NaN, have a ray and lie in a coherent region of a coarser level
  /// whose grey values confirm it, unless a pixel that was matched in full resolution sees the same
  /// spot of the displaced image at another range. Where what the half images say is more certain
  /// than a match in full resolution that agrees with it, the two are averaged. Does nothing where
  /// hardly any of the pixels that failed lack texture: what fails there is hidden.
  /// @param sigma [out] CV_32FC1, standard deviation of the hypotheses that were set, NaN
  /// elsewhere; empty if nothing was done
  /// @return pixels filled
  std::size_t fill(const Job& job, cv::Mat* h, cv::Mat* sigma);

 private:
  StereoGeometry geometry_;
  int threads_;
  std::unique_ptr<JointRefinement> refinement_;
};

}  // namespace omnister::sweep
