// SPDX-License-Identifier: Apache-2.0
/// @file What every camera backend does. No ROS here.
#pragma once

#include <chrono>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <opencv2/core/mat.hpp>
#include <optional>
#include <string>
#include <vector>

#include "omnister/common/error.h"

namespace omnister::device {

/// Time since the Unix epoch [ns].
using Stamp = std::chrono::time_point<std::chrono::system_clock, std::chrono::nanoseconds>;

/// The system's clock as a Stamp.
Stamp now();

/// One complete image.
struct Frame {
  cv::Mat image;
  std::string encoding;        ///< sensor_msgs/image_encodings name, e.g. "mono8", "bayer_rggb8"
  Stamp stamp;                 ///< middle of the exposure
  std::uint64_t sequence = 0;  ///< counts up by one; a gap is a lost frame
  std::optional<double> stage_position_m;  ///< where the backend knows it (recordings) [m]
  std::optional<bool> settled;             ///< the stage stood still during the exposure
};

/// Who the camera is; the same camera after it has been unplugged and plugged in again.
struct CameraIdentity {
  std::string vendor;
  std::string model;
  std::string serial;
};

/// The camera cannot be opened, or was lost. The caller may try again.
class CameraError : public Error {
 public:
  using Error::Error;
};

/// What is wanted of a camera. What a backend cannot do it says in takeRemarks().
struct CameraSettings {
  double frame_rate_hz = 0.0;         ///< 0: the device's own, or as recorded
  std::optional<double> exposure_us;  ///< the device's own when unset
  std::optional<double> gain;         ///< in the device's unit
  std::string pixel_format;           ///< in the device's words; empty: its own
  std::string trigger = "off";        ///< off, software, line0, ...
  bool loop = false;                  ///< recordings: begin again at the end
  bool paced = true;             ///< recordings: at their rate, not as fast as frames are taken
  bool recorded_stamps = false;  ///< recordings: stamps as recorded, not those of the replay
};

/// Used from one thread at a time, but for the stop flag that the caller keeps itself: grab()
/// returns within its timeout.
class Camera {
 public:
  virtual ~Camera() = default;
  virtual CameraIdentity identity() const = 0;
  /// Starts streaming. @throws CameraError
  virtual void start() = 0;
  /// Waits for the next complete frame. @return nullopt after `timeout`, or at the end of a
  /// recording
  /// @throws CameraError when the camera is gone
  virtual std::optional<Frame> grab(std::chrono::milliseconds timeout) = 0;
  /// Stops streaming; start() may follow.
  virtual void stop() = 0;
  /// True once a recording has given its last frame.
  virtual bool finished() const { return false; }
  /// What a person should know and no call failed for (a setting that this device does not have, a
  /// broken frame in a recording), a line each; every line is told once.
  virtual std::vector<std::string> takeRemarks() { return {}; }
  /// The lens file that belongs to a recording.
  virtual std::optional<std::filesystem::path> lensFile() const { return std::nullopt; }
};

/// @param device `replay:PATH` (see replay_camera.h)
/// @throws CameraError; InputError for a text that names no backend or a broken recording
std::unique_ptr<Camera> openCamera(const std::string& device, const CameraSettings& settings = {});

}  // namespace omnister::device
