// SPDX-License-Identifier: Apache-2.0
#include "stereo/session/frame_pairing.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>

#include "omnister/common/error.h"

namespace omnister {
namespace {

constexpr double kFastest = 2.0;  // [m/s] of a stage

std::int64_t nanoseconds(double seconds) { return static_cast<std::int64_t>(seconds * 1e9); }

double distance(const Pose& a, const Pose& b) { return (a.translation() - b.translation()).norm(); }

double angle(const Pose& a, const Pose& b) {
  return Eigen::AngleAxisd(a.linear().transpose() * b.linear()).angle();
}

std::string metres(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.4g m", value);
  return text;
}

std::string degrees(double radians) {
  char text[32];
  std::snprintf(text, sizeof text, "%.3g deg", radians * 57.29577951308232);
  return text;
}

}  // namespace

FramePairing::FramePairing(const PairingOptions& options) { setOptions(options); }

void FramePairing::setOptions(const PairingOptions& options) {
  if (!(options.min_baseline > 0.0))
    throw Error("min_baseline is " + metres(options.min_baseline) + ", expected more than 0");
  if (!(options.max_baseline > options.min_baseline))
    throw Error("max_baseline is " + metres(options.max_baseline) +
                ", expected more than min_baseline, " + metres(options.min_baseline));
  if (options.positions < 1)
    throw Error("positions is " + std::to_string(options.positions) + ", expected 1 or more");
  if (options.history < static_cast<std::size_t>(options.positions) || options.max_waiting < 1)
    throw Error("history is " + std::to_string(options.history) +
                ", expected at least positions, " + std::to_string(options.positions));
  options_ = options;
}

void FramePairing::drop(const std::string& name, const std::string& reason) {
  ++counts_[name];
  reason_ = reason;
}

void FramePairing::reset(const std::string& reason) {
  counts_["dropped by reset"] += waiting_.size();
  waiting_.clear();
  history_.clear();
  newest_.reset();
  last_stamp_ns_.reset();
  missed_baseline_.reset();
  ++counts_["resets"];
  reason_ = reason;
}

void FramePairing::add(PairingFrame frame, std::int64_t now_ns) {
  if (last_stamp_ns_ && frame.stamp_ns < *last_stamp_ns_)
    reset("time jumped back by " + std::to_string((*last_stamp_ns_ - frame.stamp_ns) / 1000000) +
          " ms: starting anew");
  const std::string known_id = !waiting_.empty() ? waiting_.back().frame.frame_id
                               : newest_         ? newest_->frame_id
                                                 : frame.frame_id;
  if (frame.frame_id != known_id)
    reset("frame_id changed from '" + printable(known_id) + "' to '" + printable(frame.frame_id) +
          "': starting anew");
  ++counts_["received"];
  if (last_stamp_ns_ && frame.stamp_ns == *last_stamp_ns_)
    return drop("same stamp twice", "two images have the same stamp");
  last_stamp_ns_ = frame.stamp_ns;
  waiting_.push_back({std::move(frame), now_ns, "not looked up yet"});
  if (waiting_.size() > options_.max_waiting) {
    drop("queue full", "more than " + std::to_string(options_.max_waiting) +
                           " images wait for their pose (" + waiting_.front().reason + ")");
    waiting_.pop_front();
  }
}

FramePairing::Verdict FramePairing::judge(PairingFrame& frame, const PoseLookup& lookup) {
  const auto ask = [&](std::int64_t stamp_ns, PoseAnswer& answer) {
    answer = lookup(frame.frame_id, stamp_ns);
    if (answer.state == PoseAnswer::State::kKnown && !answer.T_fixed_camera.matrix().allFinite()) {
      answer.state = PoseAnswer::State::kNever;
      answer.reason = "the pose is not finite";
    }
    if (answer.state == PoseAnswer::State::kKnown) return Verdict::kSettled;
    reason_ = "no pose for the image: " + answer.reason;
    if (answer.state == PoseAnswer::State::kLater) return Verdict::kWait;
    ++counts_["no pose"];
    return Verdict::kDrop;
  };
  PoseAnswer at;
  if (const Verdict verdict = ask(frame.stamp_ns, at); verdict != Verdict::kSettled) return verdict;
  frame.T_fixed_camera = at.T_fixed_camera;
  if (!(options_.settle_time > 0.0)) return Verdict::kSettled;
  for (const double side : {-options_.settle_time, options_.settle_time}) {
    PoseAnswer beside;
    const Verdict verdict = ask(frame.stamp_ns + nanoseconds(side), beside);
    if (verdict != Verdict::kSettled) return verdict;
    const double moved = distance(at.T_fixed_camera, beside.T_fixed_camera);
    const double turned = angle(at.T_fixed_camera, beside.T_fixed_camera);
    if (!(moved <= options_.settle_distance) || !(turned <= options_.settle_angle)) {
      const bool jumps = moved > kFastest * options_.settle_time;
      leaps_ += jumps;
      drop("moving", std::string(jumps ? "tf jumps (does somebody else publish it?): "
                                       : "the camera moves: ") +
                         metres(moved) + " and " + degrees(turned) + " within " +
                         std::to_string(std::lround(options_.settle_time * 1e3)) + " ms");
      return jumps ? Verdict::kDrop : Verdict::kMoving;
    }
  }
  return Verdict::kSettled;
}

void FramePairing::keep(PairingFrame frame) {
  ++counts_["settled"];
  if (newest_) {
    // Thinned to half the least baseline, so that a slowly creeping camera still gathers a baseline
    // and memory stays bounded. At the very same place the fresher image wins.
    const double spacing = 0.5 * options_.min_baseline;
    const bool creeping = !history_.empty() && distance(history_.back().T_fixed_camera,
                                                        newest_->T_fixed_camera) < spacing;
    const bool same_place =
        creeping && distance(history_.back().T_fixed_camera, newest_->T_fixed_camera) <=
                        options_.settle_distance;
    if (!creeping || same_place) {
      history_.erase(std::remove_if(history_.begin(), history_.end(),
                                    [&](const PairingFrame& old) {
                                      return distance(old.T_fixed_camera, newest_->T_fixed_camera) <
                                             spacing;
                                    }),
                     history_.end());
      history_.push_back(std::move(*newest_));
      if (history_.size() > options_.history) history_.pop_front();
    }
  }
  newest_ = std::move(frame);
}

std::optional<FrameSet> FramePairing::makeSet() {
  FrameSet set;
  set.reference = *newest_;
  const Pose T_ref_fixed = newest_->T_fixed_camera.inverse();
  double nearest_miss = std::numeric_limits<double>::quiet_NaN();
  bool turned = false;
  bool old = false;
  for (auto frame = history_.rbegin(); frame != history_.rend(); ++frame) {
    if (options_.max_age > 0.0 &&
        newest_->stamp_ns - frame->stamp_ns > nanoseconds(options_.max_age)) {
      old = true;
      continue;
    }
    const Pose T_ref_disp = T_ref_fixed * frame->T_fixed_camera;
    const double baseline = T_ref_disp.translation().norm();
    if (baseline <= options_.settle_distance) continue;  // the same place
    if (baseline < options_.min_baseline || baseline > options_.max_baseline) {
      if (!(std::abs(baseline - options_.min_baseline) >
            std::abs(nearest_miss - options_.min_baseline)))
        nearest_miss = baseline;
      continue;
    }
    if (Eigen::AngleAxisd(T_ref_disp.linear()).angle() > options_.max_rotation) {
      turned = true;
      continue;
    }
    const bool distinct =
        std::all_of(set.displaced.begin(), set.displaced.end(), [&](const auto& taken) {
          return distance(taken.T_ref_disp, T_ref_disp) >= options_.min_baseline;
        });
    if (!distinct) continue;
    set.displaced.push_back({*frame, T_ref_disp});
    if (static_cast<int>(set.displaced.size()) == options_.positions) {
      ++counts_["paired"];
      reason_.clear();
      missed_baseline_.reset();
      return set;
    }
  }
  if (!std::isnan(nearest_miss)) missed_baseline_ = nearest_miss;
  std::string why;
  if (!set.displaced.empty())
    why = std::to_string(set.displaced.size()) + " of " + std::to_string(options_.positions) +
          " displaced positions";
  else if (!std::isnan(nearest_miss))
    why = "the baseline is " + metres(nearest_miss) + ", outside " + metres(options_.min_baseline) +
          " to " + metres(options_.max_baseline);
  else if (turned)
    why = "the camera turned by more than " + degrees(options_.max_rotation);
  else if (old)
    why = "frames at other positions are older than max_age";
  else
    why = "the camera has been at one position only";
  drop("no baseline", "no pair: " + why);
  return std::nullopt;
}

std::optional<FrameSet> FramePairing::poll(const PoseLookup& lookup, std::int64_t now_ns) {
  std::optional<FrameSet> newest_set;
  while (!waiting_.empty()) {
    Waiting& next = waiting_.front();
    const Verdict verdict = judge(next.frame, lookup);
    moving_ = verdict == Verdict::kMoving;
    if (verdict == Verdict::kWait) {
      next.reason = reason_;
      if (now_ns - next.since_ns <= nanoseconds(options_.max_wait)) break;
      drop("no pose", reason_);
    } else if (verdict == Verdict::kSettled) {
      keep(std::move(next.frame));
      waiting_.pop_front();
      if (std::optional<FrameSet> set = makeSet()) {
        if (newest_set) ++counts_["superseded"];
        newest_set = std::move(set);
      }
      continue;
    }
    waiting_.pop_front();
  }
  return newest_set;
}

}  // namespace omnister
