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

inline constexpr int kRadius = 3;  ///< of the box that costs are summed over
inline constexpr int kWindow = 2 * kRadius + 1;
inline constexpr int kBits = 24;   ///< of a descriptor: 5x5 less the centre
inline constexpr int kPlanes = 3;  ///< its bytes, each in an array of its own

/// Phi of an epipolar map where a pixel has no ray.
inline constexpr std::uint16_t kNoRay = 0xFFFF;
/// Units of phi in such a map per radian; 0 stands for -pi.
inline constexpr double kPhiUnits = 65534.0 / 6.283185307179586;

/// Costs of correlation are in units of 1 / 2^kCorrelationShift of a bit.
inline constexpr int kCorrelationShift = 4;
/// Windows with less than this variance have no correlation [grey levels^2].
inline constexpr float kLeastVariance = 0.5f;

/// One tile's descriptors, the cells they are compared with, and where costs go. Arrays by pixel
/// have `stride` elements a row.
struct ChunkJob {
  int width = 0, height = 0;  ///< of the tile with its halo of kRadius
  int stride = 0;
  int lanes = 32;                      ///< hypotheses tried: 16 or 32
  const std::int32_t* base = nullptr;  ///< cell of hypothesis 0, by pixel
  int first = 0;  ///< hypothesis of lane 0; cells from base + first on must be readable
  const std::uint8_t* reference[kPlanes] = {};
  const std::uint8_t* cells[kPlanes] = {};
  /// [out] cost of lane 0 of the first pixel without halo; lanes lie side by side.
  std::uint16_t* volume = nullptr;
  std::ptrdiff_t pixel_stride = 0, row_stride = 0;  ///< of the volume
  /// [out] likewise, of the pixel and its eight neighbours alone; may be null.
  std::uint8_t* near = nullptr;
  std::vector<std::uint8_t>* scratch = nullptr;
};

/// Gaussian of sigma 0.6 over rows [begin, end), with the border columns; fillBorderRows()
/// afterwards.
void smoothRows(const cv::Mat& image, PaddedImage* out, int begin, int end);
/// Mean of 2x2.
void halveRows(const PaddedImage& image, PaddedImage* out, int begin, int end);
void fillBorderRows(PaddedImage* image);

/// Grey values less 128, two in a word: that of the pixel in the low byte, in the high one that to
/// its right or below it.
enum class Pairs { kAcross, kDown };
/// Pairs of the rectangle at (x0, y0), which may reach into the padding.
void pairBlock(const PaddedImage& image, int x0, int y0, int width, int height, Pairs pairs,
               std::uint16_t* out, int stride);

/// Grey values of `runs` runs of a grid row: at least 1 where a cell sees the image, else 0.
/// @param pairs of pairBlock(), kDown, of the image with its padding
void sampleRow(const std::uint16_t* pairs, int stride, const float* x, const float* y,
               const std::uint8_t* mask, int runs, std::uint8_t* grey);

/// Census of a grid row. @param rows the five rows around it, each at the column of `out`; two
/// cells before and behind must be readable
void censusRow(const std::uint8_t* const rows[5], int count, std::uint8_t* const out[kPlanes]);

/// Where the 24 neighbours of a pixel lie, row by row of the grid, for a block of the image.
struct CensusOffsets {
  float dx[kBits], dy[kBits];
};
/// Census in the local epipolar frame. Columns are done 32 (or 16 for `narrow`) at a time: that
/// much room is needed in `out`. @param pairs of pairBlock(), kAcross, at the block's first pixel
void censusBlock(const std::uint16_t* pairs, int pairs_stride, int width, int height,
                 const CensusOffsets& offsets, bool narrow, std::uint8_t* const out[kPlanes],
                 int stride);

/// A row of pixels between the corners of cells of 16; see ReferenceMap.
struct MapCellsJob {
  /// The corner above and to the left of the first cell's own; 32 elements more than there are
  /// corners must be readable.
  const float* node_phi = nullptr;
  const float* node_a = nullptr;
  int node_stride = 0;
  int row = 0;  ///< of the cells
  int cells = 0;
  std::uint16_t* phi = nullptr;  ///< 16 a cell
  float* a = nullptr;
};
void mapCells(const MapCellsJob& job);

