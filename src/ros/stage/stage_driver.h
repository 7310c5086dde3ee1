// SPDX-License-Identifier: Apache-2.0
/// @file The body of the stage node.
///
/// Publishes `joint_states`, `stage_state` and tf at `rate`, with the stamps of the readings: a
/// device that gives fewer readings has each published again (but for tf), none is made up. So
/// `stage_state` comes once more at each end of motion, before the action's result. Without a
/// device it goes on with a fault that says so. Action `move_stage`; services `home`, `halt`,
/// `recover`. Homes and moves only when told to; stops on cancel, on a fault, when it makes no
/// progress or takes too long, when its positions change their meaning (a reset), and at shutdown.
/// A stage that still moves when its link comes back is stopped.
#pragma once

#include <actionlib/server/action_server.h>
#include <diagnostic_updater/diagnostic_updater.h>
#include <omnister/MoveStageAction.h>
#include <ros/node_handle.h>
#include <std_srvs/Trigger.h>
#include <tf2_ros/transform_broadcaster.h>

#include <Eigen/Core>
#include <atomic>
#include <chrono>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>

#include "health/diagnostic_pace.h"
#include "omnister/device/stage.h"
#include "ros/node/callback_threads.h"
#include "ros/stage/external_stage.h"

// See action_status.h; a document of actionlib, not of ours.
/// @cond
namespace actionlib {
template <>
void ActionServer<omnister::MoveStageAction>::publishStatus();
}  // namespace actionlib
/// @endcond

namespace omnister {

/// Private parameters of the same names; ranges and units are in the README.
struct StageParameters {
  std::string device;  ///< zaber:PORT, grbl:PORT, external
  device::StageSettings settings;
  ExternalStageOptions external;
  Eigen::Vector3d axis = Eigen::Vector3d::UnitX();  ///< of travel, in frame_id
  double min_m = 0.0;                               ///< soft limits; goals outside are rejected
  double max_m = 0.3;
  double speed_mps = 0.05;        ///< of goals that name none
  double rate_hz = 50.0;          ///< of joint_states, tf and stage_state
  double tolerance_m = 1e-4;      ///< a goal within this is reached
  double stall_timeout_s = 3.0;   ///< a motion without progress is stopped after this
  double move_timeout_s = 120.0;  ///< a motion that takes longer is stopped
  double home_timeout_s = 60.0;   ///< so is homing
  double retry_period_s = 1.0;    ///< between attempts to open the device
  double diagnostic_period_s = kDiagnosticPeriod;
  bool publish_tf = true;
  bool required = false;  ///< gives up when the device cannot be opened or is lost, see failed()
  std::string frame_id = "stage_base";
  std::string child_frame_id = "stage_carriage";
  std::string joint_name = "stage_joint";
};

/// @param defaults what is not set keeps its value from here
/// @throws InputError naming key, value and range
StageParameters loadStageParameters(const ros::NodeHandle& private_node,
                                    StageParameters defaults = {});

using OpenStage = std::function<std::unique_ptr<device::Stage>()>;

/// What opens the device that the parameters name.
/// @throws InputError for a device text that names no backend
OpenStage stageOpener(const ros::NodeHandle& node, const StageParameters& parameters);

class StageDriver {
 public:
  /// Returns at once; the device is opened and polled by a thread of its own.
  StageDriver(const ros::NodeHandle& node, const ros::NodeHandle& private_node,
              StageParameters parameters, OpenStage open);
  /// Stops the stage and joins.
  ~StageDriver();
  StageDriver(const StageDriver&) = delete;
  StageDriver& operator=(const StageDriver&) = delete;

  /// The device is `required` and could not be opened, or was lost.
  bool failed() const { return failed_; }

 private:
  using Server = actionlib::ActionServer<MoveStageAction>;
  using Steady = std::chrono::steady_clock;

  /// Why a motion that we began ends other than by arriving.
  enum class Ending { kArrive, kCancel, kHalt, kStall, kTimeout };

  struct Goal {
    Server::GoalHandle handle;
    double target_m = 0.0;
    std::uint64_t reference = 0;  ///< what the target is relative to
    Ending ending = Ending::kArrive;
  };

  void run();
  void pollLocked();
  void openIfNeeded();
  void missingLocked(const std::string& fault, const std::string& problem);
  void lostLocked(const std::string& problem);
  void publishLocked(const device::StageReading& reading);
  void superviseLocked(const device::StageReading& reading);
  /// A device may take a moment to report that it moves.
  bool motionOverLocked(const device::StageReading& reading) const;
  void beganLocked();
  enum class Outcome { kSucceeded, kAborted, kCanceled };
  void finishLocked(Outcome outcome, const std::string& message);
  static MoveStageResult resultOf(bool success, double position_m, const std::string& message);

  void onGoal(Server::GoalHandle handle);
  void onCancel(Server::GoalHandle handle);
  /// @throws Error saying why not
  double targetOfLocked(const MoveStageGoal& goal);
  bool onHome(std_srvs::Trigger::Request&, std_srvs::Trigger::Response& response);
  bool onHalt(std_srvs::Trigger::Request&, std_srvs::Trigger::Response& response);
  bool onRecover(std_srvs::Trigger::Request&, std_srvs::Trigger::Response& response);
  device::Stage& stageLocked();
  void diagnose(diagnostic_updater::DiagnosticStatusWrapper& status);

  CallbackThreads callbacks_{2};  // before all that uses it; one may wait for the device
  ros::NodeHandle node_;
  const StageParameters parameters_;
  const OpenStage open_;

  std::mutex mutex_;  // guards all below but the publishers' own innards
  std::unique_ptr<device::Stage> stage_;
  device::StageReading reading_;
  std::optional<Goal> goal_;
  bool homing_ = false;
  bool seen_moving_ = false;
  Steady::time_point began_;
  double progress_position_m_ = 0.0;
  device::Stamp progress_stamp_;
  Steady::time_point progress_at_;
  Steady::time_point next_attempt_;
  device::Stamp transform_stamp_;
  std::string told_problem_;
  std::string told_fault_;

  ros::Publisher joint_publisher_;
  ros::Publisher state_publisher_;
  tf2_ros::TransformBroadcaster transforms_;
  diagnostic_updater::Updater diagnostics_;
  DiagnosticPace pace_;
  Server server_;
  ros::ServiceServer home_;
  ros::ServiceServer halt_;
  ros::ServiceServer recover_;
  std::atomic<bool> failed_{false};
  std::atomic<bool> stop_{false};
  std::thread thread_;
};

}  // namespace omnister
