// SPDX-License-Identifier: Apache-2.0
/// @file What the parts of the sweep of one pair work on.
#pragma once

#include <functional>
#include <opencv2/core.hpp>
#include <utility>
#include <vector>

#include "omnister/stereo/matcher.h"
#include "stereo/sweep/grid/geometry.h"
#include "stereo/sweep/kernels/kernels.h"

namespace omnister::sweep {

/// One resolution of the pair.
struct Level {
  ReferenceMap map;
  Layout layout;
  Grid grid;
  PaddedImage reference, displaced;
  std::vector<std::uint8_t> cells[kPlanes];
  int slack = 0;  ///< cells before the first and behind the last, for stray reads
  cv::Mat h;      ///< CV_32FC1, hypotheses found
};

/// Hypotheses [columns] over a tile, by pixels from its corner.
struct Plane {
  float at = 0, x = 0, y = 0;

  float operator()(float u, float v) const { return at + x * u + y * v; }
};

/// A surface that the next coarser level saw in a tile, and how far from it to look [columns].
struct Guess : Plane {
  std::vector<std::pair<int, int>> intervals;
  cv::Rect where;  ///< part of the tile that it was seen in
};

/// Pixels of the coarser level: where they are in the tile, and their hypotheses in columns.
struct Samples {
  std::vector<float> x, y, columns;

  std::size_t size() const { return columns.size(); }
  void resize(std::size_t size) {
    for (std::vector<float>* all : {&x, &y, &columns}) all->resize(size);
  }
};

/// What a guess has in the volume of a tile.
struct Sweep {
  int guess = 0;            ///< its index
  int first = 0;            ///< hypothesis of lane 0 of the next
  int lane = 0, lanes = 0;  ///< in the volume; the outer two are only neighbours
};

/// What a thread keeps between tiles.
struct Scratch {
  std::vector<std::int32_t> base;  ///< by guess and pixel
  std::vector<float> residual;     ///< likewise
  std::vector<float> residual_sums, residual_mean;
  std::vector<Sweep> sweeps;
  std::vector<std::uint16_t> volume;  ///< costs, by pixel and candidate
  std::vector<std::uint8_t> near;     ///< as the volume, of 3x3 pixels
  std::vector<std::uint16_t> block;   ///< by candidate: whether it is only a neighbour
  std::vector<std::uint16_t> path_sums, across, down, entries, path_room;
  bool has_paths = false;                            ///< path_sums are those of the tile
  std::vector<std::int16_t> chosen;                  ///< candidate, by pixel
  std::vector<std::uint8_t> guess_chosen, guess_of;  ///< by pixel; of each candidate
  std::vector<std::int16_t> index_of;                ///< hypothesis of each candidate
  std::vector<std::uint16_t> own_cost;
  MapView view;
  std::vector<std::uint16_t> pairs;
  std::vector<std::uint8_t> reference[kPlanes], costs, grey;
  std::vector<std::uint16_t> cost, before, after;
  std::vector<std::int16_t> index;
  std::vector<int> histogram;
  Samples samples, others;
  std::vector<float> nearest;
  std::vector<std::int32_t> owner, bins;
  std::vector<Guess> guesses;
  std::vector<std::uint16_t> best_cost;            ///< of the passes before
  std::vector<std::int32_t> claims;                ///< of this thread's tiles
  std::vector<float> rows[kAverageRows], nothing;  ///< between two filters
};

class CostFunction;

/// Descriptors of the displaced image along its epipolar curves.
/// @param scratch gives that of the calling thread
/// @param pairs room to work in
void describeDisplaced(const CostFunction& cost, Level* level, int threads,
                       const std::function<Scratch&()>& scratch, std::vector<std::uint16_t>* pairs);

/// Census of the tile's pixels and halo in the local epipolar frames, to Scratch::reference.
/// @param finest whether the level is the one of full resolution
void describeTile(const Level& level, bool finest, const Tile& tile, const Band& band, int stride,
                  Scratch* scratch);

/// Surfaces that the coarser level saw in and around a tile, each with its intervals, to
/// Scratch::guesses; at least one.
/// @param coarse CV_32FC1, its hypotheses; null for the coarsest level: all hypotheses
void guessTile(const cv::Mat* coarse, const Tile& tile, const Band& band, Scratch* scratch);

/// Turns the windows of Scratch::guesses from those surfaces into planes of a given orientation;
/// what is searched stays. @param frame of the pair; Scratch::view holds the tile
void orientGuesses(MatchWindow window, const EpipolarFrame& frame, const Band& band,
                   const Tile& tile, Scratch* scratch);

}  // namespace omnister::sweep
