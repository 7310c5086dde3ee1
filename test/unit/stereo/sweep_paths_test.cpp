// SPDX-License-Identifier: Apache-2.0
/// Semi-global paths against a slow, plain version of themselves, on every instruction set.
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <random>
#include <vector>

#include "stereo/sweep/kernels/kernels.h"
#include "stereo/sweep/kernels/paths.h"

namespace omnister::sweep {
namespace {

class PathsOfEverySet : public testing::TestWithParam<const char*> {
 protected:
  void SetUp() override { holdSimd(GetParam()); }
  void TearDown() override { holdSimd("best"); }
};

/// A tile of random costs whose penalties and entries are random too.
struct Tile {
  Tile(int w, int h, int n, bool near_costs, int cost_shift)
      : width(w),
        height(h),
        lanes(n),
        volume(kMargin * 2 + w * h * n),
        near(volume.size()),
        block(n),
        across(w * h + 1),
        down(w * h + w),
        left(h * n),
        right(h * n),
        above(w * n),
        below(w * n),
        sum(w * h * n + 64) {
    std::mt19937 random(static_cast<unsigned>(w * 1000 + n));
    for (auto& c : volume) c = static_cast<std::uint16_t>(random() % (1200 << cost_shift));
    for (auto& c : near) c = static_cast<std::uint8_t>(random() % 217);
    for (int l = 0; l < n; l += 16) {
      block[l] = random() % 2 ? kBlockedCost : 0;
      block[l + 15] = random() % 2 ? kBlockedCost : 0;
    }
    // Candidates that a pixel does not have, a whole block of them.
    if (n > 16) {
      for (int i = 0; i < w * h; i += 3) {
        for (int l = 16; l < 32; ++l) {
          volume[kMargin + i * n + l] = kNoCandidate;
          near[kMargin + i * n + l] = kNotNear;
        }
      }
    }
    for (auto* penalties : {&across, &down})
      for (auto& p : *penalties) p = static_cast<std::uint16_t>(300 + random() % 1000);
    for (auto* side : {&left, &right, &above, &below})
      for (auto& c : *side) c = static_cast<std::uint16_t>(random() % 600);
    job.width = w;
    job.height = h;
    job.lanes = n;
    job.shift = cost_shift;
    job.cost = volume.data() + kMargin;
    if (near_costs) job.near = near.data() + kMargin;
    job.weight = 4;
    job.block = block.data();
    job.step = 300;
    job.across = across.data();
    job.down = down.data();
    job.sum = sum.data();
    job.scratch = &scratch;
  }
  void enter() {
    job.left = left.data();
    job.right = right.data();
    job.above = above.data();
    job.below = below.data();
  }
  int costOf(int x, int y, int l) const {
    const int i = kMargin + (y * width + x) * lanes + l;
    if (job.near)
      return near[i] == kNotNear ? kBlockedCost : std::max<int>(near[i] * job.weight, block[l]);
    return volume[i] == kNoCandidate ? kBlockedCost
                                     : std::max<int>(volume[i] >> job.shift, block[l]);
  }
  /// One path, from the border on: Hirschmueller 2008, equation 13.
  std::vector<int> path(int x, int y, int dx, int dy) const {
    const bool inside = x - dx >= 0 && x - dx < width && y - dy >= 0 && y - dy < height;
    std::vector<int> before(lanes, 0);
    int jump = kMostPenalty;
    if (inside) {
      before = path(x - dx, y - dy, dx, dy);
      jump = dx > 0   ? across[y * width + x]
             : dx < 0 ? across[y * width + x + 1]
             : dy > 0 ? down[y * width + x]
                      : down[(y + 1) * width + x];
    } else if (job.left) {
      const auto& side = dx > 0 ? left : dx < 0 ? right : dy > 0 ? above : below;
      const int first = (dx != 0 ? y : x) * lanes;
      for (int l = 0; l < lanes; ++l) before[l] = side[first + l];
    }
    const int least = *std::min_element(before.begin(), before.end());
    std::vector<int> here(lanes);
    for (int l = 0; l < lanes; ++l) {
      int best = std::min(before[l], least + jump);
      if (l > 0) best = std::min(best, before[l - 1] + job.step);
      if (l + 1 < lanes) best = std::min(best, before[l + 1] + job.step);
      here[l] = costOf(x, y, l) + best - least;
    }
    return here;
  }

