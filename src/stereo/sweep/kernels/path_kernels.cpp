// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "stereo/sweep/kernels/paths.h"

// Highway builds this file once for every instruction set.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "src/stereo/sweep/kernels/path_kernels.cpp"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include "stereo/sweep/kernels/kernels-inl.h"

HWY_BEFORE_NAMESPACE();
namespace omnister::sweep {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

using Lanes16 = hn::CappedTag<std::uint16_t, kPathLanes>;

/// Room before and behind the lanes of a pixel in a path's own memory, never taken.
constexpr int kGuard = 16;
/// Rows that horizontal paths go along side by side, so that none waits for itself.
constexpr int kTogether = 4;

/// One step of one path, from `before` to `to`. @return its least cost
template <int kBlocks, bool kNear, bool kFirst>
HWY_INLINE std::uint16_t Step(const PathJob& job, std::size_t first,
                              const std::uint16_t* HWY_RESTRICT before, std::uint16_t least,
                              std::uint16_t jump, std::uint16_t* HWY_RESTRICT to) {
  const Lanes16 d;
  const hn::Rebind<std::uint8_t, Lanes16> d8;
  std::uint16_t* HWY_RESTRICT sum = job.sum + first;
  const int lanes = kBlocks > 0 ? kBlocks * kPathLanes : job.lanes;
  constexpr int n = static_cast<int>(hn::MaxLanes(Lanes16()));
  const auto step = hn::Set(d, job.step);
  const auto floor = hn::Set(d, least);
  const auto most = hn::Set(d, static_cast<std::uint16_t>(least + jump));
  auto low = hn::Set(d, 0xFFFF);
  for (int l = 0; l < lanes; l += n) {
    const auto side = hn::Min(hn::LoadU(d, before + l - 1), hn::LoadU(d, before + l + 1));
    const auto best = hn::Min(hn::Min(hn::LoadU(d, before + l), most), hn::Add(side, step));
    auto own = hn::LoadU(d, job.block + l);
    if constexpr (kNear) {
      const auto near = hn::PromoteTo(d, hn::LoadU(d8, job.near + first + l));
      const auto none = hn::SaturatedSub(near, hn::Set(d, kNotNear - 1));
      own = hn::Max(own, hn::Mul(near, hn::Set(d, job.weight)));
      own = hn::Max(own, hn::Mul(none, hn::Set(d, kBlockedCost)));
    } else {
      // Costs are below half of what a candidate costs that is not there.
      const auto cost = hn::LoadU(d, job.cost + first + l);
      const auto none = hn::SaturatedSub(cost, hn::Set(d, kNoCandidate / 2));
      own = hn::Max(own, hn::ShiftRightSame(cost, job.shift));
      own = hn::Min(hn::Max(own, none), hn::Set(d, kBlockedCost));
    }
    const auto here = hn::Add(own, hn::Sub(best, floor));
    hn::StoreU(here, d, to + l);
    hn::StoreU(kFirst ? here : hn::Add(hn::LoadU(d, sum + l), here), d, sum + l);
    low = hn::Min(low, here);
  }
  return LeastLane(d, low);
}

/// The lanes of a path that comes in at a border pixel. @return the least
HWY_INLINE std::uint16_t Enter(const std::uint16_t* message, int pixel, int lanes,
                               std::uint16_t* to) {
  if (!message) {
    std::fill_n(to, lanes, std::uint16_t{0});
    return 0;
  }
  std::copy_n(message + static_cast<std::size_t>(pixel) * lanes, lanes, to);
  return *std::min_element(to, to + lanes);
}

template <int kBlocks, bool kNear>
void SumPathsOf(const PathJob& job) {
  const int width = job.width, height = job.height;
  const int lanes = kBlocks > 0 ? kBlocks * kPathLanes : job.lanes;
  const int room = lanes + 2 * kGuard;
  const std::size_t row_room = static_cast<std::size_t>(width) * room;
  constexpr std::uint16_t kNever = kBlockedCost + kMostPenalty;
  std::vector<std::uint16_t>& scratch = *job.scratch;
  scratch.assign(2 * row_room + width + 2 * kTogether * static_cast<std::size_t>(room), kNever);
  std::uint16_t* const leasts = scratch.data() + 2 * row_room;
  std::uint16_t* const along = leasts + width;

  // To the right and to the left.
  for (int y = 0; y < height; y += kTogether) {
    const int rows = std::min(kTogether, height - y);
    for (const bool right : {true, false}) {
      std::uint16_t least[kTogether] = {};
      const auto at = [&](int k, int side) {
        return along + static_cast<std::size_t>(2 * k + side) * room + kGuard;
      };
      for (int k = 0; k < rows; ++k)
        least[k] = Enter(right ? job.left : job.right, y + k, lanes, at(k, 0));
      for (int i = 0; i < width; ++i) {
        const int x = right ? i : width - 1 - i;
        for (int k = 0; k < rows; ++k) {
          const std::size_t pixel = static_cast<std::size_t>(y + k) * width + x;
          const std::uint16_t jump = i == 0 ? kMostPenalty : job.across[pixel + (right ? 0 : 1)];
          const std::size_t first = pixel * lanes;
          if (right)
            least[k] = Step<kBlocks, kNear, true>(job, first, at(k, i % 2), least[k], jump,
                                                  at(k, 1 - i % 2));
          else
            least[k] = Step<kBlocks, kNear, false>(job, first, at(k, i % 2), least[k], jump,
                                                   at(k, 1 - i % 2));
        }
      }
    }
  }
  // Down and up.
  for (const bool down : {true, false}) {
    const auto at = [&](int x, int side) {
      return scratch.data() + side * row_room + static_cast<std::size_t>(x) * room + kGuard;
    };
    for (int x = 0; x < width; ++x)
      leasts[x] = Enter(down ? job.above : job.below, x, lanes, at(x, 0));
    for (int i = 0; i < height; ++i) {
      const int y = down ? i : height - 1 - i;
      for (int x = 0; x < width; ++x) {
        const std::size_t pixel = static_cast<std::size_t>(y) * width + x;
        const std::uint16_t jump = i == 0 ? kMostPenalty : job.down[down ? pixel : pixel + width];
        const std::size_t first = pixel * lanes;
        leasts[x] = Step<kBlocks, kNear, false>(job, first, at(x, i % 2), leasts[x], jump,
                                                at(x, 1 - i % 2));
      }
    }
  }
}

template <bool kNear>
void SumPathsAny(const PathJob& job) {
  switch (job.lanes / kPathLanes) {
    case 1:
      return SumPathsOf<1, kNear>(job);
    case 2:
      return SumPathsOf<2, kNear>(job);
    case 3:
      return SumPathsOf<3, kNear>(job);
    default:
      return SumPathsOf<0, kNear>(job);
  }
}

void SumPaths(const PathJob& job) {
  if (job.near)
    SumPathsAny<true>(job);
  else
    SumPathsAny<false>(job);
}

int CountSure(const SureJob& job) {
  const Lanes16 d;
  constexpr int n = static_cast<int>(hn::MaxLanes(Lanes16()));
  HWY_ALIGN static constexpr std::uint16_t kFirst[kPathLanes] = {0, 1, 2,  3,  4,  5,  6,  7,
                                                                 8, 9, 10, 11, 12, 13, 14, 15};
  const auto iota = hn::Load(d, kFirst);
  int sure = 0;
  for (int y = job.every / 2; y < job.height; y += job.every) {
    for (int x = job.every / 2; x < job.width; x += job.every) {
      const std::uint16_t* HWY_RESTRICT cost =
          job.cost + (static_cast<std::size_t>(y) * job.width + x) * job.lanes;
      const auto load = [&](int l) {
        return hn::Max(hn::ShiftRightSame(hn::LoadU(d, cost + l), job.shift),
                       hn::LoadU(d, job.block + l));
      };
      auto low = hn::Set(d, 0xFFFF);
      for (int l = 0; l < job.lanes; l += n) low = hn::Min(low, load(l));
      const std::uint16_t least = LeastLane(d, low);
      if (least >= job.most) continue;
      int at = 0;
      for (int l = 0; l < job.lanes; l += n) {
        const auto found = hn::FindFirstTrue(d, hn::Eq(load(l), hn::Set(d, least)));
        if (found < 0) continue;
        at = l + static_cast<int>(found);
        break;
      }
      auto second = hn::Set(d, 0xFFFF);
      for (int l = 0; l < job.lanes; l += n) {
        const auto lane = hn::Add(iota, hn::Set(d, static_cast<std::uint16_t>(l)));
        const auto middle = hn::Set(d, static_cast<std::uint16_t>(at));
        const auto apart = hn::Max(hn::SaturatedSub(lane, middle), hn::SaturatedSub(middle, lane));
        second = hn::Min(second,
                         hn::IfThenElse(hn::Gt(apart, hn::Set(d, 2)), load(l), hn::Set(d, 0xFFFF)));
      }
      sure += LeastLane(d, second) - least > job.margin;
    }
  }
  return sure;
}

void LeastLanes(const LeastJob& job) {
  const Lanes16 d;
  constexpr int n = static_cast<int>(hn::MaxLanes(Lanes16()));
  for (int i = 0; i < job.pixels; ++i) {
    const std::uint16_t* HWY_RESTRICT value = job.value + static_cast<std::size_t>(i) * job.lanes;
    const auto load = [&](int l) {
      const auto v = hn::LoadU(d, value + l);
      if (!job.block) return v;
      return hn::Max(hn::ShiftRightSame(v, job.shift), hn::LoadU(d, job.block + l));
    };
    auto low = hn::Set(d, 0xFFFF);
    for (int l = 0; l < job.lanes; l += n) low = hn::Min(low, load(l));
    const auto least = hn::Set(d, LeastLane(d, low));
    int lane = 0;
    for (int l = 0; l < job.lanes; l += n) {
      const auto found = hn::FindFirstTrue(d, hn::Eq(load(l), least));
      if (found < 0) continue;
      lane = l + static_cast<int>(found);
      break;
    }
    job.lane[i] = static_cast<std::int16_t>(lane);
  }
}

}  // namespace HWY_NAMESPACE
}  // namespace omnister::sweep
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace omnister::sweep {

HWY_EXPORT(SumPaths);
HWY_EXPORT(LeastLanes);
HWY_EXPORT(CountSure);

void sumPaths(const PathJob& job) { HWY_DYNAMIC_DISPATCH(SumPaths)(job); }

void leastLanes(const LeastJob& job) { HWY_DYNAMIC_DISPATCH(LeastLanes)(job); }

int countSure(const SureJob& job) { return HWY_DYNAMIC_DISPATCH(CountSure)(job); }

}  // namespace omnister::sweep
#endif  // HWY_ONCE
