// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

namespace omnister::sim {

/// A well-mixed 64-bit value of a counter (Steele, Lea and Flood 2014, SplitMix64): the same for a
/// pixel whichever thread asks.
inline std::uint64_t mix(std::uint64_t value) {
  value += 0x9e3779b97f4a7c15u;
  value = (value ^ (value >> 30)) * 0xbf58476d1ce4e5b9u;
  value = (value ^ (value >> 27)) * 0x94d049bb133111ebu;
  return value ^ (value >> 31);
}

/// Uniform in [0, 1).
inline float uniform(std::uint64_t value) {
  return static_cast<float>(mix(value) >> 40) * 0x1p-24f;
}

}  // namespace omnister::sim
