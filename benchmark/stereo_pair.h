// SPDX-License-Identifier: Apache-2.0
/// @file Rendered pairs with their truth, and what a matcher's range is worth against it.
#pragma once

#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

#include "omnister/lens/lens_model.h"
#include "omnister/sim/renderer.h"
#include "omnister/sim/scene.h"
#include "omnister/stereo/matcher.h"

namespace omnister::bench {

/// Largest parallax of the comparison, by which all baselines are chosen [rad].
extern const double kMaxParallax;

/// One reference image and one or more displaced ones, all CV_8UC1, with exact truth.
struct StereoCase {
  std::string name;
  StereoGeometry geometry;
  double focal_px = 0.0;  ///< pixels per radian on the axis
  cv::Mat reference;
  std::vector<cv::Mat> displaced;
  cv::Mat range;  ///< CV_32FC1, truth along the ray; NaN where nothing is
  /// CV_8UC1: kTruth, kOccluded (hidden from the first displaced camera), kOutside (not in its
  /// image, or nothing there).
  cv::Mat kind;
  cv::Mat theta;  ///< CV_32FC1, off-axis angle [rad]
};
enum PixelKind : unsigned char { kOutside = 0, kTruth = 1, kOccluded = 2 };

struct CaseOptions {
  double noise_sigma = 1.0;  ///< [grey levels]
  double baseline = 0.0;     ///< [m]; 0: a quarter of the nearest range
  int positions = 1;         ///< displaced images, at 1, 2, … baselines
  Eigen::Vector3d direction = Eigen::Vector3d::UnitX();  ///< of travel, in the reference frame
  Pose T_world_reference = Pose::Identity();
};

/// Renders reference and displaced images and finds, ray by ray in double precision, what the first
/// displaced camera sees of each reference pixel.
StereoCase makeCase(const std::string& name, const sim::Scene& scene, const LensPtr& lens,
                    cv::Size size, const CaseOptions& options = {});

/// A 180-degree equidistant lens whose circle spans the image's width.
LensPtr equidistant180(cv::Size size);

/// What a range image is worth. Shares are 0 to 1; NaN where there is nothing to measure.
struct Score {
  std::size_t truth = 0;         ///< pixels with truth: seen by both cameras
  double density = 0.0;          ///< share of them that have a range
  double median_percent = 0.0;   ///< median |range error| of those [%]
  double over_1px = 0.0;         ///< share of those whose point, seen by the displaced camera, lies
                                 ///< more than a pixel from the true one
  double over_2percent = 0.0;    ///< share of those whose range is off by more than 2 %
  double occluded_filled = 0.0;  ///< share of occluded pixels that have a range all the same
  struct Band {
    double from_deg = 0.0, to_deg = 0.0;
    std::size_t truth = 0;
    double density = 0.0, median_percent = 0.0, over_1px = 0.0;
  };
  std::vector<Band> bands;  ///< of off-axis angle
};

/// @param range CV_32FC1 of the reference size  @param subset CV_8UC1, pixels to judge; empty: all
Score score(const StereoCase& pair, const cv::Mat& range, const cv::Mat& subset = cv::Mat());

/// Mean signed parallax error by the phase of the true parallax in pixels, over `bins` equal bins
/// [px].
std::vector<double> biasByPhase(const StereoCase& pair, const cv::Mat& range, int bins);

}  // namespace omnister::bench
