// SPDX-License-Identifier: Apache-2.0
/// @file Features of an ordinary textured scene followed along the curved paths that they draw in
/// the distorted images of a moving stage.
#pragma once

#include <Eigen/Core>
#include <opencv2/core/mat.hpp>
#include <vector>

#include "omnister/common/progress.h"

namespace omnister {

/// Images of one straight run of the stage, the rig standing still otherwise.
struct StageScan {
  std::vector<cv::Mat> images;      ///< CV_8U, one or three channels, all of one size
  std::vector<double> positions_m;  ///< stage position of each image [m], all different
};

/// One scene point as seen in all scans.
struct FeatureTrack {
  struct Observation {
    int scan = 0;
    int image = 0;          ///< within the scan
    Eigen::Vector2d pixel;  ///< [px]
  };
  std::vector<Observation> observations;  ///< at least two in every scan that it was seen in
};

/// Two tracks of different scans that look alike; most, not all, are the same scene point.
struct TrackMatch {
  int first = 0;
  int second = 0;
};

struct FeatureTracks {
  cv::Size image_size;
  std::vector<std::vector<double>> positions_m;  ///< [scan][image] [m]
  std::vector<FeatureTrack> tracks;              ///< each within one scan
  std::vector<TrackMatch> matches;
};

struct TrackingOptions {
  int features_per_scan = 1200;  ///< spread evenly over the image
  int threads = 0;               ///< 0: every core
};

/// Follows corners of the middle image of every scan to all its others (pyramidal Lucas-Kanade,
/// always against the middle image so that nothing drifts, checked backwards), and proposes matches
/// between scans by SIFT descriptors.
/// @throws Error for scans of fewer than two images, of different sizes, or with repeated positions
FeatureTracks trackFeatures(const std::vector<StageScan>& scans,
                            const TrackingOptions& options = {}, const Progress& progress = {});

}  // namespace omnister
