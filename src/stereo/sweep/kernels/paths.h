// SPDX-License-Identifier: Apache-2.0
/// @file Semi-global paths over the candidates of a tile (Hirschmueller 2008, four of his paths).
///
/// Candidates are planes' neighbourhoods: lane k of a block is k columns off a plane, so a path
/// that keeps its lane follows the plane's slant, and a step of one lane is a small departure from
/// it. A path that goes from one block to another changes the surface.
#pragma once

#include <cstdint>
#include <vector>

namespace omnister::sweep {

/// Lanes are handled in vectors of so many.
inline constexpr int kPathLanes = 16;
/// Cost of a lane that no path may take. Four paths of it and of any penalty fit 16 bits.
inline constexpr std::uint16_t kBlockedCost = 9000;
/// Costs of candidates that a pixel does not have: of windows, of 3x3 pixels.
inline constexpr std::uint16_t kNoCandidate = 0xFFFF;
inline constexpr std::uint8_t kNotNear = 0xFF;
/// Most that a departure may cost.
inline constexpr std::uint16_t kMostPenalty = 6000;

struct PathJob {
  int width = 0, height = 0;  ///< of the tile
  int lanes = 0;              ///< of a pixel, a multiple of kPathLanes
  int shift = 0;              ///< costs are divided by 2^shift
  /// By pixel and lane. A lane and one before the first and behind the last must be readable.
  const std::uint16_t* cost = nullptr;
  /// Costs of the pixel and its neighbours alone, which are taken `weight` times in place of
  /// `cost`; may be null.
  const std::uint8_t* near = nullptr;
  std::uint16_t weight = 0;
  const std::uint16_t* block = nullptr;  ///< by lane: kBlockedCost or 0
  std::uint16_t step = 0;                ///< penalty of a neighbouring lane
  /// Penalty of any other lane, by pixel: from the pixel to its left, from the one above.
  const std::uint16_t* across = nullptr;
  const std::uint16_t* down = nullptr;
  /// Costs of the paths that come in at the tile's borders, by pixel of the border and lane; null:
  /// they begin there.
  const std::uint16_t* left = nullptr;
  const std::uint16_t* right = nullptr;
  const std::uint16_t* above = nullptr;
  const std::uint16_t* below = nullptr;
  std::uint16_t* sum = nullptr;  ///< [out] by pixel and lane, of the four paths
  std::vector<std::uint16_t>* scratch = nullptr;
};

/// Sums of the costs of the cheapest paths that reach each lane from the left, the right, above and
/// below.
void sumPaths(const PathJob& job);

struct LeastJob {
  int pixels = 0, lanes = 0;
  const std::uint16_t* value = nullptr;  ///< by pixel and lane
  const std::uint16_t* block = nullptr;  ///< by lane; null: none is blocked
  int shift = 0;                         ///< values are divided by 2^shift before `block` is added
  std::int16_t* lane = nullptr;          ///< [out] of the least, the first of equals
};
void leastLanes(const LeastJob& job);

struct SureJob {
  int width = 0, height = 0, lanes = 0;  ///< as in PathJob
  int shift = 0;
  const std::uint16_t* cost = nullptr;
  const std::uint16_t* block = nullptr;
  int every = 1;   ///< rows and columns of which one is looked at
  int most = 0;    ///< a sure window costs less,
  int margin = 0;  ///< and every lane farther than two from its least costs that much more
};
/// @return pixels whose window alone is sure, of those looked at
int countSure(const SureJob& job);

}  // namespace omnister::sweep
