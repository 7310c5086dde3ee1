// SPDX-License-Identifier: Apache-2.0
/// @file From images to a cloud, the same for live topics and recordings. Knows no ROS.
#pragma once

#include <list>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "omnister/lens/lens_file.h"
#include "omnister/stereo/cloud.h"
#include "omnister/stereo/matcher.h"
#include "omnister/stereo/stream_matcher.h"
#include "stereo/session/frame_pairing.h"
#include "stereo/session/stereo_frame.h"

namespace omnister {

/// What makes one cloud: a reference image and displaced ones, one or more.
struct StereoSet {
  StereoFramePtr reference;
  std::vector<StereoFramePtr> displaced;
  std::vector<Pose> T_ref_disp;           ///< of each displaced image
  std::optional<Pose> T_fixed_reference;  ///< where the reference was taken, if that is known
};

/// @param set frames whose images are each a StereoFrame
StereoSet toStereoSet(const FrameSet& set);

struct WorkerSettings {
  std::string matcher = "sweep";
  MatcherOptions matching;  ///< with the mask of the full image; the prior is the worker's
  std::string region;       ///< of the full image, see parseRegion(); empty: all
  int reduce = 1;           ///< images and cloud are made so many times smaller
  /// What the set before found, taken to where the camera is now, stands where the images find
  /// nothing but confirm it. Needs poses of the references.
  bool use_prior = false;
  /// One camera that moves: frames join the estimate of one reference until the camera is farther
  /// from it than max_baseline or turned by more than max_rotation.
  bool stream = false;
  double min_baseline = 0.01;  ///< of a stream's frames [m]
  double max_baseline = 1.0;   ///< [m]
  double max_rotation = 0.5;   ///< [rad]
};

/// A set as matchers take it.
struct PreparedSet {
  StereoGeometry geometry;  ///< of the reduced images
  int bits = 8;             ///< significant bits of all images, see StereoFrame
  cv::Mat reference;        ///< CV_8UC1
  std::vector<cv::Mat> displaced;
};

/// Ranges, and the image on whose pixels they lie: a stream's reference is not the set's.
struct MatchedSet {
  MatchResult result;
  StereoFramePtr image;
  cv::Mat grey;                              ///< CV_8UC1, of it, reduced
  int bits = 8;                              ///< of it
  LensPtr lens;                              ///< of the reduced image
  StereoFramePtr displaced;                  ///< one that was matched against it,
  StereoGeometry::Displaced displaced_from;  ///< and its camera
  int positions = 0;                         ///< displaced images that had their say
};

/// Matches sets, and keeps what was set up for geometries that come again. For one thread.
class StereoWorker {
 public:
  explicit StereoWorker(WorkerSettings settings);

  /// Other settings from now on; matchers that were kept, streams and priors are dropped.
  void configure(WorkerSettings settings);

  /// @param reference, displaced lenses of the cameras that the images are from
  /// @param reference_name, displaced_name of the two image streams, for messages
  /// @throws InputError for images that are not those of the lenses, or no pictures
  PreparedSet prepare(const StereoSet& set, const LensFile& reference, const LensFile& displaced,
                      const std::string& reference_name, const std::string& displaced_name);

  /// The matcher of a geometry, made when it is new. It stays until matchers of others have pushed
  /// it out. @throws Error for what cannot be matched, a mask of another size
  Matcher& matcherFor(const StereoGeometry& geometry);

  /// @return nothing for a frame that stands where a stream's reference does
  /// @throws Error as matcherFor()
  std::optional<MatchedSet> match(const StereoSet& set, const PreparedSet& prepared);

  /// The unit viewing ray of every pixel of what was matched; kept from frame to frame.
  const cv::Mat& rays(const MatchedSet& matched);
  /// The picture of what was matched, in the cloud's size. @param color CV_8UC3 where the image has
  /// colours, else its grey levels
  cv::Mat picture(const MatchedSet& matched, bool color) const;

 private:
  struct CachedMatcher {
    StereoGeometry geometry;
    std::unique_ptr<Matcher> matcher;
  };
  struct Stream {
    StreamMatcher matcher;
    MatchedSet reference;  ///< without a result
    Pose T_fixed_reference = Pose::Identity();
    explicit Stream(const MatcherOptions& options) : matcher(options) {}
  };
  struct Before {
    cv::Mat range;
    LensPtr lens;
    Pose T_fixed_reference = Pose::Identity();
  };

  LensPtr reducedOnce(const LensPtr& lens);
  MatcherOptions optionsFor(cv::Size reduced_size);
  std::optional<MatchedSet> join(const StereoSet& set, const PreparedSet& prepared);

  WorkerSettings settings_;
  cv::Size full_size_;                  ///< of the last reference image
  std::list<CachedMatcher> matchers_;   ///< most recently used first
  std::map<LensPtr, LensPtr> reduced_;  ///< by the full image's lens
  std::unique_ptr<Stream> stream_;
  std::optional<Before> before_;
  LensPtr rays_lens_;  ///< of rays_
  cv::Mat rays_;       ///< CV_32FC3, unit viewing rays
};

}  // namespace omnister
