// SPDX-License-Identifier: Apache-2.0
#include "omnister/device/camera.h"

#include "omnister/device/aravis_camera.h"
#include "omnister/device/replay_camera.h"
#include "omnister/device/v4l2_camera.h"

namespace omnister::device {

std::unique_ptr<Camera> openCamera(const std::string& device, const CameraSettings& settings) {
  const auto rest = [&device](const std::string& backend) -> std::optional<std::string> {
    if (device.rfind(backend + ":", 0) != 0) return std::nullopt;
    return device.substr(backend.size() + 1);
  };
  if (const auto path = rest("replay"); path && !path->empty()) {
    return makeReplayCamera(readRecording(*path), settings);
  }
  if (const auto which = rest("aravis")) return openAravisCamera(*which, settings);
  if (const auto which = rest("v4l2")) return openV4l2Camera(*which, settings);
  throw InputError("device", "",
                   "is \"" + printable(device) +
                       "\", expected aravis:SERIAL (GigE or USB3 Vision), v4l2:/dev/videoN or "
                       "replay:DIR (recorded "
                       "images)");
}

}  // namespace omnister::device