/// Steps of the dither pattern from pixel to pixel and from row to row [1/256].
inline constexpr int kDitherX = 98, kDitherY = 159;

/// From epipolar coordinates to cells.
struct MapJob {
  float row_scale = 0, row_offset = 0;
  int rows = 0;
  const std::int32_t* origin = nullptr;  ///< by row
  std::int32_t cells = 0;                ///< base is held to [0, cells]
  float to_column = 0;
  /// Columns by which rounding is spread out, 0 or 1, and the row's phase in the pattern [1/256].
  float dither = 0;
  int dither_phase = 0;

  float guess = 0, guess_x = 0;  ///< expected hypothesis [columns], and its change a pixel
};
/// @param base [out] cell; 0 where there is no ray
/// @param residual [out] whole column less exact column; 0 where there is no ray
void mapRow(const MapJob& job, const std::uint16_t* phi, const float* a, int count,
            std::int32_t* base, float* residual);

/// Sums of columns of the window that begin at `in`. @param out as `in` strided; vectors may write
/// past the width
void boxColumns(const float* in, int stride, int width, int height, float* out);
/// Mean of the window, for `count` pixels of a row. @param line of boxColumns(); a vector and the
/// window past count must be readable
void boxMeanRow(const float* line, int count, float* out);

/// From costs to hypotheses, one row of a tile.
struct ConcludeJob {
  int count = 0;
  const std::uint16_t* cost = nullptr;
  const std::int16_t* index = nullptr;
  const std::uint16_t* before = nullptr;
  const std::uint16_t* after = nullptr;
  const std::int32_t* base = nullptr;  ///< of the row's first pixel
  const float* residual = nullptr;     ///< mean over the window, by pixel
  const std::uint16_t* phi = nullptr;
  const float* a = nullptr;
  const std::uint8_t* mask = nullptr;  ///< of the grid; null where all cells see the image
  std::int32_t cells = 0;
  float step_h = 0;
  float guess = 0, guess_x = 0;  ///< as in MapJob, from the row's first pixel
  float worst_cost = 0;          ///< in the units of costs
  /// Whether a hypothesis need not cost less than those beside it: paths chose it.
  bool chosen = false;
  /// Costs near the least are a parabola. `steep` is then what gives TriangulateJob the spread of
  /// such a least: it goes with the root of the rise.
  bool parabola = false;
  /// Whether something was concluded before: pixels change where this costs less.
  bool merge = false;
  /// [in] when merging, and [out]: the least cost. Where `count` is less than 16, as many elements
  /// are written here and below all the same.
  std::uint16_t* best = nullptr;
  float* h = nullptr;              ///< [out] NaN where nothing was found
  std::uint16_t* steep = nullptr;  ///< [out] rise of cost to the higher neighbour; may be null
  // Where the match falls on the claims image; skipped when claim is null.
  float claim_x = 0, claim_y = 0, claim_y_offset = 0;
  int claim_width = 0, claim_height = 0;
  std::int32_t* claim = nullptr;  ///< [out] -1 where nothing was found
};
void concludeRow(ConcludeJob* job);

/// Matches that claim spots of the displaced image: every spot goes to the least cost.
struct ClaimJob {
  int count = 0;
  const std::int32_t* claim = nullptr;  ///< of concludeRow()
  const float* h = nullptr;
  const std::uint16_t* cost = nullptr;
  float units = 0;                 ///< hypotheses are kept in units of 1 / units
  std::int32_t* claims = nullptr;  ///< cost << 16 | hypothesis; kClaimSlack elements more
  std::int32_t none = 0;           ///< of them, for what claims nothing
};
/// Elements behind the claims that may be written.
inline constexpr int kClaimSlack = 64;
void claimRow(const ClaimJob& job);

