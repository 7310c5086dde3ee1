// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/stream_matcher.h"

#include <algorithm>
#include <chrono>
#include <limits>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/stereo/matching_limits.h"
#include "stereo/result/range_uncertainty.h"
#include "stereo/sweep/multi_position.h"
#include "stereo/sweep/pair/pair.h"
#include "stereo/sweep/refine/joint_refinement.h"

namespace omnister {

struct StreamMatcher::State {
  struct Frame {
    StereoGeometry::Displaced camera;
    cv::Mat image;
    double place = 0;  ///< along the travel [m], negative behind the reference
  };
  MatcherOptions options;
  int frames_kept = 0;
  StereoGeometry geometry;  ///< of the reference, and one displaced camera at a time
  cv::Mat reference;
  Eigen::Vector3d direction = Eigen::Vector3d::Zero();  ///< of the first move
  std::unique_ptr<RangeFusion> fusion;
  std::unique_ptr<JointRefinement> refinement;
  std::unique_ptr<SweepPair> pair;  ///< the last one, for its buffers
  std::vector<Frame> kept;

  /// Of frames that crowd, the one between the nearest two others goes.
  void thinOut() {
    while (static_cast<int>(kept.size()) > frames_kept) {
      std::vector<std::size_t> order(kept.size());
      for (std::size_t i = 0; i < order.size(); ++i) order[i] = i;
      std::stable_sort(order.begin(), order.end(),
                       [&](std::size_t a, std::size_t b) { return kept[a].place < kept[b].place; });
      std::size_t crowded = kept.size() > 2 ? order[1] : 0;
      double least = std::numeric_limits<double>::max();
      for (std::size_t i = 1; i + 1 < order.size(); ++i) {
        const double gap = kept[order[i + 1]].place - kept[order[i - 1]].place;
        if (gap >= least) continue;
        least = gap;
        crowded = order[i];
      }
      kept.erase(kept.begin() + static_cast<std::ptrdiff_t>(crowded));
    }
  }
};

StreamMatcher::StreamMatcher(const MatcherOptions& options, int frames_kept)
    : state_(std::make_unique<State>()) {
  if (frames_kept < 1 || frames_kept > 64)
    throw Error("number of frames kept is " + std::to_string(frames_kept) + ", expected 1 to 64");
  state_->options = options;
  state_->options.mask = options.mask.clone();
  state_->frames_kept = frames_kept;
}

StreamMatcher::~StreamMatcher() = default;

void StreamMatcher::setReference(const LensPtr& lens, const cv::Mat& image,
                                 const Eigen::MatrixXd& covariance) {
  if (!lens) throw Error("the reference camera has no lens");
  if (image.empty() || image.type() != CV_8UC1)
    throw Error("reference image is not one of 8 bits and one channel");
  State& state = *state_;
  if (state.geometry.reference_lens != lens || state.geometry.reference_size != image.size()) {
    state.pair.reset();
    state.refinement.reset();
    state.fusion.reset();
  }
  state.geometry.reference_lens = lens;
  state.geometry.reference_size = image.size();
  state.geometry.reference_covariance = covariance;
  state.reference = image.clone();
  state.kept.clear();
  if (state.fusion) state.fusion->clear();
}

MatchResult StreamMatcher::add(const StereoGeometry::Displaced& camera, const cv::Mat& image) {
  State& state = *state_;
  if (state.reference.empty()) throw Error("a frame came before the reference image");
  const auto start = std::chrono::steady_clock::now();
  StereoGeometry geometry = state.geometry;
  geometry.displaced = {camera};
  checkMatching(geometry, state.options);
  checkImages(geometry, state.reference, {image});
  auto pair = makeSweepPair(geometry, state.options, PairChecks::kStrict);
  if (state.pair) pair->takeBuffers(state.pair.get());
  state.pair = std::move(pair);
  MatchResult result = state.pair->match(state.reference, {image});
  if (!state.fusion)
    state.fusion = std::make_unique<RangeFusion>(state.reference.size(), state.options.threads);
  state.fusion->add(result);

  const Eigen::Vector3d place = camera.T_ref_disp.translation();
  if (state.kept.empty()) state.direction = place.normalized();
  state.kept.push_back({camera, image.clone(), place.dot(state.direction)});
  state.thinOut();
  geometry.displaced.clear();
  std::vector<cv::Mat> images;
  for (const State::Frame& frame : state.kept) {
    geometry.displaced.push_back(frame.camera);
    images.push_back(frame.image);
  }
  if (!state.refinement)
    state.refinement = std::make_unique<JointRefinement>(geometry, state.options.threads);
  else
    state.refinement->setDisplaced(geometry.displaced);
  // The running estimate stays what the pairs say: the refinement begins afresh each time.
  const auto fused = std::chrono::steady_clock::now();
  cv::Mat inverse = state.fusion->inverse.clone(), weight = state.fusion->weight.clone();
  result.statistics.rejected["not confirmed"] =
      state.refinement->refine(state.reference, images, state.fusion->support, &inverse, &weight);
  concludeRange(inverse, weight, state.fusion->score, state.options, &result);
  if (hasCovariance(geometry)) {
    const double min_range = checkMatching(geometry, state.options).min_range;
    RangeUncertainty(geometry, min_range, state.options.threads).addTo(&result);
  }
  const auto end = std::chrono::steady_clock::now();
  result.statistics.seconds["refine"] = std::chrono::duration<double>(end - fused).count();
  result.statistics.seconds["total"] = std::chrono::duration<double>(end - start).count();
  return result;
}

int StreamMatcher::frames() const { return state_->fusion ? state_->fusion->count() : 0; }
int StreamMatcher::framesKept() const { return static_cast<int>(state_->kept.size()); }

}  // namespace omnister
