// SPDX-License-Identifier: Apache-2.0
/// @file GigE Vision and USB3 Vision cameras, through Aravis.
///
/// `aravis:WHICH` names the camera, and WHICH is tried in this order: its serial number, its IP
/// address, its MAC address or USB identity, VENDOR-MODEL-SERIAL, VENDOR-MODEL, MODEL. Upper and
/// lower case are the same. `aravis:` alone takes any; where it, or a model, fits several, the one
/// with the least serial number is taken, and a remark tells which there are.
///
/// What an address names is the camera found there at first: settings.identity finds it again
/// wherever it is.
///
/// Features are those of GenICam's SFNC. One that a camera does not have is a remark when it was
/// asked for. Frames come complete or not at all. Their stamp is the middle of the exposure: the
/// device's time stamp, carried over to the host's clock by PTP (settings.ptp), by the device's
/// latch where it has one, and else by the quickest of the last arrivals.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "omnister/device/camera.h"

namespace omnister::device {

/// A camera as discovery tells of it.
struct AravisDevice {
  std::string id;        ///< Aravis' own name for it
  std::string physical;  ///< MAC address, or USB identity
  std::string address;   ///< IP address; empty for USB
  std::string protocol;  ///< GigEVision, USB3Vision
  CameraIdentity identity;
};

/// Everything that answers now. Takes a second.
std::vector<AravisDevice> listAravisDevices();

/// Those that WHICH names by the best of the rules above, by serial number.
std::vector<AravisDevice> matchAravisDevices(const std::vector<AravisDevice>& devices,
                                             const std::string& which);

/// @throws CameraError: not there, taken by another program, not permitted, a format that it does
/// not offer
std::unique_ptr<Camera> openAravisCamera(const std::string& which, const CameraSettings& settings);

}  // namespace omnister::device
