// SPDX-License-Identifier: Apache-2.0
/// @file Dewarping as the thesis does it, and its errors and costs: table 4.1,
/// figs 3.2, 4.2, 4.12, 4.15, 5.1 and 5.4.
#pragma once

#include <opencv2/core/mat.hpp>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "tools/thesis/thesis_setting.h"

namespace omnister::tools::thesis {

/// Table 4.1 for one lens.
struct DewarpStatistics {
  double mean_px = 0.0, max_px = 0.0, min_px = 1e9, mean_percent = 0.0;
  double ray_rms_deg = 0.0, ray_max_deg = 0.0;
  double R0 = 0.0, R0_error = 0.0;
  int points = 0, lost = 0;
  std::vector<std::pair<Vector2d, Vector2d>> pairs;  ///< true and dewarped (u, v) [px]
};

/// Forward mapping: every pixel of the image goes to its place in the dewarped plane (figs 4.2 and
/// 4.12).
struct Forward {
  cv::Mat picture;
  double gaps = 0.0;      ///< share of the dewarped pixels that get nothing, within the field
  double gaps_rim = 0.0;  ///< beyond 45 degrees
};

/// How many dewarped pixels lie in each distorted one (fig. 5.1), and how large the dewarped
/// picture is.
struct ManyToOne {
  cv::Mat picture;
  int most = 0;
  std::vector<std::pair<double, double>> by_radius;  ///< radius as a share of the half diagonal
  double dewarped_pixels = 0.0;                      ///< of the rectangle around the picture
  int width = 0, height = 0;
};

/// Where a pixel lies in the dewarped plane [px of the image's middle].
std::optional<Vector2d> dewarp(const LensModel& lens, double R0, const Vector2d& pixel);

DewarpStatistics dewarpStatistics(const Shape& shape, const LensModel& lens,
                                  const ViewDetections& board);

/// Dewarped points in red over the true places in black (figs 3.2 and 4.15).
std::string dewarpPlot(const DewarpStatistics& s);

/// The image at this width, where it is larger.
cv::Mat shrunk(const cv::Mat& image, int width);

Forward forwardMap(const LensModel& lens, const cv::Mat& image, double limit);

ManyToOne manyToOne(const LensModel& lens, cv::Size size);

/// A dot board square to the axis (fig. 4.8).
cv::Mat boardPicture(const Shape& shape, int threads);

/// Distinct reference pixels in a mask that is a square of the dewarped plane (fig. 5.4), as a
/// share of the mask, around a pixel so far off the axis.
double distinctShare(const LensModel& lens, const Vector2d& pixel, int window);

}  // namespace omnister::tools::thesis
