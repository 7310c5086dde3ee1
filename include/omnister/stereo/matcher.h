// SPDX-License-Identifier: Apache-2.0
/// @file What every matcher takes and gives.
///
/// Reference and displaced images stay distorted, each on its own pixel grid. A displaced camera stands
/// at T_ref_disp: it maps coordinates of the displaced camera into the reference camera [m].
#pragma once

#include <map>
#include <memory>
#include <opencv2/core/mat.hpp>
#include <string>
#include <utility>
#include <vector>

#include "omnister/common/pose.h"
#include "omnister/lens/lens_model.h"

namespace omnister {

/// Geometry that stays the same from frame to frame.
struct StereoGeometry {
  LensPtr reference_lens;
  cv::Size reference_size;          ///< [px]
  struct Displaced {
    LensPtr lens;
    cv::Size size;                  ///< [px]
    Pose T_ref_disp = Pose::Identity();
    /// Of lens->parameters(); empty: exact. A lens that is the reference's own has its covariance.
    Eigen::MatrixXd covariance = {};
    /// 6x6 of a shift [m] and a small rotation [rad] of the displaced camera, both in the reference
    /// frame; empty: exact.
    Eigen::MatrixXd pose_covariance = {};
  };
  std::vector<Displaced> displaced; ///< at least one
  /// Of reference_lens->parameters(); empty: exact. Covariances make part of the sigma of ranges.
  Eigen::MatrixXd reference_covariance = {};
};

struct MatcherOptions {
  double min_range = 0.0;           ///< along the ray [m]; 0: a parallax of atan(1/4) at most
  double max_range = 0.0;           ///< along the ray [m]; 0: infinity
  int hypotheses = 0;               ///< most candidates a pixel; 0: one for every pixel of parallax
  int threads = 0;                  ///< 0: every core
  /// Grey values have the last word on a pair's ranges too: half the error for a few times the time.
  /// With several displaced images they always have. Sweep only.
  bool refine = false;
  /// What is known before: CV_32FC1 of the reference size, range along the ray [m], NaN where it is
  /// not; may be empty. Where images alone find nothing it stands if their grey values confirm it,
  /// and is moved by them; where they find something else, that stands. Sweep only.
  cv::Mat prior;
  cv::Mat mask;                     ///< CV_8UC1 of the reference size, 0 leaves a pixel out; may be empty
};

/// Why pixels have no range, and where the time went.
struct MatchStatistics {
  std::map<std::string, double> seconds;       ///< by stage, and "total" [s]
  std::map<std::string, std::size_t> rejected; ///< pixels by the test that rejected them
  std::size_t valid = 0;                       ///< pixels with a range
};

/// Images on the reference pixel grid, all CV_32FC1; NaN where invalid.
struct MatchResult {
  cv::Mat range;    ///< along the ray from the reference camera's centre [m]
  cv::Mat sigma;    ///< standard deviation of range, by matching and by calibration [m]
  cv::Mat score;    ///< 0 (worthless) to 1 (perfect)
  MatchStatistics statistics;
};

/// A matcher made for one geometry; match() may be called for any number of frames.
class Matcher {
 public:
  virtual ~Matcher() = default;
  /// @param reference CV_8UC1, of the reference size
  /// @param displaced CV_8UC1, one for each of StereoGeometry::displaced
  /// @throws Error for images of another size or type
  virtual MatchResult match(const cv::Mat& reference, const std::vector<cv::Mat>& displaced) = 0;
};

/// @param name "sweep" or "thesis"
/// @throws Error for an unknown name, no parallax at all (zero baseline), range limits the wrong way,
/// or more hypotheses or memory than sense
std::unique_ptr<Matcher> makeMatcher(const std::string& name, const StereoGeometry& geometry,
                                     const MatcherOptions& options);

}  // namespace omnister
