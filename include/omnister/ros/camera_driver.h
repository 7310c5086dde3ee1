// SPDX-License-Identifier: Apache-2.0
/// @file The body of the camera node and nodelet.
///
/// Publishes `image_raw` and `camera_info` with identical headers (stamp: middle of the exposure),
/// latched `lens_model`, `/diagnostics`, and the static frames of its mount. A lens that another
/// node publishes on `lens_model` for our frame is taken over. The device is opened at once,
/// streams only while someone listens, and is opened again when it was lost. A recording that knows
/// stage positions also publishes `stage_state` and the stage's tf. What
/// `set_camera_info` is given is kept in the store, as a lens surface.
#pragma once

#include <diagnostic_updater/diagnostic_updater.h>
#include <image_transport/camera_publisher.h>
#include <ros/node_handle.h>
#include <sensor_msgs/SetCameraInfo.h>
#include <tf2_ros/transform_broadcaster.h>

#include <atomic>
#include <condition_variable>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>

#include "omnister/common/pose.h"
#include "omnister/device/camera.h"
#include "omnister/lens/lens_file.h"
#include "omnister/ros/lens_store.h"
#include "omnister/ros/messages.h"
#include "omnister/ros/static_frames.h"

namespace omnister {

/// Private parameters of the same names; ranges and units are in the README.
struct CameraParameters {
  std::string device;                       ///< see device::openCamera()
  std::string frame_id = "camera_optical";  ///< optical frame
  std::string lens;                         ///< lens file; camera_info_url is a synonym
  std::string store;                        ///< folder of calibrations, see LensStore
  std::string name;                         ///< of this camera in the store; empty: its serial
  device::CameraSettings settings;
  std::string parent_frame_id;    ///< carries <camera>_link; empty: no static tf
  Pose mount = Pose::Identity();  ///< T_parent_link
  double retry_period_s = 1.0;    ///< between attempts to open the device
  double watchdog_s = 2.0;        ///< without a frame: a warning
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

 private:
  struct Lens {
    LensFile file;
    sensor_msgs::CameraInfo info;
    std::string yaml;
  };

  void run();
  void stream();
  bool openIfNeeded();
  void close(const std::string& problem);
  bool wanted() const;
  void waitFor(double seconds);
  void publish(const device::Frame& frame);
  void publishRecordedStage(const device::Frame& frame, const ros::Time& stamp);
  void takeRemarks();
  void countLost(const device::Frame& frame);
  void watch();

  void chooseLens();
  void setLens(LensFile file);
  /// Takes over a lens that a calibration publishes beside us.
  void onLens(const LensModelMessage::ConstPtr& message);
  bool setCameraInfo(sensor_msgs::SetCameraInfo::Request& request,
                     sensor_msgs::SetCameraInfo::Response& response);
  std::string storeName() const;
  void diagnose(diagnostic_updater::DiagnosticStatusWrapper& status);

  ros::NodeHandle node_;
  const CameraParameters parameters_;
  const OpenCamera open_;

  // Guarded by mutex_: what callbacks and the device thread share.
  mutable std::mutex mutex_;
  std::condition_variable wake_;
  std::shared_ptr<const Lens> lens_;
  device::CameraIdentity identity_;
  std::string state_ = "opening";
  std::string problem_;
  std::uint64_t frames_ = 0;
  std::uint64_t lost_ = 0;
  std::uint64_t losses_of_device_ = 0;
  std::uint64_t frames_at_last_report_ = 0;
  std::chrono::steady_clock::time_point last_report_;

  // Of the device thread.
  std::unique_ptr<device::Camera> camera_;
  bool streaming_ = false;
  std::optional<std::uint64_t> last_sequence_;
  std::chrono::steady_clock::time_point last_frame_;
  ros::Time recorded_stamp_;
  std::string told_problem_;
  std::chrono::steady_clock::time_point told_at_;

  std::shared_ptr<StaticFrames> static_frames_;
  tf2_ros::TransformBroadcaster transforms_;
  image_transport::CameraPublisher images_;
  ros::Publisher lens_publisher_;
  ros::Publisher stage_publisher_;
  ros::Subscriber lens_subscriber_;
  ros::ServiceServer set_camera_info_;
  diagnostic_updater::Updater diagnostics_;
  std::atomic<bool> stop_{false};
  std::thread thread_;
};

}  // namespace omnister
