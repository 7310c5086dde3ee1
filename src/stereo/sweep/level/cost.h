// SPDX-License-Identifier: Apache-2.0
/// @file How the sweep compares windows: what it keeps of each pixel, and what it makes of two
/// windows of them. Tiles, search ranges, sub-pixel places, checks and points are the same for all.
#pragma once

#include <cstdint>

#include "omnister/stereo/matcher.h"
#include "stereo/sweep/level/level.h"

namespace omnister::sweep {

class CostFunction {
 public:
  virtual ~CostFunction() = default;

  /// Descriptors of a row of cells. @param rows, out as censusRow()
  virtual void describeRow(const std::uint8_t* const rows[5], int count,
                           std::uint8_t* const out[kPlanes]) const = 0;
  /// Descriptors of a tile's pixels and halo, to Scratch::reference.
  virtual void describeTile(const Level& level, bool finest, const Tile& tile, const Band& band,
                            int stride, Scratch* scratch) const = 0;
  /// Costs of a chunk of hypotheses, in units of 1 / 2^shift() of a bit of all descriptors of a
  /// window: whatever the cost, windows that have nothing to do with each other differ by half of
  /// the bits.
  virtual void matchChunk(const ChunkJob& job) const = 0;
  virtual int shift() const { return 0; }
  /// Costs near the least, from one to the next: a parabola, or sharper (see ConcludeJob).
  virtual bool isParabola() const { return false; }
};

const CostFunction& costFunction(MatchCost cost);

}  // namespace omnister::sweep
