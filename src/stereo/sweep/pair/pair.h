// SPDX-License-Identifier: Apache-2.0
/// @file The sweep of one pair, for those who match several.
#pragma once

#include <memory>

#include "omnister/stereo/matcher.h"

namespace omnister {

class SweepPair : public Matcher {
 public:
  /// Takes over what `other`, of the same reference image, works in, so that only one of them needs
  /// the memory: the one that took it last may match. Results are the same.
  virtual void takeBuffers(SweepPair* other) = 0;
};

/// How firmly a pair's matches are checked.
enum class PairChecks {
  kByTexture,  ///< strictly where the texture is rich; elsewhere near misses pass too
  /// Windows decide alone and checks are strict, for those who match several pairs: what one of
  /// them misses another sees.
  kStrict,
};

/// Refuses what no sweep can match, or what would need too much memory.
/// @throws Error as makeMatcher()
void checkSweep(const StereoGeometry& geometry, const MatcherOptions& options);

/// @param geometry with one displaced camera
/// @throws Error as makeMatcher()
std::unique_ptr<SweepPair> makeSweepPair(const StereoGeometry& geometry,
                                         const MatcherOptions& options,
                                         PairChecks checks = PairChecks::kByTexture);

}  // namespace omnister
