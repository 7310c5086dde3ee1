// SPDX-License-Identifier: Apache-2.0
/// @file The body of the camera node and nodelet.
///
/// Publishes `image_raw` and `camera_info` with identical headers (stamp: middle of the exposure),
/// latched `lens_model` (of the images: where they show a part of the sensor, of that part; in
/// `camera_info` the calibration stays that of the sensor, as REP 104 wants it), `/diagnostics`,
/// and the static frames of its mount. A lens that another node publishes on `lens_model` for our
/// frame is taken over. The device is opened at once by a thread of its own, streams only while
/// someone listens, and is opened again when it was lost: the same camera, with the settings it
/// had. What can change while it streams is changed by dynamic_reconfigure; `trigger` exposes once.
/// A recording that knows stage positions also publishes `stage_state` and the stage's tf. What
/// `set_camera_info` is given is kept in the store, as a lens surface; `list_lenses` tells what the
/// store keeps, and `roll_back_lens` makes an earlier one current.
#pragma once

#include <diagnostic_updater/diagnostic_updater.h>
#include <dynamic_reconfigure/server.h>
#include <image_transport/camera_publisher.h>
#include <ros/node_handle.h>
#include <std_srvs/Trigger.h>
#include <tf2_ros/transform_broadcaster.h>

#include <atomic>
#include <condition_variable>
#include <deque>
#include <functional>
#include <future>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>

#include "omnister/CameraConfig.h"
#include "omnister/common/pose.h"
#include "omnister/device/camera.h"
#include "ros/camera/camera_lens.h"
#include "ros/node/callback_threads.h"
#include "ros/node/static_frames.h"

namespace omnister {

/// Private parameters of the same names; ranges and units are in the README.
struct CameraParameters {
  std::string device;                       ///< see device::openCamera()
  std::string frame_id = "camera_optical";  ///< optical frame
  std::string lens;                         ///< lens file; camera_info_url is a synonym
  std::string store;                        ///< folder of calibrations, see LensStore
  std::string name;                         ///< of this camera in the store; empty: its serial
  device::CameraSettings settings;
  std::string parent_frame_id;       ///< carries <camera>_link; empty: no static tf
  Pose mount = Pose::Identity();     ///< T_parent_link
  double retry_period_s = 0.5;       ///< between attempts to open the device
  double start_grace_s = 1.0;        ///< after the start; an absent device is told of later
  double diagnostic_period_s = 1.0;  ///< changes are told at once
  double watchdog_s = 1.5;           ///< a device without a frame for so long is lost
  bool exit_on_error = false;        ///< the node ends instead of trying again
  // Of a recording that knows stage positions:
  std::string stage_frame_id = "stage_base";
  std::string stage_child_frame_id = "stage_carriage";
  Eigen::Vector3d axis = Eigen::Vector3d::UnitX();
};

/// @throws InputError naming key, value and range
CameraParameters loadCameraParameters(const ros::NodeHandle& private_node);

using OpenCamera = std::function<std::unique_ptr<device::Camera>(const CameraParameters&)>;

/// Opens what the parameter `device` names.
std::unique_ptr<device::Camera> openDevice(const CameraParameters& parameters);

class CameraDriver {
 public:
  /// Returns at once; the device is opened by a thread of its own.
  /// @throws Error when the `lens` parameter names a broken file
  CameraDriver(const ros::NodeHandle& node, const ros::NodeHandle& private_node,
               CameraParameters parameters, OpenCamera open = openDevice);
  /// Stops and joins.
  ~CameraDriver();
  CameraDriver(const CameraDriver&) = delete;
  CameraDriver& operator=(const CameraDriver&) = delete;

  /// The device could not be opened or was lost, and the parameters say that the node ends then.
  bool failed() const { return failed_; }

 private:
  using Task = std::function<void(device::Camera*)>;

