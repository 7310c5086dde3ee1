// SPDX-License-Identifier: Apache-2.0
/// @file Depth of the random-pattern board by a lens: table 5.1, figs 3.5, 5.3 and 5.5 to 5.8.
#pragma once

#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

#include "omnister/common/pose.h"
#include "omnister/stereo/thesis_matcher.h"
#include "tools/thesis/thesis_setting.h"

namespace omnister::tools::thesis {

struct StereoPair {
  cv::Mat reference, displaced;
  cv::Mat mask;
  Pose T_ref_disp = Pose::Identity();
  int asked = 0;
  int corners_asked = 0;
};

/// Table 5.1 for one lens: distances of the measured points from a plane fitted to them.
struct DepthStatistics {
  double mean_mm = 0.0, max_mm = 0.0, mean_percent = 0.0, max_percent = 0.0;
  double rms_mm = 0.0;
  double distance_m = 0.0;  ///< of the fitted plane
  double matched = 0.0;     ///< share of the pixels asked for whose match is right to 5 % in depth
                            ///< of the plane
  double corners_matched = 0.0;  ///< the same beyond 45 degrees off the axis
  double seconds = 0.0;
  struct Point {
    Vector2d pixel;
    Vector3d X;
    double residual = 0.0;  ///< along the axis [m]
  };
  std::vector<Point> points;  ///< right matches
};

/// Images of the random-pattern board, and a grid of pixels to measure.
StereoPair renderPair(const Shape& shape, double distance, double baseline, int step, double limit,
                      int threads);

/// @param model whose rays carry the ranges that `lens` was matched with
DepthStatistics depthStatistics(const Shape& shape, const LensModel& model, LensPtr lens,
                                const StereoPair& pair, double distance, ThesisMask mask,
                                int threads);

/// Error of depth over the image: red is too far, blue too near, full colour 10 %.
std::string depthMap(const DepthStatistics& s, cv::Size size, double step);

/// The plane seen from below: depth over x.
std::string depthProfile(const DepthStatistics& s);

/// Error of depth along the x axis (fig. 5.8).
std::string axisErrorPlot(const DepthStatistics& s, double center_v, double step);

/// The outline of a mask of the reference image as the displaced one sees it (figs 5.3 and 5.5).
std::string windowPlot(const Shape& shape, double distance, double baseline);

}  // namespace omnister::tools::thesis
