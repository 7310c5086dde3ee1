// SPDX-License-Identifier: Apache-2.0
#include "omnister/device/camera.h"

namespace omnister::device {

std::unique_ptr<Camera> openCamera(const std::string& device) {
  throw InputError("device", "", "\"" + printable(device) + "\" names no camera backend");
}

}  // namespace omnister::device
