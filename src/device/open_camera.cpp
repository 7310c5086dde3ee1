// SPDX-License-Identifier: Apache-2.0
#include "device/camera/aravis/aravis_camera.h"
#include "device/camera/v4l2/v4l2_camera.h"
#include "omnister/device/camera.h"
#include "omnister/device/replay_camera.h"

namespace omnister::device {

void checkCameraDevice(const std::string& device) {
  const std::size_t colon = device.find(':');
  const std::string backend = device.substr(0, colon);
  if (colon != std::string::npos && (backend == "aravis" || backend == "v4l2")) return;
  if (backend == "replay" && device.size() > colon + 1 && colon != std::string::npos) return;
  throw InputError(
      "\"" + printable(device) + "\"", "",
      "is no camera, expected aravis:SERIAL (GigE or USB3 Vision), v4l2:/dev/videoN or "
      "replay:DIR (recorded images)");
}

std::unique_ptr<Camera> openCamera(const std::string& device, const CameraSettings& settings) {
  checkCameraDevice(device);
  const std::size_t colon = device.find(':');
  const std::string backend = device.substr(0, colon);
  const std::string which = device.substr(colon + 1);
  if (backend == "replay") return makeReplayCamera(readRecording(which), settings);
  return backend == "aravis" ? openAravisCamera(which, settings) : openV4l2Camera(which, settings);
}

}  // namespace omnister::device
