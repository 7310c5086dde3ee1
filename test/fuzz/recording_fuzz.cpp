// SPDX-License-Identifier: Apache-2.0
#include "fuzz.h"
#include "omnister/device/replay_camera.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  takes([&] { device::parseRecording(bytes, "input", "/nonexistent"); });
}
