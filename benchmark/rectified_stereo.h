// SPDX-License-Identifier: Apache-2.0
/// @file OpenCV's matchers on the whole field: latitude-longitude rectification of 178 x 178
/// degrees about the baseline, in which every epipolar curve is a row. What the sweep is compared
/// with.
#pragma once

#include <opencv2/calib3d.hpp>
#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

#include "omnister/stereo/matcher.h"

namespace omnister::bench {

class RectifiedStereo {
 public:
  /// @param method "bm", "sgbm" or "3way"  @param focal_px resolution of the rectified images
  /// [px/rad]
  RectifiedStereo(const std::string& method, const StereoGeometry& geometry, double focal_px,
                  int threads);

  struct Times {
    double rectify = 0.0, match = 0.0, transfer = 0.0;  ///< [s]
  };
  /// @return range along the ray on the reference's own pixel grid, NaN where invalid
  cv::Mat match(const cv::Mat& reference, const cv::Mat& displaced, Times* times);

  cv::Size rectifiedSize() const { return size_; }
  int disparities() const { return disparities_; }

 private:
  cv::Ptr<cv::StereoMatcher> matcher_;
  double focal_;
  double baseline_;
  int threads_;
  int disparities_;
  cv::Size size_;
  cv::Mat map_reference_[2], map_displaced_[2];
  cv::Mat
      place_;  ///< CV_32FC2: where each reference pixel lies in the rectified image; x < 0: nowhere
  std::vector<float> tangents_;         ///< by sixteenths of disparity
  std::vector<float> sines_, cosines_;  ///< of the angle from the baseline, by column
};

}  // namespace omnister::bench
