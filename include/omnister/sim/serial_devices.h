// SPDX-License-Identifier: Apache-2.0
/// @file Simulated stages on pseudo terminals: what talks to them cannot tell them from a Zaber or
/// a GRBL controller on a serial cable. Behind each stands a SimulatedStage, which knows where the
/// carriage truly is.
#pragma once

#include <atomic>
#include <filesystem>
#include <functional>
#include <memory>
#include <mutex>
#include <random>
#include <string>
#include <string_view>
#include <thread>

#include "omnister/sim/simulated_stage.h"

namespace omnister::sim {

/// What goes wrong, as shares (0 to 1) of the lines on the cable.
struct WireFaults {
  double garble = 0.0;  ///< one byte of the line is changed, lost or added; either way
  double lose = 0.0;    ///< the device's line does not arrive
  double reject = 0.0;  ///< Zaber: refused for a passing reason (AGAIN)
};

/// A cable with a device at its end: a pseudo terminal behind a link of a fixed name, as udev makes
/// one for a real port. It can be pulled out and plugged in again.
class SerialCable {
 public:
  /// @param link is made here; an old link of that name is replaced, nothing else is
  /// @param on_bytes, on_tick called by the cable's thread; ticks come every few milliseconds
  /// @throws IoError when there are no pseudo terminals, or the link cannot be made
  SerialCable(std::filesystem::path link, std::function<void(std::string_view)> on_bytes,
              std::function<void()> on_tick);
  ~SerialCable();
  SerialCable(const SerialCable&) = delete;
  SerialCable& operator=(const SerialCable&) = delete;

  const std::filesystem::path& link() const { return link_; }
  void unplug();
  void plugIn();
  /// From any thread; bytes that nobody reads are lost.
  void send(std::string_view bytes);

 private:
  void open();
  void close();
  void run();

  const std::filesystem::path link_;
  const std::function<void(std::string_view)> on_bytes_;
  const std::function<void()> on_tick_;
  std::mutex mutex_;  // guards the two descriptors
  int device_end_ = -1;
  int kept_end_ = -1;  // keeps the terminal alive while nobody has it open
  std::atomic<bool> stop_{false};
  std::thread thread_;
};

/// What the two simulators have in common.
class SerialStageDevice {
 public:
  virtual ~SerialStageDevice() = default;
  virtual void unplug() = 0;
  virtual void plugIn() = 0;
  void setFaults(const WireFaults& faults);
  /// Nothing is answered any more; the carriage goes on.
  void freeze(bool frozen) { frozen_ = frozen; }
  /// The power goes and comes.
  virtual void powerCycle() = 0;
  SimulatedStage& stage() { return *stage_; }

 protected:
  SerialStageDevice(std::shared_ptr<SimulatedStage> stage, std::uint32_t seed);
  bool happens(double share);
  /// Perhaps changed.
  std::string wire(std::string line);
  WireFaults faults();

  const std::shared_ptr<SimulatedStage> stage_;
  std::atomic<bool> frozen_{false};

 private:
  std::mutex faults_mutex_;
  WireFaults faults_;
  std::mt19937 random_;
};

struct ZaberOptions {
  std::filesystem::path link;
  double unit_m = 4.9609375e-7;  ///< microstep
  int device_number = 1;
  std::string serial = "40001";
  bool has_checksums = true;  ///< knows comm.checksum
  bool speed_in_move = true;  ///< firmware 7: `move abs POS SPEED`
  bool alerts = false;        ///< comm.alert is on
  std::uint32_t seed = 1;
};

/// ASCII protocol with one axis: home, move abs|rel|vel|min|max, stop, estop, warnings, get and set
/// of pos, limit.min, limit.max, maxspeed, comm.checksum, comm.alert and the identity.
class ZaberSimulator : public SerialStageDevice {
 public:
  ZaberSimulator(const ZaberOptions& options, std::shared_ptr<SimulatedStage> stage,
                 const SimulatedStageOptions& mechanics);
  void unplug() override { cable_->unplug(); }
  void plugIn() override { cable_->plugIn(); }
  void powerCycle() override;
  /// The next command is refused for this reason.
  void rejectNext(const std::string& reason);

 private:
  void onBytes(std::string_view bytes);
  void onLine(std::string line);
  void onTick();
  std::string execute(const std::string& command, bool* accepted);
  std::string move(const std::string& kind, const std::string& arguments, bool* accepted);
  std::string warningFlags(bool all);
  std::int64_t native(double position_m) const;
  void reply(int axis, const std::string& id, bool accepted, const std::string& data);

  const ZaberOptions options_;
  const SimulatedStageOptions mechanics_;
  std::mutex mutex_;
  std::string buffer_;
  bool checksum_ = false;
  bool alert_;
  bool was_busy_ = false;
  std::int64_t max_speed_;
  std::string reject_next_;
  std::unique_ptr<SerialCable> cable_;  // last: its thread uses the rest
};

struct GrblOptions {
  std::filesystem::path link;
  bool homing_enabled = true;   ///< $22: locked (Alarm) after a reset until homed
  bool soft_limits = true;      ///< $20
  bool inches = false;          ///< $13: of reports
  bool work_positions = false;  ///< $10: reports WPos, with WCO now and then
  std::uint32_t seed = 1;
};

/// GRBL 1.1h, X axis: status reports, jogs and their cancelling, homing, alarms, reset, feed hold,
/// unlocking, settings. Homing sets machine zero at the end of travel that it finds.
class GrblSimulator : public SerialStageDevice {
 public:
  GrblSimulator(const GrblOptions& options, std::shared_ptr<SimulatedStage> stage,
                const SimulatedStageOptions& mechanics);
  void unplug() override { cable_->unplug(); }
  void plugIn() override { cable_->plugIn(); }
  void powerCycle() override;
  /// Lines so far that held this text.
  int heard(const std::string& text);
  /// Status reports asked for so far.
  int asked() const { return asked_; }

 private:
  enum class State { kIdle, kJog, kHome, kAlarm, kHold };
  void onBytes(std::string_view bytes);
  void onRealtime(char byte);
  void onLine(const std::string& line);
  void onTick();
  void jog(const std::string& line);
  void softReset();
  void report();
  void say(const std::string& line);
  void alarm(int number);

  const GrblOptions options_;
  const SimulatedStageOptions mechanics_;
  std::mutex mutex_;
  std::string buffer_;
  std::string heard_;
  State state_;
  bool critical_ = false;
  int reports_ = 0;
  std::atomic<int> asked_{0};
  std::unique_ptr<SerialCable> cable_;  // last: its thread uses the rest
};

}  // namespace omnister::sim
