// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ros/node_handle.h>
#include <sensor_msgs/CameraInfo.h>
#include <sensor_msgs/SetCameraInfo.h>

#include <filesystem>
#include <memory>
#include <mutex>
#include <optional>
#include <string>

#include "omnister/ListLenses.h"
#include "omnister/RollBackLens.h"
#include "omnister/device/camera.h"
#include "omnister/lens/lens_file.h"
#include "ros/message/messages.h"

namespace omnister {

/// The calibration of a camera that is driven: from a file, the store, a service, or a calibration
/// node beside it, whichever came last. Publishes latched `lens_model`, of the part of the sensor
/// that the images show; serves `set_camera_info`, `list_lenses` and `roll_back_lens`. Any thread.
class CameraLens {
 public:
  /// @param node its callbacks are stopped before this goes
  /// @param frame_id the camera's optical frame: a `lens_model` for it is taken over
  /// @param store folder of calibrations, see LensStore
  /// @param name of the camera in the store; empty: by its serial
  CameraLens(ros::NodeHandle node, std::string frame_id, std::string store, std::string name);
  CameraLens(const CameraLens&) = delete;
  CameraLens& operator=(const CameraLens&) = delete;

  /// @throws Error where camera_info cannot be made of it
  void set(LensFile file);

  /// What the store has, or else this file, unless there is a lens already; a broken one is told
  /// of.
  /// @param serial of the camera  @param recorded lens file that came with the images
  void choose(const std::string& serial, const std::optional<std::filesystem::path>& recorded);

  /// Of these pixels: of the whole sensor, the image a part of it (REP 104); uncalibrated, and told
  /// of, where the lens is of another size.
  sensor_msgs::CameraInfoPtr infoFor(const device::Frame& frame);

  struct Calibrated {
    bool yes = false;
    std::string problem;  ///< why not, where the store holds one
  };
  Calibrated calibrated() const;

 private:
  struct Lens {
    LensFile file;
    sensor_msgs::CameraInfo info;
  };

  std::string storeName() const;
  /// @throws InputError where the images, or the sensor, have another size
  void checkSize(cv::Size size) const;
  /// The images show this part of the sensor from now on.
  void show(const device::SensorRegion& region);
  void publish();
  /// The images show a part of the sensor, and the lens is of all of it. mutex_ is held.
  bool isOfMore() const;
  void onLens(const LensModelMessage::ConstPtr& message);
  bool setCameraInfo(sensor_msgs::SetCameraInfo::Request& request,
                     sensor_msgs::SetCameraInfo::Response& response);
  bool listLenses(ListLenses::Request& request, ListLenses::Response& response);
  bool rollBack(RollBackLens::Request& request, RollBackLens::Response& response);

  const std::string frame_id_, store_, name_;
  mutable std::mutex mutex_;  ///< guards what follows up to the publisher
  std::string serial_;
  std::shared_ptr<const Lens> lens_;
  std::optional<device::SensorRegion> region_;  ///< of the last frame, as its size
  cv::Size size_;
  std::string published_;
  std::string problem_;
  ros::Publisher publisher_;
  ros::Subscriber subscriber_;
  ros::ServiceServer set_camera_info_, list_lenses_, roll_back_lens_;
};

}  // namespace omnister
