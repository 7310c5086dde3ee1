// SPDX-License-Identifier: Apache-2.0
#include "stereo/sweep/paths/candidates.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <numeric>
#include <vector>

#include "stereo/sweep/kernels/kernels.h"
#include "stereo/sweep/kernels/paths.h"

namespace omnister::sweep {
namespace {

// Penalties are in bits of a window, of which half differ where windows are unrelated. Chosen on
// the measured pairs and on rooms that are rendered with photographs, where figures hardly depend
// on them within a factor of 1.5.
constexpr int kNearWeight = 4;               ///< of the 3x3 pixels' 216 bits
constexpr std::uint16_t kStepPenalty = 300;  ///< a column off the plane, from pixel to pixel
constexpr float kJumpPenalty = 1300;         ///< another surface, where grey values differ by
constexpr float kPlainStep = 8;              ///< so much or less; in inverse proportion to more,
constexpr float kLeastJump = 300;            ///< down to this
constexpr float kEnterSlope = 100;           ///< a column off what the coarser level saw outside
constexpr float kEnterMost = 600;

constexpr int kSampleStep = 4;      ///< pixels between those asked whether windows are sure
constexpr int kSureCost = 350;      ///< of a sure window at most,
constexpr int kSureMargin = 60;     ///< and by how much the next best, two columns off, costs more
constexpr float kSureShare = 0.9f;  ///< of the windows, from which on paths change nothing

/// Whether the pixels of most windows fall on columns alike, so that rounding does not average
/// out.
bool inStep(const float* residual, int stride, int width, int height) {
  int alike = 0, all = 0;
  for (int y = 0; y + kWindow <= height; y += 3 * kWindow) {
    for (int x = 0; x + kWindow <= width; x += 2 * kWindow) {
      float sums[kWindow] = {}, all_squares[kWindow] = {};  // by column: these are vectors
      for (int v = y; v < y + kWindow; ++v) {
        for (int u = 0; u < kWindow; ++u) {
          const float r = residual[v * stride + x + u];
          sums[u] += r;
          all_squares[u] += r * r;
        }
      }
      const float sum = std::accumulate(sums, sums + kWindow, 0.0f);
      const float squares = std::accumulate(all_squares, all_squares + kWindow, 0.0f);
      constexpr float kCount = kWindow * kWindow;
      // Spread evenly over a column the variance is 1/12.
      alike += squares / kCount - sum * sum / (kCount * kCount) < 0.04f;
      ++all;
    }
  }
  return 2 * alike > all;
}

/// Penalties of a change of surface, from pixel to pixel, to Scratch::across and Scratch::down.
void penalize(const Level& level, const cv::Rect& rect, Scratch* scratch) {
  scratch->across.resize(rect.area() + 1);
  scratch->down.resize(rect.area() + rect.width);
  static const std::array<std::uint16_t, 256> penalties = [] {
    std::array<std::uint16_t, 256> of{};
    for (std::size_t i = 0; i < of.size(); ++i) {
      const float apart = std::max(static_cast<float>(i), kPlainStep);
      of[i] = static_cast<std::uint16_t>(std::max(kJumpPenalty * kPlainStep / apart, kLeastJump));
    }
    return of;
  }();
  const auto line = [&](const std::uint8_t* here, const std::uint8_t* there, std::uint16_t* out) {
    for (int x = 0; x < rect.width; ++x) out[x] = penalties[std::abs(here[x] - there[x])];
  };
  for (int y = 0; y < rect.height; ++y) {
    const std::uint8_t* here = level.reference.row(rect.y + y) + rect.x;
    const std::uint8_t* above = level.reference.row(rect.y + y - 1) + rect.x;
    const std::size_t at = static_cast<std::size_t>(y) * rect.width;
    line(here, here - 1, &scratch->across[at]);
    line(here, above, &scratch->down[at]);
  }
}

/// What the coarser level saw beyond the tile's borders, as costs of the paths that come in there.
void enterPaths(const cv::Mat& coarse, const Tile& tile, const Band& band, Scratch* scratch,
                PathJob* job) {
  const cv::Rect& rect = tile.rect;
  const int lanes = job->lanes;
  const std::size_t side = static_cast<std::size_t>(rect.height) * lanes;
  const std::size_t line = static_cast<std::size_t>(rect.width) * lanes;
  scratch->entries.resize(2 * (side + line));
  const auto to_columns = static_cast<float>(1 / band.step_h);
  // A pixel beyond the border, from the tile's corner.
  const auto enter = [&](int x, int y, std::uint16_t* to) {
    const int u = std::clamp((rect.x + x) >> 1, 0, coarse.cols - 1);
    const int v = std::clamp((rect.y + y) >> 1, 0, coarse.rows - 1);
    const float h = coarse.at<float>(v, u);
    if (std::isnan(h)) {
      std::fill_n(to, lanes, std::uint16_t{0});
      return;
    }
    for (const Sweep& sweep : scratch->sweeps) {
      const float at = h * to_columns - static_cast<float>(sweep.first) -
                       scratch->guesses[sweep.guess](static_cast<float>(x), static_cast<float>(y));
      for (int k = 0; k < sweep.lanes; ++k) {
        const float off = std::max(std::fabs(static_cast<float>(k) - at) - 0.5f, 0.0f);
        to[sweep.lane + k] = static_cast<std::uint16_t>(std::min(off * kEnterSlope, kEnterMost));
      }
    }
  };
  std::uint16_t* const left = scratch->entries.data();
  std::uint16_t* const right = left + side;
  std::uint16_t* const above = right + side;
  std::uint16_t* const below = above + line;
  for (int y = 0; y < rect.height; ++y) {
    enter(-1, y, left + static_cast<std::size_t>(y) * lanes);
    enter(rect.width, y, right + static_cast<std::size_t>(y) * lanes);
  }
  for (int x = 0; x < rect.width; ++x) {
    enter(x, -1, above + static_cast<std::size_t>(x) * lanes);
    enter(x, rect.height, below + static_cast<std::size_t>(x) * lanes);
  }
  job->left = left;
  job->right = right;
  job->above = above;
  job->below = below;
}

/// Share of a sample of windows that cost little, and less than any other candidate by far.
float shareOfSure(const PathJob& paths) {
  SureJob job;
  job.width = paths.width;
  job.height = paths.height;
  job.lanes = paths.lanes;
  job.shift = paths.shift;
  job.cost = paths.cost;
  job.block = paths.block;
  job.every = kSampleStep;
  job.most = kSureCost;
  job.margin = kSureMargin;
  const auto sampled = [](int size) {
    return (size - kSampleStep / 2 + kSampleStep - 1) / kSampleStep;
  };
  const int all = sampled(job.width) * sampled(job.height);
  return all > 0 ? static_cast<float>(countSure(job)) / static_cast<float>(all) : 0.0f;
}

}  // namespace

std::size_t guessRoom(const Tile& tile, int stride) {
  return static_cast<std::size_t>(stride) * (tile.rect.height + 2 * kRadius) + 64;
}

void mapGuesses(const Level& level, const Tile& tile, const Band& band, int stride,
                Scratch* scratch) {
  const cv::Rect& rect = tile.rect;
  MapJob job;
  job.row_scale = static_cast<float>(band.row_scale);
  job.row_offset = static_cast<float>(band.row_offset);
  job.rows = band.rows;
  job.origin = band.origin.data();
  job.cells = level.grid.cells;
  job.to_column = static_cast<float>(1.0 / band.step_h);
  const std::size_t room = guessRoom(tile, stride);
  scratch->base.resize(room * scratch->guesses.size());
  scratch->residual.resize(room * scratch->guesses.size());
  for (std::size_t g = 0; g < scratch->guesses.size(); ++g) {
    const Guess& guess = scratch->guesses[g];
    const cv::Rect& where = guess.where;
    std::int32_t* base = &scratch->base[g * room];
    float* residual = &scratch->residual[g * room];
    const int width = where.width + 2 * kRadius, height = where.height + 2 * kRadius;
    const auto mapAll = [&] {
      for (int y = where.y; y < where.y + height; ++y) {
        const std::size_t at = scratch->view.at(rect.x - kRadius + where.x, rect.y - kRadius + y);
        job.guess_x = guess.x;
        job.guess = guess(static_cast<float>(where.x - kRadius), static_cast<float>(y - kRadius));
        job.dither_phase = y * kDitherY;
        mapRow(job, &scratch->view.phi[at], &scratch->view.a[at], width,
               &base[y * stride + where.x], &residual[y * stride + where.x]);
      }
    };
    job.dither = 0;
    mapAll();
    // Where pixels and columns run in step, costs peak sharply and would lock on to columns.
    const std::size_t corner = static_cast<std::size_t>(where.y) * stride + where.x;
    if (inStep(&residual[corner], stride, width, height)) {
      job.dither = 1;
      mapAll();
    }
  }
}

void fillVolume(const CostFunction& cost, const Level& level, const Tile& tile, int stride,
                Scratch* scratch) {
  const cv::Rect& rect = tile.rect;
  std::vector<Sweep>& sweeps = scratch->sweeps;
  sweeps.clear();
  int lanes = 0;
  for (std::size_t g = 0; g < scratch->guesses.size(); ++g) {
    for (const auto& [from, to] : scratch->guesses[g].intervals) {
      Sweep sweep;
      sweep.guess = static_cast<int>(g);
      sweep.first = from - 1;
      sweep.lane = lanes;
      sweep.lanes = (to - from + 3 + kPathLanes - 1) / kPathLanes * kPathLanes;
      lanes += sweep.lanes;
      sweeps.push_back(sweep);
    }
  }
  scratch->block.assign(lanes, 0);
  const std::size_t pixels = rect.area();
  scratch->volume.resize(pixels * lanes + 2 * kVolumeMargin);
  const bool near = cost.shift() == 0;
  if (near) scratch->near.resize(pixels * lanes + 2 * kVolumeMargin);
  ChunkJob job;
  job.stride = stride;
  job.scratch = &scratch->costs;
  job.pixel_stride = lanes;
  job.row_stride = static_cast<std::ptrdiff_t>(lanes) * rect.width;
  const std::size_t room = guessRoom(tile, stride);
  for (const Sweep& sweep : sweeps) {
    scratch->block[sweep.lane] = scratch->block[sweep.lane + sweep.lanes - 1] = kBlockedCost;
    const cv::Rect& where = scratch->guesses[sweep.guess].where;
    std::uint16_t* volume = &scratch->volume[kVolumeMargin + sweep.lane];
    std::uint8_t* close = near ? &scratch->near[kVolumeMargin + sweep.lane] : nullptr;
    if (where.size() != rect.size()) {
      for (std::size_t i = 0; i < pixels; ++i) {
        std::fill_n(volume + i * lanes, sweep.lanes, kNoCandidate);
        if (near) std::fill_n(close + i * lanes, sweep.lanes, kNotNear);
      }
    }
    const std::size_t corner = static_cast<std::size_t>(where.y) * stride + where.x;
    job.width = where.width + 2 * kRadius;
    job.height = where.height + 2 * kRadius;
    job.base = &scratch->base[sweep.guess * room + corner];
    for (int p = 0; p < kPlanes; ++p) {
      job.reference[p] = scratch->reference[p].data() + corner;
      job.cells[p] = level.cells[p].data() + level.slack;
    }
    for (int lane = 0; lane < sweep.lanes; lane += job.lanes) {
      job.lanes = sweep.lanes - lane >= 32 ? 32 : 16;
      job.first = sweep.first + lane;
      const std::ptrdiff_t at = lane + where.y * job.row_stride + where.x * job.pixel_stride;
      job.volume = volume + at;
      job.near = near ? close + at : nullptr;
      cost.matchChunk(job);
    }
  }
}

float chooseCandidates(const CostFunction& cost, const Level& level, const cv::Mat* coarse,
                       const Tile& tile, const Band& band, Choice choice, Scratch* scratch) {
  const cv::Rect& rect = tile.rect;
  PathJob job;
  job.width = rect.width;
  job.height = rect.height;
  job.lanes = static_cast<int>(scratch->block.size());
  job.shift = cost.shift();
  job.cost = scratch->volume.data() + kVolumeMargin;
  job.block = scratch->block.data();
  scratch->chosen.resize(rect.area());
  LeastJob least;
  least.pixels = rect.area();
  least.lanes = job.lanes;
  least.lane = scratch->chosen.data();
  const float sure = choice == Choice::kPaths ? 0.0f : shareOfSure(job);
  scratch->has_paths = choice != Choice::kWindows && sure < kSureShare;
  if (!scratch->has_paths) {
    least.value = job.cost;
    least.block = job.block;
    least.shift = cost.shift();
    leastLanes(least);
    return sure;
  }
  if (cost.shift() == 0) {
    job.near = scratch->near.data() + kVolumeMargin;
    job.weight = kNearWeight;
  }
  job.step = kStepPenalty;
  penalize(level, rect, scratch);
  job.across = scratch->across.data();
  job.down = scratch->down.data();
  if (coarse) enterPaths(*coarse, tile, band, scratch, &job);
  scratch->path_sums.resize(static_cast<std::size_t>(rect.area()) * job.lanes + 64);
  job.sum = scratch->path_sums.data();
  job.scratch = &scratch->path_room;
  sumPaths(job);
  least.value = job.sum;
  leastLanes(least);
  return sure;
}

void readChosen(const Tile& tile, Scratch* scratch) {
  const int lanes = static_cast<int>(scratch->block.size());
  const std::size_t pixels = tile.rect.area();
  for (auto* plane : {&scratch->cost, &scratch->before, &scratch->after})
    plane->resize(pixels + 64);
  scratch->index.resize(pixels + 64);
  scratch->guess_chosen.resize(pixels + 64);
  std::vector<std::int16_t>& index_of = scratch->index_of;
  std::vector<std::uint8_t>& guess_of = scratch->guess_of;
  index_of.resize(lanes);
  guess_of.resize(lanes);
  for (const Sweep& sweep : scratch->sweeps) {
    for (int k = 0; k < sweep.lanes; ++k) {
      index_of[sweep.lane + k] = static_cast<std::int16_t>(sweep.first + k);
      guess_of[sweep.lane + k] = static_cast<std::uint8_t>(sweep.guess);
    }
  }
  constexpr int kOfPaths = 20;  // of path sums: less certain than windows that decide themselves
  for (std::size_t i = 0; i < pixels; ++i) {
    const int lane = scratch->chosen[i];
    const std::uint16_t* cost = &scratch->volume[kVolumeMargin + i * lanes + lane];
    int before = cost[-1], after = cost[1];
    if (scratch->has_paths && (before < *cost || after < *cost)) {
      // The least of the paths is not the window's: the paths say where it lies.
      const std::uint16_t* sum = &scratch->path_sums[i * lanes + lane];
      const auto rise = [&](int side) {
        if (scratch->block[lane + side] != 0) return std::max(cost[side] - *cost, 1);
        return (sum[side] - *sum) / kOfPaths;
      };
      before = *cost + rise(-1);
      after = *cost + rise(1);
    }
    scratch->cost[i] = *cost;
    scratch->before[i] = static_cast<std::uint16_t>(before);
    scratch->after[i] = static_cast<std::uint16_t>(after);
    scratch->index[i] = index_of[lane];
    scratch->guess_chosen[i] = guess_of[lane];
  }
}

}  // namespace omnister::sweep