  void run();
  void stream();
  void openIfNeeded();
  void setState(const std::string& state, const std::string& problem);
  void close(const std::string& problem);
  void tell(const std::string& problem);
  bool wanted();
  void waitFor(double seconds);
  void publish(const device::Frame& frame);
  void publishRecordedStage(const device::Frame& frame, const ros::Time& stamp);
  void takeRemarks();
  void countLost(const device::Frame& frame);
  /// @throws CameraError for a device that has been silent for too long
  void watch();
  void pollStatistics();
  /// Has the device thread do something between two frames, and waits for it.
  /// @throws Error where it cannot be done now
  void callDevice(const Task& task);
  void runTasks();

  /// What must not wait for the device: diagnostics, and the configuration as the device took it.
  void report();
  /// Reports at once, by another thread: the device was found or lost, frames stay away or are
  /// back.
  void reportSoon();
  void configure(CameraConfig& config);
  bool onTrigger(std_srvs::Trigger::Request& request, std_srvs::Trigger::Response& response);
  void takeControls(const device::CameraControls& controls);

  void diagnose(diagnostic_updater::DiagnosticStatusWrapper& status);

  CallbackThreads callbacks_;  // before all that uses it
  ros::NodeHandle node_;
  const CameraParameters parameters_;
  const OpenCamera open_;
  CameraLens lens_;

  // Guarded by mutex_: what callbacks and the device thread share.
  mutable std::mutex mutex_;
  std::condition_variable wake_;
  device::CameraIdentity identity_;
  std::string state_ = "opening";  // by setState(), which reports
  std::string problem_;
  std::uint64_t frames_ = 0;
  std::uint64_t lost_ = 0;
  std::uint64_t last_number_ = 0;
  std::uint64_t losses_of_device_ = 0;
  // The last stretch of diagnostics.
  std::uint64_t frames_then_ = 0;
  std::uint64_t lost_then_ = 0;
  std::uint64_t lost_lately_ = 0;
  double rate_hz_ = 0.0;
  device::CameraStatistics statistics_;
  device::CameraControls controls_;
  bool opened_once_ = false;
  bool controls_changed_ = false;
  std::deque<std::packaged_task<void(device::Camera*)>> tasks_;
  std::chrono::steady_clock::time_point stretch_began_;

  // Of the device thread.
  std::unique_ptr<device::Camera> camera_;
  device::CameraSettings settings_;
  bool streaming_ = false;
  bool wanted_ = false;
  std::chrono::steady_clock::time_point wanted_due_;
  bool streamed_ = false;    // a frame came since it was started
  double interval_s_ = 0.0;  // between the last two frames
  std::uint64_t torn_ = 0;   // incomplete frames when whole ones still came
  double slowest_s_ = 0.0;   // as long as the device itself may take for a frame
  std::chrono::steady_clock::time_point statistics_due_;
  std::optional<std::uint64_t> last_sequence_;
  std::uint32_t published_ = 0;
  std::chrono::steady_clock::time_point last_frame_;
  ros::Time recorded_stamp_;
  const std::chrono::steady_clock::time_point started_ = std::chrono::steady_clock::now();
  std::string told_problem_;
  std::chrono::steady_clock::time_point told_at_;

  std::shared_ptr<StaticFrames> static_frames_;
  tf2_ros::TransformBroadcaster transforms_;
  image_transport::CameraPublisher images_;
  ros::Publisher stage_publisher_;
  ros::ServiceServer trigger_;
  ros::NodeHandle private_node_;
  boost::recursive_mutex config_mutex_;
  std::unique_ptr<dynamic_reconfigure::Server<CameraConfig>> config_server_;  // of the timer
  CameraConfig config_;                                                       // as it was last told
  bool config_ready_ = false;
  ros::SteadyTimer timer_;
  diagnostic_updater::Updater diagnostics_;
  std::atomic<bool> stop_{false};
  std::atomic<bool> failed_{false};
  std::thread thread_;
};

}  // namespace omnister
