// SPDX-License-Identifier: Apache-2.0
#include "omnister/device/camera.h"

namespace omnister::device {

Stamp now() {
  return std::chrono::time_point_cast<std::chrono::nanoseconds>(std::chrono::system_clock::now());
}

}  // namespace omnister::device
