// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/pose_doubt.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/lens/reduced_lens.h"
#include "omnister/stereo/input_region.h"

namespace omnister {
namespace {

constexpr int kSmallSide = 320;  // [px]
constexpr double kTimesBetter = 1.7;
constexpr double kLeastShare = 0.12;

struct Pair {
  LensPtr reference_lens, displaced_lens;
  cv::Mat reference, displaced;
  Pose T_ref_disp = Pose::Identity();
};

/// Share of the reference image that gets a range.
double shareOf(const Pair& pair, const MatcherOptions& options) {
  StereoGeometry geometry;
  geometry.reference_lens = pair.reference_lens;
  geometry.reference_size = pair.reference.size();
  StereoGeometry::Displaced displaced;
  displaced.lens = pair.displaced_lens;
  displaced.size = pair.displaced.size();
  displaced.T_ref_disp = pair.T_ref_disp;
  geometry.displaced.push_back(displaced);
  try {
    const auto matcher = makeMatcher("sweep", geometry, options);
    const MatchResult result = matcher->match(pair.reference, {pair.displaced});
    return static_cast<double>(result.statistics.valid) /
           static_cast<double>(pair.reference.total());
  } catch (const Error&) {
    return 0.0;
  }
}

/// The same rotation as read from "w x y z" where "x y z w" was meant.
Pose otherOrder(const Pose& pose) {
  const Eigen::Quaterniond q(pose.linear());
  Pose other = pose;
  other.linear() = Eigen::Quaterniond(q.x(), q.y(), q.z(), q.w()).normalized().toRotationMatrix();
  return other;
}

std::string percent(double share) {
  return std::to_string(static_cast<int>(std::lround(100.0 * share))) + " %";
}

}  // namespace

std::optional<std::string> poseDoubt(const StereoGeometry& geometry, const MatcherOptions& options,
                                     const cv::Mat& reference, const cv::Mat& displaced) {
  if (geometry.displaced.size() != 1) return std::nullopt;
  const StereoGeometry::Displaced& camera = geometry.displaced[0];
  const int side = std::max({reference.cols, reference.rows, displaced.cols, displaced.rows});
  const int factor = std::max(1, side / kSmallSide);
  Pair given;
  given.T_ref_disp = camera.T_ref_disp;
  try {
    given.reference_lens = reducedLens(geometry.reference_lens, factor);
    given.displaced_lens = camera.lens == geometry.reference_lens
                               ? given.reference_lens
                               : reducedLens(camera.lens, factor);
    given.reference = reducedImage(reference, factor);
    given.displaced = reducedImage(displaced, factor);
  } catch (const Error&) {
    return std::nullopt;
  }
  MatcherOptions small;
  small.min_range = options.min_range;
  small.max_range = options.max_range;
  small.threads = options.threads;
  const double as_given = shareOf(given, small);

  struct Guess {
    Pair pair;
    std::string cause;
  };
  std::vector<Guess> guesses;
  const auto guess = [&](std::string cause, const auto& change) {
    Guess& one = guesses.emplace_back(Guess{given, std::move(cause)});
    change(one.pair);
  };
  const bool one_lens = given.reference_lens == given.displaced_lens;
  const bool one_size = given.reference.size() == given.displaced.size();
  guess(std::string("with the pose inverted") + (one_lens ? " (or the images exchanged)" : "") +
            ": --pose is T_ref_disp, which maps coordinates of the displaced camera into the "
            "reference camera",
        [](Pair& pair) { pair.T_ref_disp = pair.T_ref_disp.inverse(); });
  if (one_size && !one_lens) {
    guess(
        "with the two images exchanged (or the lenses, and the pose inverted): is --reference the "
        "image of --lens, and --displaced that "
        "of --lens-displaced?",
        [](Pair& pair) { std::swap(pair.reference, pair.displaced); });
    guess("with the lenses exchanged: is --lens that of the reference camera?",
          [](Pair& pair) { std::swap(pair.reference_lens, pair.displaced_lens); });
    guess("with --lens for both cameras: is --lens-displaced the displaced camera's?",
          [](Pair& pair) { pair.displaced_lens = pair.reference_lens; });
    guess("with --lens-displaced for both cameras: is --lens the reference camera's?",
          [](Pair& pair) { pair.reference_lens = pair.displaced_lens; });
  }
  if (Eigen::AngleAxisd(camera.T_ref_disp.linear()).angle() > 1e-3) {
    guess("with the quaternion read as qw qx qy qz: --pose wants qx qy qz qw",
          [](Pair& pair) { pair.T_ref_disp = otherOrder(pair.T_ref_disp); });
    guess(
        "with the rotation the other way round: --pose maps coordinates of the displaced camera "
        "into the reference camera",
        [](Pair& pair) { pair.T_ref_disp.linear() = pair.T_ref_disp.linear().transpose().eval(); });
  }
  double best = std::max(kTimesBetter * as_given, kLeastShare);
  const Guess* likely = nullptr;
  for (const Guess& one : guesses) {
    const double share = shareOf(one.pair, small);
    if (share <= best) continue;
    // Another cause must be clearly better than the one found before, which is commoner.
    best = 1.1 * share;
    likely = &one;
  }
  if (likely == nullptr) return std::nullopt;
  return "few pixels get a range as given (" + percent(as_given) + " of a small copy), " +
         percent(shareOf(likely->pair, small)) + " would " + likely->cause;
}

}  // namespace omnister
