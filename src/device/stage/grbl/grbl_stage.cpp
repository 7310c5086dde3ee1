// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <map>
#include <set>

#include "device/stage/grbl/grbl_protocol.h"
#include "device/stage/serial_port.h"
#include "device/stage/serial_stage.h"
#include "omnister/common/numbers.h"
#include "omnister/common/stamp.h"

namespace omnister::device {
namespace {

constexpr int kDefaultBaud = 115200;
constexpr double kDefaultUnit = 0.001;
// GRBL steps its motors in the same loop that answers: no more than five reports a second.
constexpr std::chrono::milliseconds kPollPeriod(200);
// Three reports that do not come are a lost link; it must be noticed within two seconds.
constexpr std::chrono::milliseconds kStatusTimeout(500);
constexpr int kSilences = 3;
// Reports that contradict what is known are taken once two agree; among so many they do. (Where
// reports are of work positions, their offset comes with every thirtieth.)
constexpr int kDoubts = 40;
constexpr std::chrono::milliseconds kCommandTimeout(1000);
// Opening the port resets an Arduino, whose boot loader then waits a while.
constexpr std::chrono::milliseconds kBootTime(3500);
constexpr std::chrono::milliseconds kResetTime(2000);
// A refused `$H` is refused at once.
constexpr std::chrono::milliseconds kRefusalTime(100);
constexpr int kHardLimit = 1, kSoftLimit = 2, kResetWhileMoving = 3, kHomingReset = 6;
// Reports give micrometres; a motor's steps may be coarser [mm].
constexpr double kAlike = 0.0006;
constexpr double kSame = 0.02;
// Of two reports in motion, where the largest speed is not known [mm].
constexpr double kSameInMotion = 50.0;
// A report in motion that fits the jog to so much of its way and so long [s] is taken at once.
constexpr double kShareOfWay = 0.02, kTimeOfReport = 0.005;
// A jog that was accepted shows in the reports after this.
constexpr std::chrono::milliseconds kTimeToBegin(400);

constexpr int kReportsAfterHoming = 2;
constexpr char kHome[] = "$H";
constexpr char kReset = 0x18;
constexpr char kJogCancel = static_cast<char>(0x85);

class GrblStage : public SerialStage {
 public:
  GrblStage(const std::string& port, const StageSettings& settings);
  StageReading read() override;
  void home() override;
  void recover() override;
  void moveTo(double position_m, double speed_mps) override;
  void stop() override;

 private:
  struct Answer {
    bool came = false;
    int error = 0;
  };

  /// Takes what has come, and waits for more until the deadline or until `done`.
  template <typename Done>
  bool listen(Steady::time_point deadline, Done done);
  void onLine(const std::string& line);
  void onReset();
  void onAlarm(int number);
  void onAnswer(int error);
  void meet();
  void readSettings();
  /// One command at a time, each waits for its answer ("send-response").
  Answer command(const std::string& line, std::chrono::milliseconds timeout);
  void jog(const std::string& line);
  /// Asks for a report. @throws StageError when none comes
  void poll();
  void watchHoming();
  /// A report has no checksum: whether it fits where the stage was and what it was told.
  enum class Fit { kCertain, kPossible, kContradiction };
  Fit fitOf(const GrblStatus& status, double position, Stamp stamp) const;
  /// How far the stage gets in that time at most [mm].
  std::optional<double> reach(double seconds) const;
  void startHoming();
  bool jogs() const;
  void replaceJog(const std::string& line);
  void take(const GrblStatus& status, double position, Stamp stamp);
  std::optional<double> positionOf(const GrblStatus& status) const;
  void loseReference();
  bool critical() const { return alarm_ == kHardLimit || alarm_ == kSoftLimit; }
  std::string faultNow() const;

  const double unit_m_;
  const std::size_t axis_;
  SerialPort port_;
  std::map<int, double> options_;  ///< `$N=value`
  double scale_ = 1.0;             ///< of reports, to mm ($13: inches)

  std::optional<GrblStatus> report_;  ///< came last, not yet taken
  std::optional<Answer> answer_;      ///< to the command under way
  bool command_under_way_ = false;
  std::size_t resets_ = 0;
  std::string noise_;
  std::optional<double> offset_;  ///< WPos + offset = MPos [mm]

