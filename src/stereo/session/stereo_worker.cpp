// SPDX-License-Identifier: Apache-2.0
#include "stereo/session/stereo_worker.h"

#include <algorithm>
#include <utility>

#include "omnister/common/error.h"
#include "omnister/lens/reduced_lens.h"
#include "omnister/stereo/input_region.h"
#include "omnister/stereo/range_warp.h"

namespace omnister {
namespace {

/// Geometries whose matcher is kept: a stage that goes to and fro has two.
constexpr std::size_t kMatchersKept = 4;
/// Reduced lenses that are kept: new lenses come with new calibrations.
constexpr std::size_t kLensesKept = 8;
/// Poses nearer than this share of the baseline have the same matcher: far below a pixel.
constexpr double kSamePlace = 2e-4;
constexpr double kSameAngle = 1e-4;  // [rad]

bool sameGeometry(const StereoGeometry& a, const StereoGeometry& b) {
  if (a.reference_lens != b.reference_lens || a.displaced.size() != b.displaced.size())
    return false;
  for (std::size_t i = 0; i < a.displaced.size(); ++i) {
    const Pose& first = a.displaced[i].T_ref_disp;
    const Pose& second = b.displaced[i].T_ref_disp;
    if (a.displaced[i].lens != b.displaced[i].lens) return false;
    if ((first.translation() - second.translation()).norm() >
        kSamePlace * second.translation().norm())
      return false;
    if (Eigen::AngleAxisd(first.linear().transpose() * second.linear()).angle() > kSameAngle)
      return false;
  }
  return true;
}

}  // namespace

StereoSet toStereoSet(const FrameSet& set) {
  const auto image = [](const PairingFrame& frame) {
    return std::static_pointer_cast<const StereoFrame>(frame.image);
  };
  StereoSet result;
  result.reference = image(set.reference);
  result.T_fixed_reference = set.reference.T_fixed_camera;
  for (const FrameSet::Displaced& displaced : set.displaced) {
    result.displaced.push_back(image(displaced.frame));
    result.T_ref_disp.push_back(displaced.T_ref_disp);
  }
  return result;
}

StereoWorker::StereoWorker(WorkerSettings settings) : settings_(std::move(settings)) {}

void StereoWorker::configure(WorkerSettings settings) {
  matchers_.clear();
  reduced_.clear();
  stream_.reset();
  before_.reset();
  settings_ = std::move(settings);
}

LensPtr StereoWorker::reducedOnce(const LensPtr& lens) {
  if (settings_.reduce == 1) return lens;
  if (reduced_.size() > kLensesKept) reduced_.clear();
  LensPtr& small = reduced_[lens];
  if (!small) small = reducedLens(lens, settings_.reduce);
  return small;
}

PreparedSet StereoWorker::prepare(const StereoSet& set, const LensFile& reference,
                                  const LensFile& displaced, const std::string& reference_name,
                                  const std::string& displaced_name) {
  set.reference->check(reference.image_size, reference_name);
  for (const auto& image : set.displaced) image->check(displaced.image_size, displaced_name);
  const int factor = settings_.reduce;
  for (const cv::Size size : {reference.image_size, displaced.image_size}) {
    if (factor > 1 && (size.width / factor < 16 || size.height / factor < 16))
      throw InputError("reduce", "", "leaves less than 16 pixels of the images");
  }
  PreparedSet prepared;
  full_size_ = reference.image_size;
  prepared.geometry.reference_lens = reducedOnce(reference.lens);
  prepared.geometry.reference_size = reference.image_size / factor;
  if (reference.covariance) prepared.geometry.reference_covariance = *reference.covariance;
  for (const Pose& pose : set.T_ref_disp) {
    prepared.geometry.displaced.push_back(
        {reducedOnce(displaced.lens), displaced.image_size / factor, pose});
    if (displaced.covariance) prepared.geometry.displaced.back().covariance = *displaced.covariance;
  }
  // 16-bit images of a set are scaled alike.
  prepared.bits = set.reference->significantBits();
  for (const auto& image : set.displaced)
    prepared.bits = std::max(prepared.bits, image->significantBits());
  prepared.reference = reducedImage(set.reference->gray(prepared.bits), factor);
  for (const auto& image : set.displaced)
    prepared.displaced.push_back(reducedImage(image->gray(prepared.bits), factor));
  return prepared;
}

MatcherOptions StereoWorker::optionsFor(cv::Size reduced_size) {
  const cv::Size full = full_size_.empty() ? reduced_size : full_size_;
  MatcherOptions options = settings_.matching;
  if (!options.mask.empty() && options.mask.size() != full)
    throw InputError("mask", "size", "is not that of the lens' image");
  const cv::Rect region = parseRegion(settings_.region, full, "roi");
  options.mask = matchingMask(options.mask, region, full, settings_.reduce);
  // Only a matcher that refines takes priors.
  options.refine = options.refine || settings_.use_prior;
  return options;
}

Matcher& StereoWorker::matcherFor(const StereoGeometry& geometry) {
  const auto known = std::find_if(
      matchers_.begin(), matchers_.end(),
      [&](const CachedMatcher& kept) { return sameGeometry(kept.geometry, geometry); });
  if (known != matchers_.end()) {
    matchers_.splice(matchers_.begin(), matchers_, known);
  } else {
    const MatcherOptions options = optionsFor(geometry.reference_size);
    matchers_.push_front({geometry, makeMatcher(settings_.matcher, geometry, options)});
    if (matchers_.size() > kMatchersKept) matchers_.pop_back();
  }
  return *matchers_.front().matcher;
}

std::optional<MatchedSet> StereoWorker::match(const StereoSet& set, const PreparedSet& prepared) {
  if (settings_.stream && set.T_fixed_reference) return join(set, prepared);
  const StereoGeometry& geometry = prepared.geometry;
  Matcher& matcher = matcherFor(geometry);
  if (settings_.use_prior) {
    cv::Mat prior;
    if (before_ && set.T_fixed_reference) {
      prior =
          warpRange(before_->range, before_->lens,
                    set.T_fixed_reference->inverse() * before_->T_fixed_reference,
                    geometry.reference_lens, geometry.reference_size, settings_.matching.threads);
    }
    matcher.setPrior(prior);
  }
  MatchedSet matched;
  matched.result = matcher.match(prepared.reference, prepared.displaced);
  matched.image = set.reference;
  matched.grey = prepared.reference;
  matched.bits = prepared.bits;
  matched.lens = geometry.reference_lens;
  matched.displaced = set.displaced.front();
  matched.displaced_from = geometry.displaced.front();
  matched.positions = static_cast<int>(set.displaced.size());
  before_.reset();
  if (settings_.use_prior && set.T_fixed_reference)
    before_ = Before{matched.result.range, matched.lens, *set.T_fixed_reference};
  return matched;
}

std::optional<MatchedSet> StereoWorker::join(const StereoSet& set, const PreparedSet& prepared) {
  const StereoGeometry& geometry = prepared.geometry;
  // One camera: its lens and size are those of the reference.
  StereoGeometry::Displaced camera = geometry.displaced.front();
  const auto standsAt = [&] {
    camera.T_ref_disp = stream_->T_fixed_reference.inverse() * *set.T_fixed_reference;
    return camera.T_ref_disp.translation().norm();
  };
  if (stream_) {
    const bool far = standsAt() > settings_.max_baseline ||
                     Eigen::AngleAxisd(camera.T_ref_disp.linear()).angle() > settings_.max_rotation;
    if (far || stream_->reference.lens != geometry.reference_lens) stream_.reset();
  }
  if (!stream_) {
    // It begins where the camera came from, so that this frame is its first.
    auto stream = std::make_unique<Stream>(optionsFor(geometry.reference_size));
    stream->reference.image = set.displaced.front();
    stream->reference.grey = prepared.displaced.front();
    stream->reference.bits = prepared.bits;
    stream->reference.lens = geometry.reference_lens;
    stream->T_fixed_reference = *set.T_fixed_reference * set.T_ref_disp.front();
    stream->matcher.setReference(geometry.reference_lens, prepared.displaced.front(),
                                 geometry.reference_covariance);
    stream_ = std::move(stream);
  }
  if (standsAt() < settings_.min_baseline) return std::nullopt;
  MatchedSet matched = stream_->reference;
  matched.result = stream_->matcher.add(camera, prepared.reference);
  matched.displaced = set.reference;
  matched.displaced_from = camera;
  matched.positions = stream_->matcher.frames();
  return matched;
}

const cv::Mat& StereoWorker::rays(const MatchedSet& matched) {
  if (rays_lens_ != matched.lens || rays_.size() != matched.grey.size()) {
    rays_ = viewingRays(*matched.lens, matched.grey.size(), settings_.matching.threads);
    rays_lens_ = matched.lens;
  }
  return rays_;
}

cv::Mat StereoWorker::picture(const MatchedSet& matched, bool color) const {
  // Colours of a grey image are its grey levels.
  if (!color || matched.image->isGray()) return matched.grey;
  return reducedImage(matched.image->bgr(matched.bits), settings_.reduce);
}

}  // namespace omnister
