// SPDX-License-Identifier: Apache-2.0
/// @file The candidates of a tile's pixels, what they cost, and which of them semi-global paths
/// choose.
#pragma once

#include <cstddef>
#include <cstdint>

#include "stereo/sweep/level/cost.h"
#include "stereo/sweep/level/level.h"

namespace omnister::sweep {

/// Elements of Scratch::volume and Scratch::near before the first and behind the last candidate.
inline constexpr int kVolumeMargin = 64;

/// Elements of Scratch::base and Scratch::residual for one guess.
std::size_t guessRoom(const Tile& tile, int stride);

/// Cells of the tile's pixels and halo, to Scratch::base and Scratch::residual, guess by guess.
/// @param stride elements of a row of the tile with its halo
void mapGuesses(const Level& level, const Tile& tile, const Band& band, int stride,
                Scratch* scratch);

/// Costs of all candidates of all guesses, to Scratch::sweeps, volume, near and block.
void fillVolume(const CostFunction& cost, const Level& level, const Tile& tile, int stride,
                Scratch* scratch);

/// Who chooses among a pixel's candidates.
enum class Choice {
  kPaths,
  kPathsIfNeeded,  ///< windows alone where nearly all of them are sure: paths would change nothing
  kWindows,
};

/// Chooses a candidate for each pixel, to Scratch::chosen.
/// @param coarse CV_32FC1, hypotheses of the next coarser level: what lies beyond the tile. Null
/// for the coarsest
/// @return share of a sample of pixels whose window alone is sure; 0 for Choice::kPaths
float chooseCandidates(const CostFunction& cost, const Level& level, const cv::Mat* coarse,
                       const Tile& tile, const Band& band, Choice choice, Scratch* scratch);

/// Costs at and beside the chosen candidates, by pixel of the tile, to Scratch::cost, before,
/// after, index and guess_chosen.
void readChosen(const Tile& tile, Scratch* scratch);

}  // namespace omnister::sweep
