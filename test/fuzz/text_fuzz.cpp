// SPDX-License-Identifier: Apache-2.0
#include <cmath>
#include <string>

#include "fuzz.h"
#include "omnister/common/numbers.h"
#include "omnister/common/pose.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  if (const auto number = parseNumber(bytes); number && std::isfinite(*number))
    require(parseNumber(formatNumber(*number)) == number, "a number is written as it was read");
  parseNumbers(bytes);
  takes([&] { require(parsePose(bytes, "input").matrix().allFinite(), "poses are finite"); });
  const std::string shown = printable(bytes, 100);
  for (const char c : shown)
    require(static_cast<unsigned char>(c) >= 0x20, "control characters escaped");
}