  std::string state_;
  int sub_state_ = 0;
  std::optional<double> position_;  ///< [mm]
  Stamp stamp_;
  double velocity_ = 0.0;  ///< [mm/s]
  Steady::time_point next_poll_;
  int alarm_ = 0;
  bool homed_ = false;
  bool homing_ = false;
  int reports_in_homing_ = 0;
  bool homing_stopped_ = false;
  std::uint64_t reference_ = 0;
  bool moved_ = true;             ///< told to move since the last report at rest
  bool move_unseen_ = false;      ///< told to move since the last report
  std::optional<double> target_;  ///< of the jog under way [mm]
  double feed_ = 0.0;             ///< of that jog [mm/s]
  Steady::time_point jog_at_;
  std::string pending_;  ///< what to send once the jog under way has braked
};

bool isMotion(const GrblStatus& status) {
  return status.state == "Jog" || status.state == "Run" || status.state == "Home" ||
         (status.state == "Hold" && status.sub_state == 1);
}

std::size_t axisOf(const StageSettings& settings) {
  if (settings.axis_number > 3) {
    throw InputError("stage", "axis_number",
                     "is " + std::to_string(settings.axis_number) + ", expected 1 (X) to 3 (Z)");
  }
  return static_cast<std::size_t>(settings.axis_number - 1);
}

GrblStage::GrblStage(const std::string& port, const StageSettings& settings)
    : unit_m_(settings.unit_m != 0.0 ? settings.unit_m : kDefaultUnit),
      axis_(axisOf(settings)),
      port_(port, settings.baud > 0 ? settings.baud : kDefaultBaud) {
  identity_ = {"GRBL", "unknown version", port};
  meet();
  readSettings();
  poll();
}

template <typename Done>
bool GrblStage::listen(Steady::time_point deadline, Done done) {
  while (!done()) {
    const std::optional<std::string> line = port_.readLine(deadline);
    if (!line) return false;
    onLine(*line);
  }
  return true;
}

void GrblStage::meet() {
  const Steady::time_point deadline = Steady::now() + kBootTime;
  while (!report_) {
    port_.write("?");
    const auto patience = std::min(deadline, Steady::now() + kPollPeriod);
    const std::size_t resets = resets_;
    listen(patience, [&] { return report_.has_value() || resets_ != resets; });
    if (report_ || Steady::now() < deadline) continue;
    const std::string where =
        printable(port_.path()) + " at " + std::to_string(port_.baud()) + " baud";
    if (noise_.empty()) noise_ = port_.unfinished();
    if (!noise_.empty()) {
      throw StageError(where + " answered \"" + printable(noise_, 60) +
                       "\", which is not GRBL 1.1");
    }
    throw StageError("nothing answered on " + where +
                     ": expected GRBL 1.1 (after a limit alarm it hears nothing but its reset "
                     "button)");
  }
}

void GrblStage::readSettings() {
  if (!command("$$", kCommandTimeout).came) {
    remark("GRBL did not list its settings ($$)");
  }
  command("$I", kCommandTimeout);
  const auto option = options_.find(13);
  scale_ = option != options_.end() && option->second == 1.0 ? 25.4 : 1.0;
  report_.reset();
}

void GrblStage::loseReference() {
  homed_ = false;
  ++reference_;
  moved_ = true;
}

void GrblStage::onReset() {
  ++resets_;
  homing_ = false;
  target_.reset();
  pending_.clear();
  offset_.reset();
  report_.reset();
  position_.reset();
  // What was asked before has no answer any more.
  if (command_under_way_) answer_ = Answer{};
  if (alarm_ == kHomingReset && homing_stopped_) alarm_ = 0;
  homing_stopped_ = false;
  // A reset in motion has its own alarm, and this one stays until somebody recovers.
  loseReference();
  next_poll_ = Steady::now();
}

void GrblStage::onAlarm(int number) {
  alarm_ = number;
  homing_ = false;
  target_.reset();
  pending_.clear();
  if (command_under_way_) answer_ = Answer{};
  loseReference();
}

void GrblStage::onAnswer(int error) {
  if (command_under_way_) {
    answer_ = Answer{true, error};
  } else if (homing_) {
    homing_ = false;
    ++reference_;
    homed_ = error == 0;
    moved_ = true;
    next_poll_ = Steady::now();
    if (error != 0) remark("homing was refused: " + grblErrorName(error));
  }
}

void GrblStage::onLine(const std::string& line) {
  if (line.front() == '<') {
    std::optional<GrblStatus> status = parseGrblStatus(line);
    if (!status) {
      noise_ = line;
      return;
    }
    if (status->offset) offset_ = (*status->offset)[axis_];
    report_ = std::move(status);
  } else if (line == "ok") {
    onAnswer(0);
  } else if (const auto error = parseGrblCode(line, "error:")) {
    onAnswer(*error);
  } else if (const auto alarm = parseGrblCode(line, "ALARM:")) {
    onAlarm(*alarm);
  } else if (line.rfind("Grbl ", 0) == 0) {
    identity_.model = printable(line.substr(0, line.find(" [")), 40);
    onReset();
  } else if (line.rfind("[VER:", 0) == 0) {
    identity_.model = printable("Grbl " + line.substr(5, line.find(':', 5) - 5), 40);
  } else if (line.front() == '[') {
    return;  // messages for people
  } else if (line.front() == '$') {
    const std::size_t equals = line.find('=');
    const auto value = parseNumber(line.substr(std::min(equals, line.size() - 1) + 1));
    const auto key = parseNumber(line.substr(1, equals - 1));
    if (equals != std::string::npos && key && value) options_[static_cast<int>(*key)] = *value;
  } else {
    noise_ = line;
  }
}

GrblStage::Answer GrblStage::command(const std::string& line, std::chrono::milliseconds timeout) {
  answer_.reset();
  command_under_way_ = true;
  port_.write(line + "\n");
  listen(Steady::now() + timeout, [&] { return answer_.has_value(); });
  command_under_way_ = false;
  return answer_.value_or(Answer{});
}

std::optional<double> GrblStage::positionOf(const GrblStatus& status) const {
  if (status.machine) return (*status.machine)[axis_] * scale_;
  if (offset_) return ((*status.work)[axis_] + *offset_) * scale_;
  return std::nullopt;
}

std::optional<double> GrblStage::reach(double seconds) const {
  const auto rate = options_.find(110 + static_cast<int>(axis_));
  if (rate == options_.end()) return std::nullopt;
  return 1.1 * rate->second / 60.0 * seconds + kSame;
}

GrblStage::Fit GrblStage::fitOf(const GrblStatus& status, double position, Stamp stamp) const {
  if (!position_) return Fit::kPossible;
  const double distance = std::abs(position - *position_);
  if (!moved_) {
    if (distance > kSame) return Fit::kContradiction;
    return distance <= kAlike ? Fit::kCertain : Fit::kPossible;
  }
  const bool rests = !isMotion(status);
  if (rests && target_ && std::abs(position - *target_) <= kAlike) return Fit::kCertain;
  const double seconds = std::chrono::duration<double>(stamp - stamp_).count();
  if (distance > reach(seconds).value_or(distance)) return Fit::kContradiction;
  if (rests || !target_) return Fit::kPossible;
  const double way = feed_ * seconds;
  const double expected = *position_ + std::copysign(way, *target_ - *position_);
  const double slack = kShareOfWay * way + kTimeOfReport * feed_ + kSame;
  return std::abs(position - expected) <= slack ? Fit::kCertain : Fit::kPossible;
}

void GrblStage::take(const GrblStatus& status, double position, Stamp stamp) {
  state_ = status.state;
  sub_state_ = status.sub_state;
  const bool moves = isMotion(status);
  velocity_ = moves && position_ && stamp > stamp_
                  ? (position - *position_) / std::chrono::duration<double>(stamp - stamp_).count()
                  : 0.0;
  position_ = position;
  stamp_ = stamp;
  move_unseen_ = false;
  if (moves) return;
  const bool there = !target_ || std::abs(position - *target_) <= kSame;
  // It may report its rest once more before it begins.
  if (!there && Steady::now() - jog_at_ < kTimeToBegin) return;
  moved_ = false;
  target_.reset();
}

void GrblStage::poll() {
  listen(Steady::now(), [] { return false; });
  std::optional<double> doubtful;
  Stamp doubtful_stamp;
  int silences = 0;
  for (int attempt = 0; attempt < kDoubts && silences < kSilences; ++attempt) {
    report_.reset();
    noise_.clear();
    const std::size_t resets = resets_;
    const int alarm = alarm_;
    const Stamp asked = now();
    port_.write("?");
    const bool heard = listen(Steady::now() + kStatusTimeout, [&] {
      return report_.has_value() || resets_ != resets || alarm_ != alarm || !noise_.empty();
    });
    if (critical()) return;
    if (!heard) ++silences;
    if (!report_) continue;
    const Stamp stamp = asked + (now() - asked) / 2;
    const std::optional<double> position = positionOf(*report_);
    if (!position) continue;
    const Fit fit = fitOf(*report_, *position, stamp);
    const double since = std::chrono::duration<double>(stamp - doubtful_stamp).count();
    const double tolerance =
        isMotion(*report_) ? reach(since + kTimeOfReport).value_or(kSameInMotion) : kSame;
    const bool confirmed = doubtful && std::abs(*doubtful - *position) <= tolerance;
    if (fit != Fit::kCertain && !confirmed) {
      doubtful = *position;
      doubtful_stamp = stamp;
      continue;
    }
    // A reset whose banner was garbled, a hand on the carriage: whatever it was, it is elsewhere.
    if (fit == Fit::kContradiction || (homed_ && report_->state == "Alarm")) {
      if (homed_) remark("the position jumped: the stage has lost its reference");
      loseReference();
    }
    take(*report_, *position, stamp);
    // Who was asked again is left alone for longer.
    next_poll_ = Steady::now() + (attempt == 0 ? 1 : 2) * kPollPeriod;
    return;
  }
  throw StageError("the stage on " + printable(port_.path()) + " does not report its state");
}

void GrblStage::watchHoming() {
  // Nothing is reported while it homes: a report tells that it is over, and the "ok" stands before
  // or close behind it, if it came at all. Without it nobody knows how homing went.
  if (report_ && report_->state != "Home") {
    report_.reset();
    if (++reports_in_homing_ > kReportsAfterHoming) {
      homing_ = false;
      loseReference();
      next_poll_ = Steady::now();
      remark("the end of homing was not heard: home it again");
      return;
    }
  }
  if (Steady::now() < next_poll_) return;
  port_.write("?");
  next_poll_ = Steady::now() + kPollPeriod;
}

std::string GrblStage::faultNow() const {
  if (alarm_ != 0) return grblAlarmName(alarm_);
  if (state_ == "Door") return "door open";
  if (state_ == "Hold" && sub_state_ == 0) return "feed hold";
  if (state_ == "Sleep") return "asleep";
  if (state_ == "Check") return "check mode";
  return "";
}

StageReading GrblStage::read() {
  listen(Steady::now(), [] { return false; });
  if (homing_ && !critical()) watchHoming();
  if (!homing_ && !critical() && Steady::now() >= next_poll_) poll();
  if (!pending_.empty() && state_ == "Idle" && !move_unseen_) {
    const std::string line = std::exchange(pending_, {});
    try {
      if (line == kHome) {
        startHoming();
      } else {
        jog(line);
      }
    } catch (const StageError& e) {
      remark(e.what());
    }
  }
  StageReading reading;
  reading.stamp = stamp_;
  reading.position_m = position_.value_or(0.0) * unit_m_;
  reading.velocity_mps = velocity_ * unit_m_;
  reading.homed = homed_ && !homing_ && position_.has_value();
  const bool rests = state_ == "Idle" || state_ == "Alarm" || state_ == "Sleep" ||
                     state_ == "Check" || state_ == "Door" || (state_ == "Hold" && sub_state_ == 0);
  const bool begins = target_ && Steady::now() - jog_at_ < kTimeToBegin;
  reading.moving =
      homing_ || (alarm_ == 0 && (!rests || begins || move_unseen_ || !pending_.empty()));
  if (!reading.moving) reading.velocity_mps = 0.0;
  reading.fault = faultNow();
  reading.reference = reference_;
  return reading;
}

void GrblStage::jog(const std::string& line) {
  const Answer answer = command(line, kCommandTimeout);
  if (alarm_ != 0) throw StageError("the stage has the fault \"" + grblAlarmName(alarm_) + "\"");
  if (!answer.came) {
    // Whether it was heard is not known: end it if it was.
    port_.write(std::string(1, kJogCancel));
    moved_ = true;
    throw StageError("the stage did not confirm the move and was stopped");
  }
  if (answer.error != 0) {
    throw StageError("the stage refused the move: " + grblErrorName(answer.error));
  }
  moved_ = true;
  move_unseen_ = true;
  jog_at_ = Steady::now();
  next_poll_ = std::min(next_poll_, jog_at_ + kPollPeriod);
  const std::size_t axis = line.find_last_of("XYZ");
  target_ = parseNumber(line.substr(axis + 1, line.find(' ', axis) - axis - 1));
  feed_ = parseNumber(line.substr(line.find_last_of('F') + 1)).value_or(0.0) / 60.0;
}

void GrblStage::moveTo(double position_m, double speed_mps) {
  const double mm = position_m / unit_m_;
  double rate = speed_mps / std::abs(unit_m_) * 60.0;
  if (!(std::abs(mm) < 1e6)) throw StageError("position is not finite or too far");
  if (!(rate > 0.0)) throw StageError("speed is not above 0");
  if (homing_) throw StageError("the stage is homing");
  const std::string fault = faultNow();
  if (!fault.empty()) throw StageError("the stage has the fault \"" + fault + "\"");
  const auto limit = options_.find(110 + static_cast<int>(axis_));
  if (limit != options_.end()) rate = std::min(rate, limit->second);
  char line[96];
  std::snprintf(line, sizeof(line), "$J=G53 G21 G90 %c%.3f F%.3f", "XYZ"[axis_], mm,
                std::max(rate, 0.001));
  if (jogs()) {
    // GRBL would queue it behind the one under way.
    replaceJog(line);
  } else {
    jog(line);
  }
}

bool GrblStage::jogs() const { return move_unseen_ || state_ == "Jog" || !pending_.empty(); }

void GrblStage::replaceJog(const std::string& line) {
  port_.write(std::string(1, kJogCancel));
  pending_ = line;
  target_.reset();
  moved_ = true;
  move_unseen_ = true;
  next_poll_ = std::min(next_poll_, Steady::now() + kRefusalTime);
}

void GrblStage::stop() {
  pending_.clear();
  if (homing_) {
    // Nothing else ends a homing cycle; it costs the reference, which homing has given up anyway.
    homing_stopped_ = true;
    port_.write(std::string(1, kReset));
    const std::size_t resets = resets_;
    listen(Steady::now() + kResetTime, [&] { return resets_ != resets; });
    homing_ = false;
    loseReference();
    return;
  }
  port_.write(std::string(1, kJogCancel));
  if (state_ == "Run") port_.write("!");
  target_.reset();
  moved_ = true;
  next_poll_ = std::min(next_poll_, Steady::now() + kRefusalTime);
}

void GrblStage::home() {
  const std::string fault = faultNow();
  if (!fault.empty())
    throw StageError("the stage has the fault \"" + fault + "\": recover it first");
  if (homing_) return;
  if (jogs()) {
    loseReference();
    replaceJog(kHome);
  } else {
    startHoming();
  }
}

void GrblStage::startHoming() {
  const std::size_t resets = resets_;
  const Answer answer = command(kHome, kRefusalTime);
  if (answer.came && answer.error != 0) {
    throw StageError("the stage refused to home: " + grblErrorName(answer.error));
  }
  if (alarm_ != 0 || resets_ != resets) {
    throw StageError("the stage refused to home" +
                     (alarm_ != 0 ? ": " + grblAlarmName(alarm_) : std::string()));
  }
  loseReference();
  report_.reset();
  reports_in_homing_ = 0;
  next_poll_ = Steady::now() + kPollPeriod;
  homing_ = !answer.came;
  homed_ = answer.came;
}

void GrblStage::recover() {
  listen(Steady::now(), [] { return false; });
  if (faultNow().empty()) return;
  const std::size_t resets = resets_;
  alarm_ = 0;
  port_.write(std::string(1, kReset));
  if (!listen(Steady::now() + kResetTime, [&] { return resets_ != resets; })) {
    throw StageError("the stage did not reset");
  }
  // Its own alarm tells of the motion that this ended, which is what was asked for.
  if (alarm_ == kResetWhileMoving) alarm_ = 0;
  state_.clear();
  poll();
}

}  // namespace

std::unique_ptr<Stage> openGrblStage(const std::string& port, const StageSettings& settings) {
  return std::make_unique<GrblStage>(port, settings);
}

}  // namespace omnister::device
