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
#include "omnister/common/stamp.h"
#include "omnister/device/frame_memory.h"

namespace omnister::device {

/// Which part of the sensor an image shows, and how coarsely.
struct SensorRegion {
  cv::Size sensor;            ///< all its pixels
  cv::Rect region;            ///< in the sensor's own (unbinned) pixels
  cv::Size binning = {1, 1};  ///< pixels of the sensor to one of the image

  bool whole() const { return region == cv::Rect({0, 0}, sensor) && binning == cv::Size(1, 1); }
};

/// One complete image.
struct Frame {
  cv::Mat image;
  FrameMemoryPtr memory;       ///< where the pixels stand, when they stand in a pool's memory
  std::string encoding;        ///< sensor_msgs/image_encodings name, e.g. "mono8", "bayer_rggb8"
  Stamp stamp;                 ///< middle of the exposure
  std::uint64_t sequence = 0;  ///< counts up by one; a gap is a lost frame
  std::uint64_t number = 0;    ///< as the device numbers it, which may wrap; 0: it does not
  std::optional<SensorRegion> region;      ///< where the device tells it
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

/// What can be changed while a camera streams; what is not set stays as it is.
struct CameraControls {
  std::optional<double> exposure_us;
  std::optional<double> gain;         ///< in the device's unit
  std::optional<double> black_level;  ///< in the device's unit
  std::optional<double> frame_rate_hz;
  std::string exposure_auto;  ///< off, once, continuous; empty: not set
  std::string gain_auto;      ///< likewise
};

/// Since the device was opened.
struct CameraStatistics {
  std::uint64_t complete = 0;         ///< frames
  std::uint64_t incomplete = 0;       ///< frames of which packets or bytes were missing
  std::uint64_t underruns = 0;        ///< frames for which there was no memory
  std::uint64_t missing_packets = 0;  ///< never came
  std::uint64_t resent_packets = 0;   ///< came when asked for again
  std::optional<double> temperature_c;
  std::string
      link;  ///< how the device is reached, e.g. "GigE Vision 192.168.1.7, packets of 8972 B"
};

/// What is wanted of a camera. What a backend cannot do it says in takeRemarks().
struct CameraSettings {
  double frame_rate_hz = 0.0;          ///< 0: the device's own, or as recorded
  std::optional<double> exposure_us;   ///< the device's own when unset
  std::optional<double> gain;          ///< in the device's unit
  std::optional<double> black_level;   ///< in the device's unit
  std::string exposure_auto;           ///< off, once, continuous; empty: the device's own
  std::string gain_auto;               ///< likewise
  std::string pixel_format;            ///< in the device's words; empty: its own
  std::string trigger = "off";         ///< off, software, line0, ...
  cv::Size size;                       ///< of the image [px]; 0: the device's own
  cv::Point offset = {-1, -1};         ///< of a part of the sensor; negative: the device's own
  cv::Size binning = {0, 0};           ///< 0: the device's own
  std::vector<std::string> features;   ///< "Name=value": other features or controls of the device
  int buffers = 8;                     ///< frames that may wait
  double stamp_offset_us = 0.0;        ///< added to every stamp
  bool stamp_is_exposure_end = false;  ///< the device stamps the end of an exposure, not its start
  // GigE Vision:
  int packet_size = 0;      ///< [bytes]; 0: the largest that comes through
  int packet_delay_us = 0;  ///< between packets
  bool packet_resend = true;
  int socket_buffer_bytes = 0;  ///< 0: enough for several frames
  bool ptp = false;             ///< the device's clock follows IEEE 1588
  bool chunks = false;          ///< exposure and time with every frame, where offered
  /// The camera that this one must be, wherever it is now.
  std::optional<CameraIdentity> identity;
  // Recordings:
  bool loop = false;             ///< begin again at the end
  bool paced = true;             ///< at their rate, not as fast as frames are taken
  bool recorded_stamps = false;  ///< stamps as recorded, not those of the replay
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
  /// Likewise, of what only those want to know who look for a fault.
  virtual std::vector<std::string> takeDetails() { return {}; }
  /// A device whose silence means that it is lost, not a recording.
  virtual bool live() const { return false; }
  /// What the device can change while it streams, as it is now.
  virtual CameraControls controls() { return {}; }
  /// Sets those controls that are set in `wanted`. @return all as the device took them
  /// @throws CameraError when the camera is gone
  virtual CameraControls setControls(const CameraControls& /*wanted*/) { return controls(); }
  /// Exposes once, with trigger "software". @throws CameraError
  virtual void trigger() { throw CameraError("this camera has no software trigger"); }
  virtual CameraStatistics statistics() { return {}; }
  /// It does not answer any more: closing it must not wait for it.
  virtual void abandon() {}
  /// The lens file that belongs to a recording.
  virtual std::optional<std::filesystem::path> lensFile() const { return std::nullopt; }
};

/// @throws InputError for a text that names no backend, whatever is plugged in
void checkCameraDevice(const std::string& device);

/// @param device `aravis:WHICH` (see aravis_camera.h), `v4l2:WHICH` (see v4l2_camera.h),
/// `replay:PATH` (see replay_camera.h)
/// @throws CameraError; InputError for a text that names no backend or a broken recording
std::unique_ptr<Camera> openCamera(const std::string& device, const CameraSettings& settings = {});

}  // namespace omnister::device
