// SPDX-License-Identifier: Apache-2.0
/// @file Cameras of Linux' own video interface (UVC and others).
///
/// `v4l2:WHICH` is a device file (`/dev/video0`, `/dev/v4l/by-id/…`), the name of a link in
/// /dev/v4l/by-id or by-path, a bus (`usb-0000:00:14.0-1`), or the name of a model. A name that
/// does not depend on the order of plugging is better. `v4l2:` alone takes any, with a remark.
///
/// Frames are in the pixel format and size that the driver gave: YUYV, UYVY, NV12 and MJPEG become
/// bgr8. settings.pixel_format is a FourCC (`YUYV`, `MJPG`, `GREY`, `RGGB`, …); settings.features
/// sets controls by their names in lower case with underscores, as v4l2-ctl lists them.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "omnister/device/camera.h"

namespace omnister::device {

struct V4l2Device {
  std::string path;  ///< device file
  std::string bus;
  CameraIdentity identity;  ///< driver, card, and serial number (the bus where there is none)
};

/// Every device file that captures video and can be opened.
std::vector<V4l2Device> listV4l2Devices();

/// @throws CameraError: not there, taken by another program, not permitted, a format that it does
/// not offer
std::unique_ptr<Camera> openV4l2Camera(const std::string& which, const CameraSettings& settings);

}  // namespace omnister::device
