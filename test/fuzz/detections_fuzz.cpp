// SPDX-License-Identifier: Apache-2.0
#include "fuzz.h"
#include "omnister/calibration/detections.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  takes([&] { parseDetections(bytes, "input", {1280, 960}); });
}
