// SPDX-License-Identifier: Apache-2.0
#include <fcntl.h>
#include <gmock/gmock.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cmath>
#include <functional>
#include <random>
#include <thread>

#include "device/stage/serial_port.h"
#include "full_tests.h"
#include "omnister/device/camera.h"
#include "omnister/sim/serial_devices.h"
#include "temporary_folder.h"

namespace omnister::device {
namespace {

using sim::GrblSimulator;
using sim::SimulatedStage;
using sim::ZaberSimulator;
using testing::HasSubstr;
using testing::Not;

/// What a call that must fail says.
std::string refusal(const std::function<void()>& call) {
  try {
    call();
  } catch (const Error& e) {
    return e.what();
  }
  return "";
}

sim::SimulatedStageOptions quickStage() {
  sim::SimulatedStageOptions options;
  options.travel_m = 0.3;
  options.max_speed_mps = 1.0;
  options.acceleration_mps2 = 10.0;
  options.homing_speed_mps = 0.5;
  options.start_m = 0.05;
  return options;
}

/// Reads until the stage rests (or the condition holds); the limit is no measure of speed.
StageReading settle(Stage& stage, const std::function<bool(const StageReading&)>& condition = {}) {
  const auto end = Steady::now() + std::chrono::seconds(30);
  StageReading reading = stage.read();
  while (Steady::now() < end) {
    if (condition ? condition(reading) : !reading.moving) return reading;
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
    reading = stage.read();
  }
  ADD_FAILURE() << "the stage does not come to rest";
  return reading;
}

class ZaberStageTest : public testing::Test {
 protected:
  ZaberStageTest() {
    options_.link = folder_.path() / "ttyZaber";
    settings_.unit_m = options_.unit_m;
  }
  void plug() {
    truth_ = std::make_shared<SimulatedStage>(mechanics_);
    device_ = std::make_unique<ZaberSimulator>(options_, truth_, mechanics_);
  }
  std::unique_ptr<Stage> open() { return openStage("zaber:" + options_.link.string(), settings_); }
  double truth() const { return truth_->truePosition(now()); }
  /// The highest speed of the carriage since then [m/s].
  double fastestSince(Stamp began) const {
    constexpr std::chrono::milliseconds kStep(2);
    double fastest = 0.0;
    for (Stamp time = began; time < now(); time += kStep) {
      const double moved = truth_->truePosition(time + kStep) - truth_->truePosition(time);
      fastest = std::max(fastest, std::abs(moved) / 0.002);
    }
    return fastest;
  }