/// What is not to be believed by the look of others.
struct RejectJob {
  static constexpr int kReach = 3;  ///< pixels up, down, left and right to neighbours
  ClaimJob claimed;                 ///< of row y, all claims made
  int tolerance = 0;                ///< units that two claims on one spot may differ by
  const float* h[3] = {};           ///< rows y - kReach, y, y + kReach
  /// The same; kReach elements before and behind must be readable.
  const std::uint16_t* cost[3] = {};
  float jump = 0;  ///< hypotheses that differ by more lie on two surfaces
  /// Whether both tests are strict, by tile of the row, each `tile_width` pixels wide, a multiple
  /// of any vector's lanes.
  const std::uint8_t* strict = nullptr;
  int tile_width = 64;
  float* out = nullptr;                       ///< h, with NaN for what goes
  std::size_t found = 0, lost = 0, edge = 0;  ///< counted up: matches, and those that went
};
/// Leaves out matches whose spot, and unless strict also the spots beside it, went to another
/// hypothesis; and in strict tiles at the edge of a nearer surface those that cost much more than
/// that surface does further in: they lie beyond the edge, in the reach of windows across it.
void rejectRow(RejectJob* job);

/// Rows that averageRow() looks at. Errors of neighbours are alike, for they share most of their
/// windows; those of pixels half as far away as a window is wide much less so.
inline constexpr int kAverageRows = 7;
/// Where the middle is valid: the median of 3x3, neighbours that are not valid counting as the
/// middle, averaged with those of the eight pixels three rows or columns away that are within
/// `near` of it.
/// @param rows three above, here, three below; three elements before and behind must be readable
void averageRow(const float* const rows[kAverageRows], int count, float near, float* out);

/// Spread of a hypothesis [columns] times the slope of its cost over the root of the cost; as
/// measured on rendered scenes with image noise of one grey level.
inline constexpr float kSigmaOfCost = 0.44f;
/// The same, and the least spread [columns], where windows alone are not sure; as measured on pairs
/// with known depth and on rooms rendered with photographs.
inline constexpr float kSigmaOfDoubt = 0.8f, kLeastSpread = 0.05f, kLeastOfDoubt = 0.13f;
/// Of the root of the rise of a parabola, so that kSigmaOfCost holds for it as well.
inline constexpr float kSteepOfParabola = 0.77f;

struct TriangulateJob {
  int count = 0;
  bool inverse = false;  ///< h is 1 / rho, else the parallax angle
  float baseline = 0;    ///< [m]
  const float* a = nullptr;
  const float* h = nullptr;  ///< may be where range will be
  const std::uint16_t* cost = nullptr;
  const std::uint16_t* steep = nullptr;
  float step_h = 0;
  float min_range = 0, max_range = 0;
  float full_cost = 0;  ///< of a match that is worth nothing
  /// Whether windows alone are sure, by tile of the row; null: they are.
  const std::uint8_t* sure = nullptr;
  int tile_width = 64;
  float* range = nullptr;
  float* sigma = nullptr;
  float* score = nullptr;
  std::size_t no_parallax = 0, out_of_range = 0, valid = 0;  ///< counted up
};
void triangulateRow(TriangulateJob* job);

void matchChunk(const ChunkJob& job);

/// The windows' correlation in place of Hamming distances; reference[0] and cells[0] are grey
/// values, and costs are (1 - C) / 2 of the window's bits in units of 1 / 2^kCorrelationShift.
/// @param without_mean whether the windows' means are taken out (ZNCC); else C is eq. 3.1 of
/// Johnson 1997, which the mean brings near to 1: 1 - C is then brought to the scale of the others
/// by what it is for windows that have nothing to do with each other, a constant of each pixel
void correlateChunk(const ChunkJob& job, bool without_mean);

/// Holds the choice to `avx2`, `sse4` or `scalar` at most; `best` lifts that. Not while matching.
/// @throws Error for another name
void holdSimd(const std::string& name);

/// holdSimd() by OMNISTER_SIMD, the first time it is called.
void holdSimdByEnvironment();

/// Name of the instruction set in use; tests report it.
std::string simdName();

}  // namespace omnister::sweep
