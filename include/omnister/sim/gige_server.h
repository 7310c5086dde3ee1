// SPDX-License-Identifier: Apache-2.0
/// @file A GigE Vision camera made of software: discovery, registers and image stream travel over
/// UDP as those of a real one, so that a driver cannot tell the difference.
///
/// Its registers are those of Aravis' fake camera and some more; what it shows is drawn by a
/// function of ours, in a thread of ours, so that the control channel answers while a frame is
/// rendered. Packets of the stream can get lost, and are sent again when asked for. It offers, by
/// their SFNC names: PixelFormat (Mono8, Mono16, BayerRG8, RGB8, BGR8), Width, Height, OffsetX,
/// OffsetY, BinningHorizontal, BinningVertical, AcquisitionFrameRate, ExposureTime, Gain,
/// BlackLevel, TriggerMode, TriggerSource (Software, Line0), TriggerSoftware, DeviceTemperature,
/// TimestampLatch, TimestampLatchValue, PtpEnable, PtpStatus, ChunkModeActive, ChunkSelector,
/// ChunkEnable, ChunkExposureTime, ChunkTimestamp. Its clock starts at an arbitrary
/// number and runs freely until PtpEnable; then it is the host's. Time stamps of frames are the
/// start of their exposure.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <opencv2/core/mat.hpp>
#include <string>

#include "omnister/device/camera.h"

namespace omnister::sim {

struct GigeServerOptions {
  std::string interface = "127.0.0.1";  ///< name or address of a network interface, or 127.x.y.z
  std::string serial = "sim-camera";    ///< 1 to 15 characters
  cv::Size size = {1280, 800};          ///< of the sensor [px]
  double frame_rate_hz = 5.0;           ///< at power-up; a slow drawing makes it fewer
  double exposure_us = 5000.0;          ///< at power-up
  bool color = true;                    ///< BGR8 at power-up, else Mono8
  double packet_loss = 0.0;             ///< share of the stream's packets that get lost, 0 to 1
  bool packet_resend = true;            ///< it can send them again
};

/// What the camera sees in the middle of an exposure: CV_8UC1 or CV_8UC3 (BGR) of the sensor's
/// size. Called from a thread of the server.
using DrawFrame = std::function<cv::Mat(device::Stamp)>;

class GigeServer {
 public:
  /// Listens from now on. One server an address: port 3956 is the protocol's.
  /// @throws InputError for options out of range; device::CameraError where the port is taken or
  /// the interface is not there
  GigeServer(const GigeServerOptions& options, DrawFrame draw);
  /// Falls silent as if its cable were pulled.
  ~GigeServer();
  GigeServer(const GigeServer&) = delete;
  GigeServer& operator=(const GigeServer&) = delete;

  /// For openCamera(): `aravis:SERIAL`.
  std::string device() const;
  /// Share of packets lost from now on, 0 to 1.
  void setPacketLoss(double share);
  /// Another image size from now on, at the corner of the sensor, as if another program had written
  /// the registers while the camera streams. Sides within the sensor's [px].
  void setRegion(cv::Size size);
  /// A pulse on Line0.
  void pulseLine0();
  /// As an automatic exposure would: nobody is told [us].
  void setExposure(double us);
  /// Frames sent since power-up.
  std::uint64_t framesSent() const;
  /// Packets that a client asked for again, and that were sent.
  std::uint64_t packetsSentAgain() const;
  /// Why no frame could be drawn; empty when all is well.
  std::string problem() const;

 private:
  class Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace omnister::sim
