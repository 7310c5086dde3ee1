// SPDX-License-Identifier: Apache-2.0
#include "stereo/session/frame_pairing.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "omnister/common/error.h"

namespace omnister {
namespace {

using testing::HasSubstr;

constexpr std::int64_t kMillisecond = 1000000;

/// A stage along x: stands at positions[i] during [i, i + 0.8) s, moves on linearly until i + 1 s.
struct Stage {
  std::vector<double> positions;
  std::int64_t known_until_ns = std::numeric_limits<std::int64_t>::max();

  PoseAnswer operator()(const std::string&, std::int64_t stamp_ns) const {
    PoseAnswer answer;
    if (stamp_ns > known_until_ns) {
      answer.state = PoseAnswer::State::kLater;
      answer.reason = "tf is behind";
      return answer;
    }
    if (stamp_ns < 0) {
      answer.reason = "before all tf";
      return answer;
    }
    const double time = static_cast<double>(stamp_ns) * 1e-9;
    const auto i = std::min(static_cast<std::size_t>(time), positions.size() - 1);
    const double next = positions[std::min(i + 1, positions.size() - 1)];
    const double share = std::max(0.0, (time - static_cast<double>(i) - 0.8) / 0.2);
    answer.state = PoseAnswer::State::kKnown;
    answer.T_fixed_camera.translation().x() =
        positions[i] + std::min(1.0, share) * (next - positions[i]);
    return answer;
  }
};

PairingFrame frameAt(std::int64_t milliseconds) {
  PairingFrame frame;
  frame.stamp_ns = milliseconds * kMillisecond;
  frame.frame_id = "camera_optical";
  return frame;
}

PairingOptions options(int positions = 1) {
  PairingOptions result;
  result.min_baseline = 0.05;
  result.max_baseline = 0.5;
  result.positions = positions;
  return result;
}

TEST(FramePairing, PairsTheNewestSettledFrameWithTheLastPositionBefore) {
  FramePairing pairing(options());
  const Stage stage{{0.0, 0.1, 0.2}};
  int sets = 0;
  for (int t = 100; t < 2800; t += 100) {
    pairing.add(frameAt(t), t * kMillisecond);
    const auto set = pairing.poll(stage, t * kMillisecond);
    if (t < 1000) {
      EXPECT_FALSE(set) << t;
    } else if (set) {
      ++sets;
      EXPECT_EQ(set->reference.stamp_ns, t * kMillisecond);
      ASSERT_EQ(set->displaced.size(), 1u);
      // The displaced camera stands one step behind, seen from the reference.
      EXPECT_NEAR(set->displaced[0].T_ref_disp.translation().x(), -0.1, 1e-12);
      EXPECT_EQ(set->displaced[0].frame.stamp_ns,
                (t / 1000 - 1) * 1000 * kMillisecond + 700 * kMillisecond);
    }
    EXPECT_LE(pairing.held(), 8u + 1u);
  }
  // Settled in [1.1, 1.7] and [2.1, 2.7]: the frame at 0.8 s and those in motion are refused.
  EXPECT_EQ(sets, 14);
  EXPECT_EQ(pairing.counts().at("paired"), 14u);
  EXPECT_EQ(pairing.counts().at("moving"), 6u);
}

TEST(FramePairing, SeveralPositionsAreDistinctAndNewestFirst) {
  FramePairing pairing(options(3));
  const Stage stage{{0.0, 0.1, 0.2, 0.1, 0.3}};
  std::optional<FrameSet> last;
  for (int t = 100; t < 4700; t += 200) {
    pairing.add(frameAt(t), 0);
    if (auto set = pairing.poll(stage, 0)) last = set;
    if (t < 4000) {
      EXPECT_FALSE(last) << t << " ms: three positions are known first at 4 s";
    }
  }
  ASSERT_TRUE(last);
  ASSERT_EQ(last->displaced.size(), 3u);
  EXPECT_NEAR(last->displaced[0].T_ref_disp.translation().x(), -0.2, 1e-12);
  EXPECT_NEAR(last->displaced[1].T_ref_disp.translation().x(), -0.1, 1e-12);
  EXPECT_NEAR(last->displaced[2].T_ref_disp.translation().x(), -0.3, 1e-12);
}

TEST(FramePairing, WaitsForPosesThatComeLater) {
  FramePairing pairing(options());
  Stage stage{{0.0, 0.1}};
  pairing.add(frameAt(500), 500 * kMillisecond);
  pairing.add(frameAt(1500), 1500 * kMillisecond);
  stage.known_until_ns = 1500 * kMillisecond;  // the frame's own pose, not yet 40 ms after it
  EXPECT_FALSE(pairing.poll(stage, 1500 * kMillisecond));
  EXPECT_TRUE(pairing.waiting());
  EXPECT_THAT(pairing.reason(), HasSubstr("tf is behind"));
  stage.known_until_ns = 1540 * kMillisecond;
  EXPECT_TRUE(pairing.poll(stage, 1560 * kMillisecond));
  EXPECT_FALSE(pairing.waiting());
  EXPECT_EQ(pairing.reason(), "");
}

TEST(FramePairing, GivesUpWaitingAndSaysWhy) {
  FramePairing pairing(options());
  Stage stage{{0.0}, 0};
  pairing.add(frameAt(500), 500 * kMillisecond);
  EXPECT_FALSE(pairing.poll(stage, 600 * kMillisecond));
  EXPECT_TRUE(pairing.waiting());
  EXPECT_FALSE(pairing.poll(stage, 1600 * kMillisecond));
  EXPECT_FALSE(pairing.waiting());
  EXPECT_EQ(pairing.counts().at("no pose"), 1u);
  EXPECT_THAT(pairing.reason(), HasSubstr("tf is behind"));
}

TEST(FramePairing, MemoryIsBoundedWhenNoPoseEverComes) {
  FramePairing pairing(options());
  Stage stage{{0.0}, -1};
  for (int t = 0; t < 1000; ++t) {
    pairing.add(frameAt(t), 0);
    pairing.poll(stage, 0);
  }
  EXPECT_EQ(pairing.held(), PairingOptions{}.max_waiting);
  EXPECT_EQ(pairing.counts().at("queue full"), 1000u - PairingOptions{}.max_waiting);
}

TEST(FramePairing, MemoryIsBoundedOverALongScanAndACreepingCameraGathersItsBaseline) {
  PairingOptions creeping = options();
  creeping.settle_time = 0.0;
  FramePairing pairing(creeping);
  const auto lookup = [](const std::string&, std::int64_t stamp_ns) {
    PoseAnswer answer;
    answer.state = PoseAnswer::State::kKnown;
    answer.T_fixed_camera.translation().x() = 0.004 * static_cast<double>(stamp_ns / kMillisecond);
    return answer;
  };
  int sets = 0;
  for (int t = 0; t < 1000; ++t) {
    pairing.add(frameAt(t), 0);
    if (const auto set = pairing.poll(lookup, 0)) {
      ++sets;
      const double baseline = set->displaced[0].T_ref_disp.translation().norm();
      EXPECT_GE(baseline, 0.05);
      EXPECT_LE(baseline, 0.05 + 2 * 0.028 + 1e-9);
    }
    EXPECT_LE(pairing.held(), 9u);
  }
  EXPECT_GE(sets, 980);
}

TEST(FramePairing, TimeJumpingBackStartsAnewAndEveryLapGivesTheSameSets) {
  FramePairing pairing(options());
  const Stage stage{{0.0, 0.1, 0.2}};
  std::vector<std::vector<std::int64_t>> laps;
  for (int lap = 0; lap < 3; ++lap) {
    laps.emplace_back();
    for (int t = 100; t < 2800; t += 100) {
      pairing.add(frameAt(t), t * kMillisecond);
      if (const auto set = pairing.poll(stage, t * kMillisecond)) {
        laps.back().push_back(set->reference.stamp_ns);
        laps.back().push_back(set->displaced[0].frame.stamp_ns);
      }
    }
  }
  EXPECT_EQ(laps[0].size(), 28u);
  EXPECT_EQ(laps[1], laps[0]);
  EXPECT_EQ(laps[2], laps[0]);
  EXPECT_EQ(pairing.counts().at("resets"), 2u);
}

TEST(FramePairing, SaysWhyThereIsNoPair) {
  {
    FramePairing pairing(options());
    const Stage still{{0.0}};
    pairing.add(frameAt(500), 0);
    pairing.poll(still, 0);
    EXPECT_THAT(pairing.reason(), HasSubstr("one position only"));
  }
  {
    FramePairing pairing(options());
    const Stage far{{0.0, 2.0}};
    pairing.add(frameAt(500), 0);
    pairing.add(frameAt(1500), 0);
    EXPECT_FALSE(pairing.poll(far, 0));
    EXPECT_THAT(pairing.reason(), HasSubstr("the baseline is 2 m, outside 0.05 m to 0.5 m"));
  }
  {
    PairingOptions young = options();
    young.max_age = 0.5;
    FramePairing pairing(young);
    const Stage stage{{0.0, 0.1}};
    pairing.add(frameAt(500), 0);
    pairing.add(frameAt(1500), 0);
    EXPECT_FALSE(pairing.poll(stage, 0));
    EXPECT_THAT(pairing.reason(), HasSubstr("older than max_age"));
  }
  {
    FramePairing pairing(options(2));
    const Stage stage{{0.0, 0.1}};
    pairing.add(frameAt(500), 0);
    pairing.add(frameAt(1500), 0);
    EXPECT_FALSE(pairing.poll(stage, 0));
    EXPECT_THAT(pairing.reason(), HasSubstr("1 of 2 displaced positions"));
  }
  {
    FramePairing pairing(options());
    const auto turning = [](const std::string&, std::int64_t stamp_ns) {
      PoseAnswer answer;
      answer.state = PoseAnswer::State::kKnown;
      if (stamp_ns > 1000 * kMillisecond) {
        answer.T_fixed_camera.translation().x() = 0.1;
        answer.T_fixed_camera.rotate(Eigen::AngleAxisd(1.0, Eigen::Vector3d::UnitZ()));
      }
      return answer;
    };
    pairing.add(frameAt(500), 0);
    pairing.add(frameAt(1500), 0);
    EXPECT_FALSE(pairing.poll(turning, 0));
    EXPECT_THAT(pairing.reason(), HasSubstr("turned by more than"));
  }
}

TEST(FramePairing, ANonFinitePoseIsRefused) {
  FramePairing pairing(options());
  const auto nan = [](const std::string&, std::int64_t) {
    PoseAnswer answer;
    answer.state = PoseAnswer::State::kKnown;
    answer.T_fixed_camera.translation().x() = std::numeric_limits<double>::quiet_NaN();
    return answer;
  };
  pairing.add(frameAt(500), 0);
  EXPECT_FALSE(pairing.poll(nan, 0));
  EXPECT_THAT(pairing.reason(), HasSubstr("not finite"));
  EXPECT_EQ(pairing.counts().at("no pose"), 1u);
}

TEST(FramePairing, AnotherFrameIdStartsAnew) {
  FramePairing pairing(options());
  const Stage stage{{0.0, 0.1}};
  pairing.add(frameAt(500), 0);
  pairing.poll(stage, 0);
  PairingFrame other = frameAt(1500);
  other.frame_id = "other";
  pairing.add(other, 0);
  EXPECT_FALSE(pairing.poll(stage, 0));
  EXPECT_EQ(pairing.counts().at("resets"), 1u);
}

TEST(FramePairing, ALeapThatNoStageMakesIsSomebodyElsesTf) {
  FramePairing pairing(options());
  // 10 cm within 40 ms, there and back.
  const auto torn = [](const std::string&, std::int64_t stamp_ns) {
    PoseAnswer answer;
    answer.state = PoseAnswer::State::kKnown;
    answer.T_fixed_camera.translation().x() = stamp_ns / (40 * kMillisecond) % 2 == 0 ? 0.0 : 0.1;
    return answer;
  };
  for (const int t : {500, 600}) {
    pairing.add(frameAt(t), 0);
    EXPECT_FALSE(pairing.poll(torn, 0));
  }
  EXPECT_EQ(pairing.leaps(), 2u);
  EXPECT_FALSE(pairing.moving());
  EXPECT_THAT(pairing.reason(), HasSubstr("tf jumps"));
  // A stage is slower: half a metre a second.
  const Stage stage{{0.0, 0.1}};
  pairing.add(frameAt(900), 0);
  EXPECT_FALSE(pairing.poll(stage, 0));
  EXPECT_EQ(pairing.leaps(), 2u);
  EXPECT_TRUE(pairing.moving());
}

TEST(FramePairing, OnlyTheNewestOfSeveralSetsComesOut) {
  FramePairing pairing(options());
  const Stage stage{{0.0, 0.1}};
  for (const int t : {500, 1200, 1400, 1600}) pairing.add(frameAt(t), 0);
  const auto set = pairing.poll(stage, 0);
  ASSERT_TRUE(set);
  EXPECT_EQ(set->reference.stamp_ns, 1600 * kMillisecond);
  EXPECT_EQ(pairing.counts().at("superseded"), 2u);
  EXPECT_FALSE(pairing.poll(stage, 0));
}

TEST(FramePairing, RefusesContradictoryOptions) {
  PairingOptions none = options();
  none.min_baseline = 0.0;
  EXPECT_THROW(FramePairing{none}, Error);
  PairingOptions crossed = options();
  crossed.max_baseline = 0.01;
  EXPECT_THROW(FramePairing{crossed}, Error);
  PairingOptions nan = options();
  nan.max_baseline = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(FramePairing{nan}, Error);
  EXPECT_THROW(FramePairing{options(0)}, Error);
  EXPECT_THROW(FramePairing{options(99)}, Error);
}

}  // namespace
}  // namespace omnister
