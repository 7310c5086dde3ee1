// SPDX-License-Identifier: Apache-2.0
/// @file Range that gets better while the stage slides.
#pragma once

#include <memory>
#include <opencv2/core/mat.hpp>
#include <string>

#include "omnister/stereo/matcher.h"

namespace omnister {

/// Holds one reference image, to which each new frame of the moving camera adds what it sees. The
/// reference stays: its pixels are the cloud's, so that what was known is never resampled, and the
/// baseline grows with the travel. Begin again with setReference() when the view has changed too
/// much. Memory does not grow with the number of frames: all are matched in the same buffers, and
/// of their images those are kept (`frames_kept`) that spread best over the travel.
class StreamMatcher {
 public:
  /// @param options as for makeMatcher(); with min_range 0 each frame looks no nearer than four of
  /// its own baselines, and what is nearer stays as earlier frames saw it
  /// @param frames_kept images for the joint refinement, 1 to 64
  /// @throws Error for a frames_kept out of range
  explicit StreamMatcher(const MatcherOptions& options, int frames_kept = 6);
  ~StreamMatcher();
  StreamMatcher(const StreamMatcher&) = delete;
  StreamMatcher& operator=(const StreamMatcher&) = delete;

  /// Forgets all frames. @param image CV_8UC1
  /// @param covariance of lens->parameters(); empty: exact
  /// @throws Error for an image of another type, or without a lens
  void setReference(const LensPtr& lens, const cv::Mat& image,
                    const Eigen::MatrixXd& covariance = {});

  /// A frame joins the estimate.
  /// @return range, sigma and score of all frames so far
  /// @throws Error without a reference, for a pose without parallax, and as makeMatcher(); the
  /// estimate is then as it was
  MatchResult add(const StereoGeometry::Displaced& camera, const cv::Mat& image);

  int frames() const;      ///< that joined since setReference()
  int framesKept() const;  ///< whose images are held; for tests

 private:
  struct State;
  std::unique_ptr<State> state_;
};

}  // namespace omnister