  test::TemporaryFolder folder_;
  sim::SimulatedStageOptions mechanics_ = quickStage();
  sim::ZaberOptions options_;
  StageSettings settings_;
  std::shared_ptr<SimulatedStage> truth_;
  std::unique_ptr<ZaberSimulator> device_;
};

TEST_F(ZaberStageTest, MovesInMetresAndHomesOnRequestOnly) {
  options_.alerts = true;
  plug();
  const std::unique_ptr<Stage> stage = open();
  EXPECT_EQ(stage->identity().vendor, "Zaber");
  EXPECT_EQ(stage->identity().serial, "40001");
  EXPECT_THAT(stage->identity().model, HasSubstr("firmware 7.34"));
  StageReading reading = stage->read();
  EXPECT_FALSE(reading.homed || reading.moving);
  EXPECT_EQ(truth(), mechanics_.start_m);
  // Without a reference: from here, by so much.
  stage->moveTo(reading.position_m + 0.02, 0.5);
  reading = settle(*stage);
  EXPECT_NEAR(truth(), mechanics_.start_m + 0.02, 1e-6);
  EXPECT_FALSE(reading.homed);
  const std::uint64_t before = reading.reference;
  stage->home();
  EXPECT_TRUE(stage->read().moving);
  reading = settle(*stage);
  EXPECT_TRUE(reading.homed);
  EXPECT_NE(reading.reference, before);
  EXPECT_NEAR(reading.position_m, 0.0, 1e-6);
  stage->moveTo(0.2, 0.5);
  reading = settle(*stage);
  EXPECT_NEAR(reading.position_m, 0.2, 1e-6);
  EXPECT_NEAR(truth(), 0.2, 1e-6);
  EXPECT_TRUE(stage->takeRemarks().empty());
}

TEST_F(ZaberStageTest, ReadingsInMotionCarryPositionVelocityAndTheirTime) {
  mechanics_.homed = true;
  mechanics_.start_m = 0.0;
  plug();
  const std::unique_ptr<Stage> stage = open();
  stage->moveTo(0.3, 0.2);
  int checked = 0;
  while (true) {
    const double before = truth();
    const StageReading reading = stage->read();
    if (!reading.moving) break;
    EXPECT_LE(reading.position_m, truth() + 1e-6);
    EXPECT_GE(reading.position_m, before - 1e-6);
    if (reading.position_m > 0.05 && reading.position_m < 0.25) {
      EXPECT_GT(reading.velocity_mps, 0.0);
      ++checked;
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
  }
  EXPECT_GE(checked, 3);
}

TEST_F(ZaberStageTest, ANegativeUnitReversesTheDirection) {
  mechanics_.homed = true;
  settings_.unit_m = -settings_.unit_m;
  plug();
  const std::unique_ptr<Stage> stage = open();
  stage->moveTo(-0.1, 0.5);
  EXPECT_NEAR(settle(*stage).position_m, -0.1, 1e-6);
  EXPECT_NEAR(truth(), 0.1, 1e-6);
  EXPECT_THAT(refusal([&] { stage->moveTo(0.1, 0.5); }), HasSubstr("limits"));
}

TEST_F(ZaberStageTest, StopsAndTakesANewTargetOnTheWay) {
  mechanics_.homed = true;
  mechanics_.start_m = 0.0;
  plug();
  const std::unique_ptr<Stage> stage = open();
  stage->moveTo(0.3, 0.1);
  settle(*stage, [](const StageReading& reading) { return reading.position_m > 0.01; });
  stage->moveTo(0.005, 0.1);
  EXPECT_NEAR(settle(*stage).position_m, 0.005, 1e-6);
  stage->moveTo(0.3, 0.05);
  settle(*stage, [](const StageReading& reading) { return reading.moving; });
  stage->stop();
  EXPECT_LT(settle(*stage).position_m, 0.29);
  EXPECT_TRUE(stage->read().homed);
}

TEST_F(ZaberStageTest, SaysWhyTheDeviceRefused) {
  mechanics_.homed = true;
  plug();
  const std::unique_ptr<Stage> stage = open();
  EXPECT_THAT(refusal([&] { stage->moveTo(0.31, 0.1); }), HasSubstr("limits (0 to 0.3"));
  EXPECT_THAT(refusal([&] { stage->moveTo(std::nan(""), 0.1); }), HasSubstr("finite"));
  device_->rejectNext("PARKED");
  EXPECT_THAT(refusal([&] { stage->moveTo(0.1, 0.1); }), HasSubstr("parked (PARKED)"));
  // What passes is waited for.
  device_->rejectNext("AGAIN");
  stage->moveTo(0.1, 1.0);
  EXPECT_NEAR(settle(*stage).position_m, 0.1, 1e-6);
}

TEST_F(ZaberStageTest, AStallIsAFaultByNameAndCostsTheReference) {
  mechanics_.homed = true;
  plug();
  const std::unique_ptr<Stage> stage = open();
  stage->moveTo(0.3, 0.05);
  settle(*stage, [](const StageReading& reading) { return reading.moving; });
  truth_->stall();
  StageReading reading = settle(*stage);
  EXPECT_EQ(reading.fault, "stalled (FS)");
  EXPECT_FALSE(reading.homed);
  stage->recover();
  reading = stage->read();
  EXPECT_EQ(reading.fault, "");
  EXPECT_FALSE(reading.homed);
  stage->home();
  reading = settle(*stage);
  EXPECT_TRUE(reading.homed);
  EXPECT_NEAR(truth(), 0.0, 1e-6);
}

TEST_F(ZaberStageTest, APowerCycleLosesTheReference) {
  mechanics_.homed = true;
  plug();
  const std::unique_ptr<Stage> stage = open();
  const StageReading before = stage->read();
  EXPECT_TRUE(before.homed);
  device_->powerCycle();
  const StageReading after = stage->read();
  EXPECT_FALSE(after.homed);
  EXPECT_NE(after.reference, before.reference);
}

TEST_F(ZaberStageTest, OldFirmwareTakesSpeedAsASettingThatIsSetBack) {
  mechanics_.homed = true;
  options_.speed_in_move = false;
  plug();
  {
    const std::unique_ptr<Stage> stage = open();
    const Stamp began = now();
    stage->moveTo(0.06, 0.02);
    EXPECT_NEAR(settle(*stage).position_m, 0.06, 1e-6);
    EXPECT_NEAR(fastestSince(began), 0.02, 1e-3);
    EXPECT_TRUE(stage->takeRemarks().empty());
  }
  const std::unique_ptr<Stage> stage = open();
  const Stamp began = now();
  stage->moveTo(0.26, 1.0);
  settle(*stage);
  EXPECT_GT(fastestSince(began), 0.9) << "its own limit was not set back";
}

TEST_F(ZaberStageTest, WithoutChecksumsPositionsAreReadTwice) {
  mechanics_.homed = true;
  options_.has_checksums = false;
  plug();
  const std::unique_ptr<Stage> stage = open();
  EXPECT_THAT(stage->takeRemarks(), testing::ElementsAre(HasSubstr("no checksums")));
  device_->setFaults({0.1, 0.0, 0.0});
  int read = 0;
  for (int i = 0; i < 40; ++i) {
    try {
      EXPECT_NEAR(stage->read().position_m, mechanics_.start_m, 1e-6);
      ++read;
    } catch (const StageError&) {
      // No reading is better than a wrong one.
    }
  }
  EXPECT_GE(read, 20);
}

class GrblStageTest : public testing::Test {
 protected:
  GrblStageTest() { options_.link = folder_.path() / "ttyGrbl"; }
  void plug() {
    truth_ = std::make_shared<SimulatedStage>(mechanics_);
    device_ = std::make_unique<GrblSimulator>(options_, truth_, mechanics_);
  }
  std::unique_ptr<Stage> open() { return openStage("grbl:" + options_.link.string(), {}); }
  std::unique_ptr<Stage> openHomed() {
    std::unique_ptr<Stage> stage = open();
    stage->home();
    EXPECT_TRUE(settle(*stage).homed);
    return stage;
  }
  double truth() const { return truth_->truePosition(now()); }

  test::TemporaryFolder folder_;
  sim::SimulatedStageOptions mechanics_ = quickStage();
  sim::GrblOptions options_;
  std::shared_ptr<SimulatedStage> truth_;
  std::unique_ptr<GrblSimulator> device_;
};

TEST_F(GrblStageTest, HomesOnRequestOnlyAndMovesInMetres) {
  plug();
  const std::unique_ptr<Stage> stage = open();
  EXPECT_EQ(stage->identity().model, "Grbl 1.1h.20190825");
  StageReading reading = stage->read();
  EXPECT_FALSE(reading.homed || reading.moving);
  EXPECT_EQ(reading.fault, "") << "a lock is no fault: homing opens it";
  EXPECT_THAT(refusal([&] { stage->moveTo(0.01, 0.1); }), HasSubstr("home it first (error:9)"));
  EXPECT_EQ(truth(), mechanics_.start_m);
  stage->home();
  EXPECT_TRUE(stage->read().moving);
  reading = settle(*stage);
  EXPECT_TRUE(reading.homed);
  EXPECT_NEAR(truth(), 0.0, 1e-6);
  stage->moveTo(0.2, 0.5);
  EXPECT_TRUE(stage->read().moving);
  reading = settle(*stage);
  EXPECT_NEAR(reading.position_m, 0.2, 1e-6);
  EXPECT_NEAR(truth(), 0.2, 1e-6);
  EXPECT_EQ(device_->heard("$X"), 0);
}

TEST_F(GrblStageTest, WithoutHomingItMovesFromWhereItIs) {
  options_.homing_enabled = false;
  plug();
  const std::unique_ptr<Stage> stage = open();
  EXPECT_THAT(refusal([&] { stage->home(); }), HasSubstr("error:5"));
  const StageReading reading = stage->read();
  stage->moveTo(reading.position_m + 0.02, 0.5);
  EXPECT_FALSE(settle(*stage).homed);
  EXPECT_NEAR(truth(), mechanics_.start_m + 0.02, 1e-6);
}

TEST_F(GrblStageTest, AsksNoMoreThanFiveTimesASecond) {
  plug();
  const std::unique_ptr<Stage> stage = openHomed();
  const int asked = device_->asked();
  const auto began = Steady::now();
  while (Steady::now() - began < std::chrono::milliseconds(1500)) stage->read();
  const double seconds = std::chrono::duration<double>(Steady::now() - began).count();
  EXPECT_LE(device_->asked() - asked, 5.0 * seconds + 1.0);
  EXPECT_GE(device_->asked() - asked, 1);
}

TEST_F(GrblStageTest, StopsAndTakesANewTargetOnTheWay) {
  mechanics_.homing_speed_mps = 0.2;
  plug();
  const std::unique_ptr<Stage> stage = openHomed();
  stage->moveTo(0.3, 0.1);
  settle(*stage, [](const StageReading& reading) { return reading.position_m > 0.01; });
  stage->moveTo(0.005, 0.1);
  EXPECT_NEAR(settle(*stage).position_m, 0.005, 1e-6);
  stage->moveTo(0.3, 0.05);
  settle(*stage, [](const StageReading& reading) { return reading.velocity_mps > 0.0; });
  stage->stop();
  StageReading reading = settle(*stage);
  EXPECT_LT(reading.position_m, 0.29);
  EXPECT_NEAR(reading.position_m, truth(), 1e-6);
  EXPECT_TRUE(reading.homed);
  EXPECT_EQ(reading.fault, "");
  // Homing ends by a reset, which is no fault of anybody's.
  stage->moveTo(0.2, 1.0);
  settle(*stage);
  stage->home();
  stage->stop();
  reading = settle(*stage);
  EXPECT_FALSE(reading.homed);
  EXPECT_EQ(reading.fault, "");
}

TEST_F(GrblStageTest, SoftLimitsAreTold) {
  plug();
  const std::unique_ptr<Stage> stage = openHomed();
  EXPECT_THAT(refusal([&] { stage->moveTo(0.31, 0.1); }), HasSubstr("soft limits (error:15)"));
  EXPECT_TRUE(stage->read().homed);
}

TEST_F(GrblStageTest, AHardLimitIsAnAlarmByNameUntilRecovered) {
  options_.soft_limits = false;
  plug();
  const std::unique_ptr<Stage> stage = openHomed();
  stage->moveTo(0.31, 0.5);
  StageReading reading = settle(*stage, [](const StageReading& now) { return !now.fault.empty(); });
  EXPECT_EQ(reading.fault, "hard limit (ALARM:1)");
  EXPECT_FALSE(reading.homed || reading.moving);
  EXPECT_THAT(refusal([&] { stage->moveTo(0.1, 0.5); }), HasSubstr("hard limit"));
  stage->recover();
  reading = stage->read();
  EXPECT_EQ(reading.fault, "");
  EXPECT_FALSE(reading.homed);
  EXPECT_EQ(device_->heard("$X"), 0);
  stage->home();
  EXPECT_TRUE(settle(*stage).homed);
}

TEST_F(GrblStageTest, AResetLosesTheReference) {
  plug();
  const std::unique_ptr<Stage> stage = openHomed();
  stage->moveTo(0.1, 1.0);
  const StageReading before = settle(*stage);
  device_->powerCycle();
  const StageReading after = settle(*stage, [](const StageReading& now) { return !now.homed; });
  EXPECT_NE(after.reference, before.reference);
  EXPECT_FALSE(after.moving);
}

TEST_F(GrblStageTest, AnUnheardEndOfHomingIsNoReference) {
  plug();
  const std::unique_ptr<Stage> stage = openHomed();
  stage->moveTo(0.1, 1.0);
  settle(*stage);
  stage->home();
  device_->setFaults({0.0, 1.0, 0.0});
  const auto end = Steady::now() + std::chrono::seconds(30);
  while (truth_->read().moving && Steady::now() < end) {
    EXPECT_TRUE(stage->read().moving);
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
  }
  std::this_thread::sleep_for(std::chrono::milliseconds(100));
  device_->setFaults({});
  EXPECT_FALSE(settle(*stage).homed);
  stage->home();
  EXPECT_TRUE(settle(*stage).homed);
}

TEST_F(GrblStageTest, ReportsInInchesAndOfWorkPositionsAreMachinePositionsInMetres) {
  options_.inches = true;
  options_.work_positions = true;
  plug();
  const std::unique_ptr<Stage> stage = openHomed();
  stage->moveTo(0.2, 1.0);
  EXPECT_NEAR(settle(*stage).position_m, 0.2, 5e-6);
  EXPECT_NEAR(truth(), 0.2, 5e-6);
}

TEST_F(GrblStageTest, APullOutAndAnUnplugAreALostLink) {
  plug();
  const std::unique_ptr<Stage> stage = openHomed();
  device_->unplug();
  EXPECT_THAT(refusal([&] { settle(*stage, [](const StageReading&) { return false; }); }),
              HasSubstr("gone"));
  EXPECT_THAT(refusal([&] { open(); }), HasSubstr("there is no port"));
  device_->plugIn();
  EXPECT_FALSE(open()->read().homed) << "who knows what happened meanwhile";
}

TEST_F(ZaberStageTest, AFrozenOrVanishedDeviceIsALostLinkWithinTwoSeconds) {
  mechanics_.homed = true;
  plug();
  std::unique_ptr<Stage> stage = open();
  device_->freeze(true);
  EXPECT_THAT(refusal([&] { stage->read(); }), HasSubstr("does not answer"));
  device_->freeze(false);
  EXPECT_TRUE(stage->read().homed);
  device_->unplug();
  EXPECT_THAT(refusal([&] { stage->read(); }), HasSubstr("gone"));
  stage.reset();
  device_->plugIn();
  EXPECT_TRUE(open()->read().homed);
}

TEST_F(ZaberStageTest, SaysWhatIsWrongWithAPort) {
  const std::string link = options_.link.string();
  EXPECT_THAT(refusal([&] { open(); }), HasSubstr("there is no port " + link));
  const std::string file = (folder_.path() / "file").string();
  ::close(::open(file.c_str(), O_CREAT | O_RDWR, 0600));
  EXPECT_THAT(refusal([&] { openStage("zaber:" + file, settings_); }),
              HasSubstr("is not a serial port"));
  plug();
  const std::unique_ptr<Stage> stage = open();
  EXPECT_THAT(refusal([&] { open(); }), HasSubstr("in use by another program"));
  settings_.unit_m = 0.0;
  EXPECT_THAT(refusal([&] { open(); }), HasSubstr("unit_m"));
  settings_.unit_m = 1e-6;
  settings_.device_number = 100;
  EXPECT_THAT(refusal([&] { open(); }), HasSubstr("device_number"));
  int refused = 0;
  for (const char* text : {"", "zaber", "zaber:", "newport:/dev/ttyS0", ":/dev/ttyS0"}) {
    EXPECT_THAT(refusal([&] { openStage(text, {1e-6}); }), HasSubstr("zaber:PORT or grbl:PORT"));
    ++refused;
  }
  EXPECT_EQ(refused, 5);
  EXPECT_THAT(describeOpenError("/dev/null", EACCES), HasSubstr("must be in the group \"root\""));
}

TEST(SerialPort, NamesTheGroupThatMayUseThePort) {
  if (geteuid() != 0) GTEST_SKIP() << "needs to be another user";
  const test::TemporaryFolder folder;
  const std::string path = (folder.path() / "tty").string();
  ::close(::open(path.c_str(), O_CREAT | O_RDWR, 0600));
  chmod(folder.path().c_str(), 0755);
  ASSERT_EQ(seteuid(65534), 0);
  const std::string message = refusal([&] { SerialPort(path, 9600); });
  ASSERT_EQ(seteuid(0), 0);
  EXPECT_THAT(message, HasSubstr("no permission for " + path));
  EXPECT_THAT(message, HasSubstr("the group \"root\""));
}

TEST_F(ZaberStageTest, SaysWhatAnsweredInsteadOfAStage) {
  sim::GrblOptions other;
  other.link = options_.link;
  GrblSimulator grbl(other, std::make_shared<SimulatedStage>(mechanics_), mechanics_);
  EXPECT_THAT(refusal([&] { open(); }), HasSubstr("answered \"error:"));
}

TEST_F(GrblStageTest, SaysWhatAnsweredInsteadOfAStage) {
  sim::SerialCable chatter(
      options_.link, [&](std::string_view) { chatter.send("V2.3 ready\r\n"); }, [] {});
  EXPECT_THAT(refusal([&] { open(); }), HasSubstr("\"V2.3 ready\", which is not GRBL"));
}

// ---------------------------------------------------------------------------------------------------
// Whatever goes wrong on the wire or with the stage: a position that is called referenced and free
// of faults is where the carriage truly was while it was read.

int movesToMake() { return test::fullTests() ? 1000 : 12; }

struct Tally {
  int arrived = 0, refused = 0, lost = 0, faults = 0, homings = 0, checked = 0;
};

std::ostream& operator<<(std::ostream& out, const Tally& t) {
  return out << t.arrived << " arrived, " << t.refused << " refused, " << t.lost << " links lost, "
             << t.faults << " faults, " << t.homings << " homings, " << t.checked
             << " readings checked";
}

class Ordeal {
 public:
  /// @param in_motion tolerance for readings of a stage that moves [m]
  Ordeal(std::function<std::unique_ptr<Stage>()> open, sim::SerialStageDevice& device,
         double tolerance, double in_motion)
      : open_(std::move(open)), device_(device), tolerance_(tolerance), in_motion_(in_motion) {}

  Tally run(int moves, unsigned seed, bool can_stall) {
    std::mt19937 random(seed);
    const auto uniform = [&](double low, double high) {
      return std::uniform_real_distribution<double>(low, high)(random);
    };
    for (int i = 0; i < moves && !testing::Test::HasFailure(); ++i) {
      const double target = uniform(0.0, 0.3);
      const int event = static_cast<int>(random() % 10);
      device_.setFaults({event < 5 ? 0.0 : 0.05, event < 5 ? 0.0 : 0.01, 0.05});
      try {
        if (!stage_) stage_ = open_();
        makeReady();
        stage_->moveTo(target, uniform(0.2, 1.0));
        const int wait = static_cast<int>(random() % 8);
        for (int k = 0; k < wait; ++k) look();
        if (event == 0) device_.unplug();
        if (event == 1 && can_stall) device_.stage().stall();
        if (event == 2) device_.powerCycle();
        if (event == 3) stage_->stop();
        const StageReading end = rest();
        if (end.homed && end.fault.empty() && std::abs(end.position_m - target) < 1e-4) {
          ++tally_.arrived;
        }
      } catch (const StageError& e) {
        lost(e.what());
        if (event == 0) {
          device_.plugIn();
        }
      }
    }
    return tally_;
  }

 private:
  void lost(const std::string& problem) {
    const bool gone =
        problem.find("gone") != std::string::npos || problem.find("answer") != std::string::npos ||
        problem.find("report") != std::string::npos || problem.find("no port") != std::string::npos;
    ++(gone ? tally_.lost : tally_.refused);
    if (gone) stage_.reset();
  }

  StageReading look() {
    const Stamp before = now();
    const StageReading reading = stage_->read();
    const Stamp after = now();
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
    // An older reading was checked when it was new.
    if (!reading.homed || !reading.fault.empty() || reading.stamp < before) return reading;
    double low = 1e9, high = -1e9;
    for (int k = 0; k <= 50; ++k) {
      const double truth = device_.stage().truePosition(before + k * (after - before) / 50);
      low = std::min(low, truth);
      high = std::max(high, truth);
    }
    const double tolerance = reading.moving ? in_motion_ : tolerance_;
    EXPECT_GE(reading.position_m, low - tolerance);
    EXPECT_LE(reading.position_m, high + tolerance);
    ++tally_.checked;
    return reading;
  }

  StageReading rest() {
    const auto end = Steady::now() + std::chrono::seconds(30);
    StageReading reading = look();
    while (reading.moving && Steady::now() < end) reading = look();
    EXPECT_FALSE(reading.moving) << "it never comes to rest";
    return reading;
  }

  void makeReady() {
    StageReading reading = rest();
    if (!reading.fault.empty()) {
      ++tally_.faults;
      stage_->recover();
      reading = look();
    }
    if (reading.homed) return;
    ++tally_.homings;
    stage_->home();
    rest();
  }

  const std::function<std::unique_ptr<Stage>()> open_;
  sim::SerialStageDevice& device_;
  const double tolerance_, in_motion_;
  std::unique_ptr<Stage> stage_;
  Tally tally_;
};

// How many lines are lost or garbled depends on how often this machine reads: shares can only be
// expected of many moves.
constexpr int kManyMoves = 200;

void expectAllKinds(const Tally& tally, int moves, double arrived) {
  EXPECT_GE(tally.checked, 1);
  EXPECT_GE(tally.homings, 1);
  if (moves < kManyMoves) return;
  EXPECT_GE(tally.arrived, moves * arrived);
  EXPECT_GE(tally.checked, moves);
}

TEST_F(ZaberStageTest, RandomMovesUnderFaultsAreNeverWrongSilently) {
  mechanics_.acceleration_mps2 = 20.0;
  options_.alerts = true;
  plug();
  const int moves = movesToMake();
  const Tally tally = Ordeal([this] { return open(); }, *device_, 1e-6, 1e-6).run(moves, 7, true);
  std::cout << tally << std::endl;
  expectAllKinds(tally, moves, 1.0 / 3.0);
  if (moves >= kManyMoves) {
    EXPECT_GE(tally.lost, 1);
    EXPECT_GE(tally.faults, 1);
  }
}

TEST_F(GrblStageTest, RandomMovesUnderFaultsAreNeverWrongSilently) {
  mechanics_.acceleration_mps2 = 20.0;
  plug();
  const int moves = movesToMake() / 2;
  // Reports have no checksum: in motion a garbled one may be off by what the stage travels in 10
  // ms.
  const double in_motion = 0.01 * mechanics_.max_speed_mps;
  const Tally tally =
      Ordeal([this] { return open(); }, *device_, 1e-6, in_motion).run(moves, 11, false);
  std::cout << tally << std::endl;
  expectAllKinds(tally, moves, 1.0 / 4.0);
}

}  // namespace
}  // namespace omnister::device
