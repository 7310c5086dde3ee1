// SPDX-License-Identifier: Apache-2.0
#include "fuzz.h"
#include "omnister/calibration/target.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  takes([&] { parseTarget(bytes, "input"); });
}
