// SPDX-License-Identifier: Apache-2.0
/// @file Which frames of ONE moving camera make a stereo set. Knows no ROS: poses come by a
/// function.
#pragma once

#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "omnister/common/pose.h"

namespace omnister {

struct PairingOptions {
  double min_baseline = 0.01;  ///< between reference and displaced camera [m], > 0
  double max_baseline = 1.0;   ///< [m], > min_baseline
  double max_rotation = 0.5;   ///< between reference and displaced camera [rad]
  int positions = 1;           ///< displaced frames in a set, >= 1
  double settle_time = 0.04;  ///< the camera rests this long before and after the stamp [s]; 0: any
                              ///< frame counts as settled (recordings made in motion)
  double settle_distance = 2e-4;  ///< and moves less than this in it [m]
  double settle_angle = 1e-3;     ///< and turns less than this [rad]
  double max_wait = 1.0;          ///< for the pose of a frame [s]
  double max_age = 0.0;           ///< of a displaced frame against the reference [s]; 0: no limit
  std::size_t max_waiting = 16;   ///< frames that wait for their pose; the oldest goes first
  std::size_t history = 8;        ///< positions kept to pair with, >= positions
};

/// What is known about the camera's pose at some time.
struct PoseAnswer {
  enum class State { kKnown, kLater, kNever };
  State state = State::kNever;
  Pose T_fixed_camera = Pose::Identity();
  std::string reason;  ///< why not, for a person
};

/// Pose of `frame_id` in the fixed frame at a stamp [ns since the epoch].
using PoseLookup = std::function<PoseAnswer(const std::string& frame_id, std::int64_t stamp_ns)>;

/// One image and where it was taken. The image is opaque here.
struct PairingFrame {
  std::int64_t stamp_ns = 0;
  std::string frame_id;  ///< optical frame
  std::shared_ptr<const void> image;
  Pose T_fixed_camera = Pose::Identity();
};

/// A reference frame and its displaced ones, newest first.
struct FrameSet {
  PairingFrame reference;
  struct Displaced {
    PairingFrame frame;
    Pose T_ref_disp;  ///< displaced camera into reference camera [m]
  };
  std::vector<Displaced> displaced;
};

/// Frames go in by add() as they arrive, sets come out by poll(). The newest settled frame is the
/// reference; displaced frames are the newest ones at distinct places within the baseline limits. A
/// stamp that jumps back, or another frame_id, starts anew. Not thread-safe.
class FramePairing {
 public:
  /// @throws Error for options that contradict themselves
  explicit FramePairing(const PairingOptions& options);

  /// Frames are kept; the next set is made by these. @throws Error as the constructor
  void setOptions(const PairingOptions& options);

  /// @param now_ns time by the clock that stamps are from [ns]
  void add(PairingFrame frame, std::int64_t now_ns);

  /// Looks up poses of the waiting frames. @return the newest complete set, if one came up since
  std::optional<FrameSet> poll(const PoseLookup& lookup, std::int64_t now_ns);

  /// Forgets all frames. @param reason for reason() and counts()
  void reset(const std::string& reason);

  /// True while frames wait for their poses: poll() again soon.
  bool waiting() const { return !waiting_.empty(); }
  std::size_t waitingFrames() const { return waiting_.size(); }
  /// Frames held, waiting ones included: bounded by max_waiting + history + 1.
  std::size_t held() const { return waiting_.size() + history_.size() + (newest_ ? 1 : 0); }
  /// Why the last settled or refused frame made no set; empty after one that did.
  const std::string& reason() const { return reason_; }
  /// The last frame that was looked up was dropped because the camera moves: that passes by itself.
  bool moving() const { return moving_; }
  /// Frames dropped because tf leaps as no stage moves: somebody else publishes it.
  std::size_t leaps() const { return leaps_; }
  /// Since the last set: the distance between two places that came last and was not within the
  /// baseline limits [m].
  const std::optional<double>& missedBaseline() const { return missed_baseline_; }
  /// Frames by what became of them: "received", "settled", "paired", and by what dropped them.
  const std::map<std::string, std::size_t>& counts() const { return counts_; }

 private:
  enum class Verdict { kWait, kDrop, kMoving, kSettled };
  Verdict judge(PairingFrame& frame, const PoseLookup& lookup);
  void keep(PairingFrame frame);
  std::optional<FrameSet> makeSet();
  void drop(const std::string& name, const std::string& reason);

  struct Waiting {
    PairingFrame frame;
    std::int64_t since_ns;
    std::string reason;  ///< of the last look-up
  };

  PairingOptions options_;
  std::deque<Waiting> waiting_;
  std::deque<PairingFrame> history_;  ///< settled frames at distinct places, newest at the back
  std::optional<PairingFrame> newest_;
  std::optional<std::int64_t> last_stamp_ns_;
  std::string reason_ = "no image yet";
  bool moving_ = false;
  std::size_t leaps_ = 0;
  std::optional<double> missed_baseline_;
  std::map<std::string, std::size_t> counts_;
};

}  // namespace omnister
