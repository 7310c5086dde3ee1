// SPDX-License-Identifier: Apache-2.0
#include "omnister/ros/stereo_worker.h"

#include <algorithm>
#include <utility>

#include "omnister/common/error.h"
#include "omnister/ros/image_input.h"

namespace omnister {
namespace {

/// Geometries whose matcher is kept: a stage that goes to and fro has two.
constexpr std::size_t kMatchersKept = 4;
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
  const auto message = [](const PairingFrame& frame) {
    const std::shared_ptr<const void> held = frame.image;
    return sensor_msgs::ImageConstPtr(static_cast<const sensor_msgs::Image*>(held.get()),
                                      [held](const sensor_msgs::Image*) {});
  };
  StereoSet result;
  result.reference = message(set.reference);
  for (const FrameSet::Displaced& displaced : set.displaced) {
    result.displaced.push_back(message(displaced.frame));
    result.T_ref_disp.push_back(displaced.T_ref_disp);
  }
  return result;
}

StereoWorker::StereoWorker(std::string matcher, MatcherOptions options)
    : matcher_(std::move(matcher)), options_(std::move(options)) {}

void StereoWorker::configure(std::string matcher, MatcherOptions options) {
  matchers_.clear();
  matcher_ = std::move(matcher);
  options_ = std::move(options);
}

PreparedSet StereoWorker::prepare(const StereoSet& set, const LensFile& reference,
                                  const LensFile& displaced, const std::string& reference_name,
                                  const std::string& displaced_name) {
  checkFrame(*set.reference, reference.image_size, reference_name);
  for (const auto& image : set.displaced) checkFrame(*image, displaced.image_size, displaced_name);
  PreparedSet prepared;
  prepared.geometry.reference_lens = reference.lens;
  prepared.geometry.reference_size = reference.image_size;
  if (reference.covariance) prepared.geometry.reference_covariance = *reference.covariance;
  for (const Pose& pose : set.T_ref_disp) {
    prepared.geometry.displaced.push_back({displaced.lens, displaced.image_size, pose});
    if (displaced.covariance) prepared.geometry.displaced.back().covariance = *displaced.covariance;
  }
  // 16-bit images of a set are scaled alike.
  prepared.bits = significantBits(*set.reference);
  for (const auto& image : set.displaced)
    prepared.bits = std::max(prepared.bits, significantBits(*image));
  prepared.reference = toGray(*set.reference, prepared.bits);
  for (const auto& image : set.displaced)
    prepared.displaced.push_back(toGray(*image, prepared.bits));
  return prepared;
}

Matcher& StereoWorker::matcherFor(const StereoGeometry& geometry) {
  if (!options_.mask.empty() && options_.mask.size() != geometry.reference_size)
    throw InputError("mask", "size", "is not that of the lens' image");
  const auto known = std::find_if(
      matchers_.begin(), matchers_.end(),
      [&](const CachedMatcher& kept) { return sameGeometry(kept.geometry, geometry); });
  if (known != matchers_.end()) {
    matchers_.splice(matchers_.begin(), matchers_, known);
  } else {
    matchers_.push_front({geometry, makeMatcher(matcher_, geometry, options_)});
    if (matchers_.size() > kMatchersKept) matchers_.pop_back();
  }
  return *matchers_.front().matcher;
}

Cloud StereoWorker::points(const StereoSet& set, const PreparedSet& prepared,
                           const MatchResult& result, const LensFile& reference, bool color) {
  if (rays_lens_ != reference.lens) {
    rays_ = viewingRays(*reference.lens, reference.image_size, options_.threads);
    rays_lens_ = reference.lens;
  }
  return makeCloud(result, rays_, color ? toBgr(*set.reference, prepared.bits) : prepared.reference,
                   options_.threads);
}

}  // namespace omnister
