// SPDX-License-Identifier: Apache-2.0
/// @file From image messages to a cloud, the same for live topics and recordings. Talks to no
/// master.
#pragma once

#include <sensor_msgs/Image.h>

#include <list>
#include <memory>
#include <string>
#include <vector>

#include "omnister/lens/lens_file.h"
#include "omnister/ros/frame_pairing.h"
#include "omnister/stereo/cloud.h"
#include "omnister/stereo/matcher.h"

namespace omnister {

/// What makes one cloud: a reference image and displaced ones, one or more.
struct StereoSet {
  sensor_msgs::ImageConstPtr reference;
  std::vector<sensor_msgs::ImageConstPtr> displaced;
  std::vector<Pose> T_ref_disp;  ///< of each displaced image
};

/// @param set frames whose images are messages
StereoSet toStereoSet(const FrameSet& set);

/// A set as matchers take it.
struct PreparedSet {
  StereoGeometry geometry;
  int bits = 8;       ///< significant bits of all images, see significantBits()
  cv::Mat reference;  ///< CV_8UC1
  std::vector<cv::Mat> displaced;
};

/// Matches sets, and keeps what was set up for geometries that come again. For one thread.
class StereoWorker {
 public:
  StereoWorker(std::string matcher, MatcherOptions options);

  /// Other settings from now on; matchers that were kept are dropped.
  void configure(std::string matcher, MatcherOptions options);

  /// @param reference, displaced lenses of the cameras that the images are from
  /// @param reference_name, displaced_name of the two image streams, for messages
  /// @throws InputError for images that are not those of the lenses, or no pictures
  static PreparedSet prepare(const StereoSet& set, const LensFile& reference,
                             const LensFile& displaced, const std::string& reference_name,
                             const std::string& displaced_name);

  /// The matcher of a geometry, made when it is new. It stays until matchers of others have pushed
  /// it out. @throws Error for what cannot be matched, a mask of another size
  Matcher& matcherFor(const StereoGeometry& geometry);

  /// Points of a match.
  /// @param color the image's colours; else its grey levels, which is quicker
  Cloud points(const StereoSet& set, const PreparedSet& prepared, const MatchResult& result,
               const LensFile& reference, bool color);

 private:
  struct CachedMatcher {
    StereoGeometry geometry;
    std::unique_ptr<Matcher> matcher;
  };

  std::string matcher_;
  MatcherOptions options_;
  std::list<CachedMatcher> matchers_;  ///< most recently used first
  LensPtr rays_lens_;                  ///< of rays_
  cv::Mat rays_;                       ///< CV_32FC3, unit viewing rays
};

}  // namespace omnister
