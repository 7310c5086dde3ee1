// SPDX-License-Identifier: Apache-2.0
/// @file Numbers and dates as a person reads them in messages and records.
#pragma once

#include <cstdio>
#include <ctime>
#include <string>

namespace omnister {

/// A number with so many digits after the point; for messages, files want formatNumber().
inline std::string formatFixed(double value, int digits) {
  char text[64];
  std::snprintf(text, sizeof text, "%.*f", digits, value);
  return text;
}

/// Now as ISO 8601, UTC: 2024-05-01T12:00:00Z.
inline std::string currentDate() {
  const std::time_t now = std::time(nullptr);
  std::tm utc{};
  gmtime_r(&now, &utc);
  char text[32];
  std::strftime(text, sizeof text, "%Y-%m-%dT%H:%M:%SZ", &utc);
  return text;
}

}  // namespace omnister
