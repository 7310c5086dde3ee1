// SPDX-License-Identifier: Apache-2.0
#include "omnister/sim/simulated_stage.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

namespace omnister::sim {
namespace {

using std::chrono::milliseconds;
using std::chrono::nanoseconds;

const Stamp kStart{nanoseconds(1000000000000)};

Stamp at(double s) { return kStart + nanoseconds(std::llround(s * 1e9)); }

struct ManualClock {
  double time = 0.0;
  Clock clock() {
    return [this] { return at(time); };
  }
};

TEST(MotionProfile, ReachesTheTargetAtRestWithinTheLimits) {
  std::mt19937 random(7);
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  int checked = 0;
  for (int i = 0; i < 500; ++i) {
    const double x0 = uniform(random), v0 = 0.6 * uniform(random), target = uniform(random);
    const double speed = 0.05 + 0.3 * std::abs(uniform(random)),
                 a = 0.1 + std::abs(uniform(random));
    const MotionProfile profile(kStart, x0, v0, target, speed, a);
    ASSERT_NEAR(profile.position(profile.end() + milliseconds(1)), target, 1e-7);
    ASSERT_EQ(profile.velocity(profile.end() + milliseconds(1)), 0.0);
    ASSERT_NEAR(profile.velocity(profile.end()), 0.0, 1e-7);
    ASSERT_NEAR(profile.position(kStart), x0, 1e-12);
    ASSERT_NEAR(profile.velocity(kStart), v0, 1e-12);
    // Position integrates velocity; velocity changes by at most the acceleration.
    const double duration = std::chrono::duration<double>(profile.end() - kStart).count();
    const double step = duration / 400.0;
    double position = x0;
    for (int k = 0; k < 400; ++k) {
      const double va = profile.velocity(at(k * step)), vb = profile.velocity(at((k + 1) * step));
      ASSERT_LE(std::abs(vb - va), a * step * (1.0 + 1e-6) + 1e-8);
      ASSERT_LE(std::abs(vb), std::max(std::abs(v0), speed) + 1e-8);
      position += profile.position(at((k + 1) * step)) - profile.position(at(k * step));
      const double mean = 0.5 * (va + vb) * step;
      ASSERT_NEAR(profile.position(at((k + 1) * step)) - profile.position(at(k * step)), mean,
                  0.5 * a * step * step + 1e-8);
    }
    ASSERT_NEAR(position, target, 1e-7);
    ++checked;
  }
  EXPECT_EQ(checked, 500);
}

TEST(MotionProfile, TakesTheTimeOfTheClosedForm) {
  // Long: speed / acceleration twice, and the rest at full speed.
  const MotionProfile trapezoid(kStart, 0.0, 0.0, 0.3, 0.1, 0.5);
  EXPECT_NEAR(std::chrono::duration<double>(trapezoid.end() - kStart).count(),
              0.2 + 0.2 + (0.3 - 0.02) / 0.1, 1e-8);
  // Short: a triangle of 2 sqrt(d / a).
  const MotionProfile triangle(kStart, 0.0, 0.0, -0.01, 0.1, 0.5);
  EXPECT_NEAR(std::chrono::duration<double>(triangle.end() - kStart).count(),
              2.0 * std::sqrt(0.01 / 0.5), 1e-8);
}

TEST(SimulatedStage, StandsStillUntilToldToMove) {
  ManualClock manual;
  SimulatedStage stage({}, manual.clock());
  const device::StageReading before = stage.read();
  EXPECT_FALSE(before.homed);
  EXPECT_FALSE(before.moving);
  EXPECT_EQ(before.position_m, 0.0);  // its counter knows no reference
  manual.time = 100.0;
  EXPECT_EQ(stage.read().position_m, 0.0);
  EXPECT_EQ(stage.truePosition(at(100.0)), 0.02);
}

TEST(SimulatedStage, HomesThenMovesAndStops) {
  ManualClock manual;
  SimulatedStage stage({}, manual.clock());
  stage.home();
  EXPECT_TRUE(stage.read().moving);
  EXPECT_THROW(stage.moveTo(0.1, 0.1), device::StageError);
  manual.time = 0.2;
  EXPECT_FALSE(stage.read().homed);
  manual.time = 5.0;
  device::StageReading reading = stage.read();
  EXPECT_TRUE(reading.homed);
  EXPECT_FALSE(reading.moving);
  EXPECT_NEAR(reading.position_m, 0.0, 1e-9);

  stage.moveTo(0.2, 0.1);
  manual.time = 6.0;
  reading = stage.read();
  EXPECT_TRUE(reading.moving);
  EXPECT_NEAR(reading.velocity_mps, 0.1, 1e-9);
  EXPECT_NEAR(reading.position_m, 0.1 * (1.0 - 0.1), 1e-9);
  stage.stop();
  manual.time = 7.0;
  reading = stage.read();
  EXPECT_FALSE(reading.moving);
  EXPECT_NEAR(reading.position_m, 0.09 + 0.1 * 0.1 / (2 * 0.5), 1e-9);
  EXPECT_EQ(reading.velocity_mps, 0.0);
  // What was is still known: the camera asks for the middle of an exposure that is over.
  EXPECT_NEAR(stage.truePosition(at(5.5)), 0.1 * (0.5 - 0.1), 1e-9);
  EXPECT_NEAR(stage.truePosition(at(5.0)), 0.0, 1e-9);
}

TEST(SimulatedStage, RefusesWhatItCannotReach) {
  ManualClock manual;
  SimulatedStageOptions options;
  options.homed = true;
  SimulatedStage stage(options, manual.clock());
  EXPECT_THROW(stage.moveTo(0.31, 0.1), device::StageError);
  EXPECT_THROW(stage.moveTo(-0.001, 0.1), device::StageError);
  EXPECT_THROW(stage.moveTo(std::nan(""), 0.1), device::StageError);
  EXPECT_THROW(stage.moveTo(0.1, 0.0), device::StageError);
  EXPECT_THROW(stage.moveTo(0.1, std::nan("")), device::StageError);
  EXPECT_FALSE(stage.read().moving);
  stage.moveTo(0.3, 0.1);
  EXPECT_TRUE(stage.read().moving);
}

TEST(SimulatedStage, UnhomedItRunsIntoItsEndAndNeedsRecovery) {
  ManualClock manual;
  SimulatedStage stage({}, manual.clock());
  stage.moveTo(-0.1, 0.1);  // only 0.02 m are left
  manual.time = 10.0;
  device::StageReading reading = stage.read();
  EXPECT_EQ(reading.fault, "limit");
  EXPECT_NEAR(reading.position_m, -0.02, 1e-9);
  EXPECT_THROW(stage.moveTo(0.0, 0.1), device::StageError);
  EXPECT_THROW(stage.home(), device::StageError);
  stage.recover();
  EXPECT_EQ(stage.read().fault, "");
  stage.moveTo(0.0, 0.1);
  manual.time = 20.0;
  EXPECT_NEAR(stage.read().position_m, 0.0, 1e-9);
}

TEST(SimulatedStage, AStallLosesTheReference) {
  ManualClock manual;
  SimulatedStageOptions options;
  options.homed = true;
  SimulatedStage stage(options, manual.clock());
  stage.moveTo(0.2, 0.1);
  manual.time = 1.0;
  stage.stall();
  const device::StageReading reading = stage.read();
  EXPECT_FALSE(reading.homed);
  EXPECT_FALSE(reading.moving);
  EXPECT_EQ(reading.fault, "stalled");
}

TEST(SimulatedStage, RefusesNonsenseOptions) {
  SimulatedStageOptions options;
  options.acceleration_mps2 = 0.0;
  EXPECT_THROW(SimulatedStage{options}, InputError);
  options = {};
  options.start_m = 0.5;
  EXPECT_THROW(SimulatedStage{options}, InputError);
  options = {};
  options.travel_m = std::nan("");
  EXPECT_THROW(SimulatedStage{options}, InputError);
}

}  // namespace
}  // namespace omnister::sim
