// SPDX-License-Identifier: Apache-2.0
#include "fuzz.h"
#include "omnister/sim/scene.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  takes([&] { sim::parseScene(bytes, "input", "/nonexistent"); });
}
