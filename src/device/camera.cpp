// SPDX-License-Identifier: Apache-2.0
#include "omnister/device/camera.h"

#include "omnister/device/replay_camera.h"

namespace omnister::device {

Stamp now() {
  return std::chrono::time_point_cast<std::chrono::nanoseconds>(std::chrono::system_clock::now());
}

std::unique_ptr<Camera> openCamera(const std::string& device, const CameraSettings& settings) {
  const std::string replay = "replay:";
  if (device.rfind(replay, 0) == 0 && device.size() > replay.size()) {
    return makeReplayCamera(readRecording(device.substr(replay.size())), settings);
  }
  throw InputError("device", "",
                   "is \"" + printable(device) + "\", expected replay:DIR (recorded images)");
}

}  // namespace omnister::device
