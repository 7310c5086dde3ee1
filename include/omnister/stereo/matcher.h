// SPDX-License-Identifier: Apache-2.0
/// @file What every matcher takes and gives.
///
/// Reference and displaced images stay distorted, each on its own pixel grid. A displaced camera
/// stands at T_ref_disp: it maps coordinates of the displaced camera into the reference camera [m].
#pragma once

#include <map>
#include <memory>
#include <opencv2/core/mat.hpp>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "omnister/common/pose.h"
#include "omnister/lens/lens_model.h"

namespace omnister {

/// Geometry that stays the same from frame to frame.
struct StereoGeometry {
  LensPtr reference_lens;
  cv::Size reference_size;  ///< [px]
  struct Displaced {
    LensPtr lens;
    cv::Size size;  ///< [px]
    Pose T_ref_disp = Pose::Identity();
    /// Of lens->parameters(); empty: exact. A lens that is the reference's own has its covariance.
    Eigen::MatrixXd covariance = {};
    /// 6x6 of a shift [m] and a small rotation [rad] of the displaced camera, both in the reference
    /// frame; empty: exact.
    Eigen::MatrixXd pose_covariance = {};
  };
  std::vector<Displaced> displaced;  ///< at least one
  /// Of reference_lens->parameters(); empty: exact. Covariances make part of the sigma of ranges.
  Eigen::MatrixXd reference_covariance = {};
};

/// How windows are compared.
enum class MatchCost {
  kCensus,  ///< signs of differences with 24 neighbours, Hamming distances (Zabih and Woodfill
            ///< 1994)
  kZncc,    ///< correlation of grey values without their means; exposures may differ
  kThesis,  ///< correlation of grey values as they are (Johnson 1997, eq. 3.1)
};
/// "census", "zncc" or "eq3.1". @throws Error for another name
MatchCost parseMatchCost(std::string_view name);

/// How windows stand in space.
enum class MatchWindow {
  kSurface,  ///< as the surfaces that coarser images show, plane by plane; else along the circle of
             ///< one parallax angle
  kRay,      ///< normal to the ray of their middle
  kFronto,   ///< parallel to the image plane, as in the thesis; normal to the ray beyond 80 degrees
  kBest,     ///< the better of the two, pixel by pixel
};
/// "surface", "ray", "fronto" or "best". @throws Error for another name
MatchWindow parseMatchWindow(std::string_view name);

struct MatcherOptions {
  double min_range = 0.0;  ///< along the ray [m]; 0: a parallax of atan(1/4) at most
  double max_range = 0.0;  ///< along the ray [m]; 0: infinity
  int hypotheses = 0;      ///< most candidates a pixel; 0: one for every pixel of parallax
  int threads = 0;         ///< 0: every core
  MatchCost cost = MatchCost::kCensus;         ///< sweep only; the thesis' matcher has eq. 3.1
  MatchWindow window = MatchWindow::kSurface;  ///< sweep only
  /// Grey values have the last word on a pair's ranges too: a quarter less error for a few times
  /// the time. With several displaced images they always have. Sweep only.
  bool refine = false;
  /// What is known before: CV_32FC1 of the reference size, range along the ray [m], NaN where it is
  /// not; may be empty. Where images alone find nothing it stands if their grey values confirm it,
  /// and is moved by them; where they find something else, that stands. Sweep only.
  cv::Mat prior;
  cv::Mat mask;  ///< CV_8UC1 of the reference size, 0 leaves a pixel out; may be empty
};

/// Why pixels have no range, and where the time went.
struct MatchStatistics {
  std::map<std::string, double> seconds;        ///< by stage, and "total" [s]
  std::map<std::string, std::size_t> rejected;  ///< pixels by the test that rejected them
  std::size_t valid = 0;                        ///< pixels with a range
};

/// Images on the reference pixel grid, all CV_32FC1; NaN where invalid.
struct MatchResult {
  cv::Mat range;  ///< along the ray from the reference camera's centre [m]
  cv::Mat sigma;  ///< standard deviation of range, by matching and by calibration [m]
  cv::Mat score;  ///< 0 (worthless) to 1 (perfect)
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

  /// Another MatcherOptions::prior from now on; may be empty. @return false for a matcher that was
  /// made to take none: the sweep takes one where it refines, and a prior or several displaced
  /// images make it. @throws Error for a prior of another size or type
  virtual bool setPrior(const cv::Mat& /*prior*/) { return false; }
};

/// @param name "sweep" or "thesis"
/// @throws Error for an unknown name, no parallax at all (zero baseline), range limits the wrong
/// way, or more hypotheses or memory than sense
std::unique_ptr<Matcher> makeMatcher(const std::string& name, const StereoGeometry& geometry,
                                     const MatcherOptions& options);

}  // namespace omnister
