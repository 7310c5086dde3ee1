// SPDX-License-Identifier: Apache-2.0
/// @file The sweep's inner loops, compiled for every instruction set and chosen at run time.
///
/// All of them give the same bytes on every instruction set. The environment variable OMNISTER_SIMD
/// (`avx2`, `sse4`, `scalar`) holds the choice to that set or less.
#pragma once

#include <cstddef>
#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

namespace omnister::sweep {

/// An 8-bit image with a replicated border, so that windows near the edge can be read.
struct PaddedImage {
  static constexpr int kPad = 16;
  int width = 0, height = 0, stride = 0;
  std::vector<std::uint8_t> data;

  void create(int w, int h) {
    width = w;
    height = h;
    stride = (w + 2 * kPad + 63) / 64 * 64;
    data.resize(static_cast<std::size_t>(stride) * (h + 2 * kPad) + 64);
  }
  std::uint8_t* row(int y) {
    return data.data() + static_cast<std::ptrdiff_t>(stride) * (y + kPad) + kPad;
  }
  const std::uint8_t* row(int y) const {
    return data.data() + static_cast<std::ptrdiff_t>(stride) * (y + kPad) + kPad;
  }
};

inline constexpr int kLanes =
    32;                           ///< hypotheses of a chunk; the outer two only serve as neighbours
inline constexpr int kBits = 24;  ///< of a descriptor: 5x5 less the centre
inline constexpr int kPlanes = 3;  ///< its bytes, each in an array of its own

/// One tile's descriptors, the cells they are compared with, and the window.
struct ChunkJob {
  int width = 0, height = 0;  ///< of the tile with its halo of `radius`
  int radius = 3;
  const std::int32_t* base = nullptr;  ///< cell of lane 0, by pixel
  const std::uint8_t* reference[kPlanes] = {};
  const std::uint8_t* cells[kPlanes] = {};
  int first = 0;  ///< lane 0 is hypothesis `first` of the tile
  /// State by pixel of the tile without halo; a chunk replaces it where it finds a lower cost.
  std::uint16_t* cost = nullptr;  ///< 0xFFFF at first
  std::uint16_t* index = nullptr;
  std::uint16_t* before = nullptr;  ///< costs of the neighbouring hypotheses
  std::uint16_t* after = nullptr;
  std::vector<std::uint8_t>* scratch = nullptr;
};

/// Gaussian of sigma 0.6 over rows [begin, end), with the border columns; fillBorderRows()
/// afterwards.
void smoothRows(const cv::Mat& image, PaddedImage* out, int begin, int end);
/// Mean of 2x2.
void halveRows(const PaddedImage& image, PaddedImage* out, int begin, int end);
void fillBorderRows(PaddedImage* image);

/// Grey values of `runs` runs of a grid row: at least 1 where a cell sees the image, else 0.
void sampleRow(const PaddedImage& image, const float* x, const float* y, const std::uint8_t* mask,
               int runs, std::uint8_t* grey);

/// Census of a grid row. @param rows the five rows around it, each at the column of `out`; two
/// cells before and behind must be readable
void censusRow(const std::uint8_t* const rows[5], int count, std::uint8_t* const out[kPlanes]);

/// Where the 24 neighbours of a pixel lie, row by row of the grid, for a block of the image.
struct CensusOffsets {
  float dx[kBits], dy[kBits];
};
/// Census of the pixels [x0, x0 + width) x [y0, y0 + height) in the local epipolar frame.
/// @param out each with `stride` bytes a row
void censusBlock(const PaddedImage& image, int x0, int y0, int width, int height,
                 const CensusOffsets& offsets, std::uint8_t* const out[kPlanes], int stride);

void matchChunk(const ChunkJob& job);

/// Name of the instruction set in use.
std::string simdName();

}  // namespace omnister::sweep
