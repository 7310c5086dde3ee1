// SPDX-License-Identifier: Apache-2.0
/// @file What is set on a camera, and read from it, by the names of GenICam's SFNC. What a camera
/// does not have, or did otherwise, is remarked.
#pragma once

#include <optional>
#include <string>

#include "device/camera/aravis/aravis_connection.h"
#include "omnister/device/camera.h"

namespace omnister::device {

/// All but what belongs to the stream.
/// @throws CameraError for a format or trigger that the camera does not offer, or when it is gone
void applySettings(AravisConnection& connection, const CameraSettings& settings);

CameraControls readControls(AravisConnection& connection);

/// @param triggered frames come by trigger, not at a rate
/// @throws CameraError when the camera is gone
void setControls(AravisConnection& connection, const CameraControls& wanted, bool triggered);

/// [us]; nullopt where the camera does not tell.
std::optional<double> readExposure(AravisConnection& connection);
/// off, once, continuous; empty where the camera has none.
std::string readExposureAuto(AravisConnection& connection);

/// A number that a device may offer.
std::optional<double> readNumber(AravisConnection& connection, const char* feature);

std::optional<SensorRegion> readGeometry(AravisConnection& connection);

}  // namespace omnister::device
