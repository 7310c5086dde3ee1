// SPDX-License-Identifier: Apache-2.0
/// @file Which cameras there are, and which of them is meant; see aravis_camera.h.
#pragma once

#include <netinet/in.h>

#include <optional>
#include <string>
#include <vector>

#include "device/camera/aravis/aravis_camera.h"

namespace omnister::device {

/// Vendor, model, serial number, address.
std::string describe(const AravisDevice& device);

/// @return nullopt for what is no IPv4 address
std::optional<in_addr> parseAddress(const std::string& text);

/// Our own address on the way to another. @throws CameraError where there is no way
std::string interfaceTowards(in_addr address);

/// The camera that WHICH names, or that settings.identity is; it answers now.
/// @param remarks [out] warnings about the choice
/// @throws CameraError naming those that are there
AravisDevice findAravisDevice(const std::string& which, const CameraSettings& settings,
                              std::vector<std::string>* remarks);

}  // namespace omnister::device