  static constexpr int kMargin = 64;
  int width, height, lanes;
  std::vector<std::uint16_t> volume;
  std::vector<std::uint8_t> near;
  std::vector<std::uint16_t> block, across, down, left, right, above, below, sum, scratch;
  PathJob job;
};

TEST_P(PathsOfEverySet, SumsAreThoseOfFourPlainPaths) {
  for (const int lanes : {16, 32, 48, 64}) {
    for (const bool near : {true, false}) {
      for (const bool enters : {true, false}) {
        Tile tile(11, 7, lanes, near, near ? 0 : 4);
        if (enters) tile.enter();
        sumPaths(tile.job);
        for (int y = 0; y < tile.height; ++y) {
          for (int x = 0; x < tile.width; ++x) {
            std::vector<int> sum(lanes, 0);
            for (const auto& [dx, dy] :
                 {std::pair(1, 0), std::pair(-1, 0), std::pair(0, 1), std::pair(0, -1)}) {
              const std::vector<int> one = tile.path(x, y, dx, dy);
              for (int l = 0; l < lanes; ++l) sum[l] += one[l];
            }
            for (int l = 0; l < lanes; ++l) {
              ASSERT_EQ(tile.sum[(y * tile.width + x) * lanes + l], sum[l])
                  << lanes << " lanes at " << x << " " << y << " " << l;
            }
          }
        }
      }
    }
  }
}

TEST_P(PathsOfEverySet, TheLeastLaneIsTheFirstOfEquals) {
  for (const int lanes : {16, 48}) {
    Tile tile(9, 5, lanes, false, 4);
    std::vector<std::int16_t> chosen(tile.width * tile.height);
    LeastJob least;
    least.pixels = tile.width * tile.height;
    least.lanes = lanes;
    least.value = tile.job.cost;
    least.block = tile.job.block;
    least.shift = tile.job.shift;
    least.lane = chosen.data();
    leastLanes(least);
    for (int i = 0; i < least.pixels; ++i) {
      const auto costOf = [&](int l) {
        return std::max<int>(least.value[i * lanes + l] >> 4, tile.block[l]);
      };
      int best = 0;
      for (int l = 1; l < lanes; ++l)
        if (costOf(l) < costOf(best)) best = l;
      ASSERT_EQ(chosen[i], best) << i;
    }
  }
}

TEST_P(PathsOfEverySet, SureWindowsStandOut) {
  for (const int lanes : {16, 32}) {
    Tile tile(13, 10, lanes, false, 0);
    SureJob job;
    job.width = tile.width;
    job.height = tile.height;
    job.lanes = lanes;
    job.cost = tile.job.cost;
    job.block = tile.job.block;
    job.every = 2;
    job.most = 100;
    job.margin = 30;
    int sure = 0;
    for (int y = 1; y < tile.height; y += 2) {
      for (int x = 1; x < tile.width; x += 2) {
        const auto costOf = [&](int l) {
          return std::max<int>(job.cost[(y * tile.width + x) * lanes + l], tile.block[l]);
        };
        int best = 0, second = 0xFFFF;
        for (int l = 1; l < lanes; ++l)
          if (costOf(l) < costOf(best)) best = l;
        for (int l = 0; l < lanes; ++l)
          if (std::abs(l - best) > 2) second = std::min(second, costOf(l));
        sure += costOf(best) < 100 && second - costOf(best) > 30;
      }
    }
    EXPECT_EQ(countSure(job), sure);
    EXPECT_GT(sure, 0);
  }
}

INSTANTIATE_TEST_SUITE_P(Sweep, PathsOfEverySet, testing::Values("best", "avx2", "sse4", "scalar"));

}  // namespace
}  // namespace omnister::sweep
