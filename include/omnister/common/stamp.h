// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>

namespace omnister {

/// Time since the Unix epoch [ns].
using Stamp = std::chrono::time_point<std::chrono::system_clock, std::chrono::nanoseconds>;

/// The system's clock as a Stamp.
inline Stamp now() {
  return std::chrono::time_point_cast<std::chrono::nanoseconds>(std::chrono::system_clock::now());
}

namespace device {
using omnister::now;
using omnister::Stamp;
}  // namespace device

}  // namespace omnister
