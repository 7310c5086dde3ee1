// SPDX-License-Identifier: Apache-2.0
#include <hwy/cache_control.h>

#include <algorithm>
#include <cstring>

#include "stereo/sweep/kernels/kernels.h"

// Highway builds this file once for every instruction set.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "src/stereo/sweep/kernels/match_kernels.cpp"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include "stereo/sweep/kernels/kernels-inl.h"

HWY_BEFORE_NAMESPACE();
namespace omnister::sweep {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// A vector of two halves that lie apart. @param d of more than one lane
template <class D>
HWY_INLINE hn::Vec<D> LoadHalves(D d, const std::uint8_t* low, const std::uint8_t* high) {
#if HWY_TARGET == HWY_SCALAR
  static_cast<void>(high);
  return hn::LoadU(d, low);
#else
  const hn::Half<D> half;
  return hn::Combine(d, hn::LoadU(half, high), hn::LoadU(half, low));
#endif
}

template <int kLanes>
void MatchLanes(const ChunkJob& job) {
  constexpr int kAhead = 3;  // rows
  const int width = job.width, height = job.height, stride = job.stride;
  const int tile_width = width - 2 * kRadius;
  const std::size_t line = static_cast<std::size_t>(width + width % 2) * kLanes;
  job.scratch->assign(line * (kWindow + 1) + 256, 0);
  std::uint8_t* HWY_RESTRICT sums = job.scratch->data();
  std::uint8_t* const ring = sums + line;
  // Bytes may alias anything, so what the loops need is copied out of the job.
  const std::int32_t* HWY_RESTRICT bases = job.base;
  const std::uint8_t* HWY_RESTRICT reference0 = job.reference[0];
  const std::uint8_t* HWY_RESTRICT reference1 = job.reference[1];
  const std::uint8_t* HWY_RESTRICT reference2 = job.reference[2];
  const std::uint8_t* HWY_RESTRICT cells0 = job.cells[0] + job.first;
  const std::uint8_t* HWY_RESTRICT cells1 = job.cells[1] + job.first;
  const std::uint8_t* HWY_RESTRICT cells2 = job.cells[2] + job.first;

  // Narrow chunks of two pixels share a vector where there is room.
  constexpr int kPixels =
      kLanes == 16 && hn::MaxLanes(hn::CappedTag<std::uint8_t, 32>()) == 32 ? 2 : 1;
  HWY_ALIGN static constexpr std::uint8_t kTurn[32] = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
                                                       0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1,
                                                       1, 1, 1, 1, 1, 1, 1, 1, 1, 1};
  const hn::CappedTag<std::uint8_t, kLanes * kPixels> d8;
  const hn::CappedTag<std::uint8_t, kLanes> d8l;
  constexpr std::size_t n8l = hn::MaxLanes(decltype(d8l)());
  const hn::CappedTag<std::uint16_t, kLanes> d16;
  const hn::Rebind<std::uint8_t, decltype(d16)> d8h;
  constexpr std::size_t n8 = hn::MaxLanes(decltype(d8)());
  constexpr std::size_t n16 = hn::MaxLanes(decltype(d16)());
  for (int y = 0; y < height; ++y) {
    std::uint8_t* HWY_RESTRICT old = ring + static_cast<std::size_t>(y % kWindow) * line;
    const std::size_t row = static_cast<std::size_t>(y) * stride;
    if (y + kAhead < height) {
      // Cells of rows to come: the processor does not see these leaps coming.
      for (int x = 0; x < width; x += 8) {
        const std::ptrdiff_t base = bases[row + static_cast<std::size_t>(kAhead) * stride + x];
        hwy::Prefetch(cells0 + base);
        hwy::Prefetch(cells1 + base);
        hwy::Prefetch(cells2 + base);
      }
    }
    const auto enter = [&](auto d, std::size_t at, auto cost0, auto cost1, auto cost2) {
      const auto cost = hn::Add(hn::Add(cost0, cost1), cost2);
      const auto sum = hn::LoadU(d, sums + at);
      hn::StoreU(hn::Add(sum, hn::Sub(cost, hn::LoadU(d, old + at))), d, sums + at);
      hn::StoreU(cost, d, old + at);
    };
    if constexpr (kPixels == 2) {
      const auto turn = hn::Load(d8, kTurn);
      for (int x = 0; x < width; x += 2) {
        const std::size_t pixel = row + x;
        const std::ptrdiff_t base = bases[pixel];
        const std::ptrdiff_t next = bases[pixel + (x + 1 < width ? 1 : 0)];
        const auto cost = [&](const std::uint8_t* cells, const std::uint8_t* reference) {
          std::uint16_t two;
          std::memcpy(&two, reference + pixel, 2);
          const auto own = hn::TableLookupBytes(
              hn::BitCast(d8, hn::Set(hn::Repartition<std::uint16_t, decltype(d8)>(), two)), turn);
          const auto other = LoadHalves(d8, cells + base, cells + next);
          return hn::PopulationCount(hn::Xor(other, own));
        };
        enter(d8, static_cast<std::size_t>(x) * kLanes, cost(cells0, reference0),
              cost(cells1, reference1), cost(cells2, reference2));
      }
    } else {
      for (int x = 0; x < width; ++x) {
        const std::size_t pixel = row + x;
        const std::ptrdiff_t base = bases[pixel];
        for (std::size_t l = 0; l < kLanes; l += n8) {
          const auto cost = [&](const std::uint8_t* cells, const std::uint8_t* reference) {
            return hn::PopulationCount(
                hn::Xor(hn::LoadU(d8, cells + base + l), hn::Set(d8, reference[pixel])));
          };
          enter(d8, static_cast<std::size_t>(x) * kLanes + l, cost(cells0, reference0),
                cost(cells1, reference1), cost(cells2, reference2));
        }
      }
    }
    if (y < kWindow - 1) continue;
    std::uint16_t* HWY_RESTRICT out = job.volume + (y - kWindow + 1) * job.row_stride;
    if (job.near) {
      // The middle three of the window's rows, then of its columns.
      const auto ringRow = [&](int back) {
        return ring + static_cast<std::size_t>((y - back) % kWindow) * line;
      };
      const std::uint8_t* HWY_RESTRICT above = ringRow(kRadius + 1);
      const std::uint8_t* HWY_RESTRICT here = ringRow(kRadius);
      const std::uint8_t* HWY_RESTRICT below = ringRow(kRadius - 1);
      std::uint8_t* HWY_RESTRICT near = job.near + (y - kWindow + 1) * job.row_stride;
      for (std::size_t l = 0; l < kLanes; l += n8l) {
        const auto column = [&](int x) {
          const std::size_t at = static_cast<std::size_t>(x) * kLanes + l;
          return hn::Add(hn::Add(hn::LoadU(d8l, above + at), hn::LoadU(d8l, here + at)),
                         hn::LoadU(d8l, below + at));
        };
        auto left = column(kRadius - 1), middle = column(kRadius);
        for (int x = 0; x < tile_width; ++x) {
          const auto right = column(x + kRadius + 1);
          hn::StoreU(hn::Add(hn::Add(left, middle), right), d8l, near + x * job.pixel_stride + l);
          left = middle;
          middle = right;
        }
      }
    }
    for (std::size_t l = 0; l < kLanes; l += n16) {
      auto sum = hn::Zero(d16);
      for (int x = 0; x < kWindow - 1; ++x)
        sum = hn::Add(sum, hn::PromoteTo(d16, hn::LoadU(d8h, sums + x * kLanes + l)));
      for (int x = 0; x < tile_width; ++x) {
        const std::uint8_t* HWY_RESTRICT gone = sums + static_cast<std::size_t>(x) * kLanes + l;
        sum = hn::Add(sum, hn::PromoteTo(d16, hn::LoadU(d8h, gone + (kWindow - 1) * kLanes)));
        hn::StoreU(sum, d16, out + x * job.pixel_stride + l);
        sum = hn::Sub(sum, hn::PromoteTo(d16, hn::LoadU(d8h, gone)));
      }
    }
  }
}

void MatchChunk(const ChunkJob& job) {
  if (job.lanes == 16)
    MatchLanes<16>(job);
  else
    MatchLanes<32>(job);
}

void MapCells(const MapCellsJob& job) {
  constexpr int kCell = 16, kBatch = 13;  // with three corners more, 16
  const hn::CappedTag<float, kCell> d;
  const hn::RebindToSigned<decltype(d)> di;
  const hn::Rebind<std::uint16_t, decltype(d)> d16;
  const int lanes = static_cast<int>(hn::Lanes(d));
  const float t = static_cast<float>(job.row) / kCell;
  const auto weight = [](int k, float s) {
    if (k == 0) return -s * (s - 1) * (s - 2) / 6;
    if (k == 1) return (s + 1) * (s - 1) * (s - 2) / 2;
    if (k == 2) return -(s + 1) * s * (s - 2) / 2;
    return (s + 1) * s * (s - 1) / 6;
  };
  struct Across {
    HWY_ALIGN float w[4][kCell];
  };
  static const Across across = [&] {
    Across table;
    for (int k = 0; k < 4; ++k)
      for (int i = 0; i < kCell; ++i) table.w[k][i] = weight(k, static_cast<float>(i) / kCell);
    return table;
  }();
  HWY_ALIGN float phi[kCell], a[kCell];
  for (int first = 0; first < job.cells; first += kBatch) {
    for (int i = 0; i < kCell; i += lanes) {
      auto p = hn::Zero(d), q = hn::Zero(d);
      for (int k = 0; k < 4; ++k) {
        const auto w = hn::Set(d, weight(k, t));
        const std::ptrdiff_t node = static_cast<std::ptrdiff_t>(k) * job.node_stride + first + i;
        p = hn::Add(p, hn::Mul(w, hn::LoadU(d, job.node_phi + node)));
        q = hn::Add(q, hn::Mul(w, hn::LoadU(d, job.node_a + node)));
      }
      hn::Store(p, d, phi + i);
      hn::Store(q, d, a + i);
    }
    for (int c = 0; c < std::min(kBatch, job.cells - first); ++c) {
      for (int i = 0; i < kCell; i += lanes) {
        auto p = hn::Zero(d), q = hn::Zero(d);
        for (int k = 0; k < 4; ++k) {
          const auto w = hn::Load(d, across.w[k] + i);
          p = hn::Add(p, hn::Mul(w, hn::Set(d, phi[c + k])));
          q = hn::Add(q, hn::Mul(w, hn::Set(d, a[c + k])));
        }
        const std::ptrdiff_t at = static_cast<std::ptrdiff_t>(first + c) * kCell + i;
        const auto whole = hn::Min(hn::Max(hn::NearestInt(p), hn::Zero(di)), hn::Set(di, 65534));
        hn::StoreU(hn::DemoteTo(d16, whole), d16, job.phi + at);
        hn::StoreU(q, d, job.a + at);
      }
    }
  }
}

void MapRow(const MapJob& job, const std::uint16_t* phi, const float* a, int count,
            std::int32_t* base, float* residual) {
  const hn::ScalableTag<float> df;
  const hn::RebindToSigned<decltype(df)> di;
  const hn::Rebind<std::uint16_t, decltype(df)> du16;
  const int lanes = static_cast<int>(hn::Lanes(df));
  const std::int32_t* HWY_RESTRICT origin = job.origin;
  HWY_ALIGN std::int32_t rows[HWY_MAX_BYTES / 4];
  for (int x = 0; x < count; x += lanes) {
    const auto p = hn::PromoteTo(di, hn::LoadU(du16, phi + x));
    const auto row = hn::NearestInt(hn::Add(
        hn::Mul(hn::ConvertTo(df, p), hn::Set(df, job.row_scale)), hn::Set(df, job.row_offset)));
    hn::Store(hn::Min(hn::Max(row, hn::Zero(di)), hn::Set(di, job.rows - 1)), di, rows);
    const auto slope = hn::Mul(hn::ConvertTo(df, Count(di, x)), hn::Set(df, job.guess_x));
    const auto column = hn::Add(hn::Mul(hn::LoadU(df, a + x), hn::Set(df, job.to_column)),
                                hn::Add(slope, hn::Set(df, job.guess)));
    const auto pattern = hn::And(
        hn::Add(hn::Mul(Count(di, x), hn::Set(di, kDitherX)), hn::Set(di, job.dither_phase)),
        hn::Set(di, 255));
    const auto dither = hn::Mul(hn::ConvertTo(df, hn::Sub(pattern, hn::Set(di, 128))),
                                hn::Set(df, job.dither / 256.0f));
    const auto whole = hn::NearestInt(hn::Add(column, dither));
    const auto none = hn::Eq(p, hn::Set(di, kNoRay));
    const auto gap = hn::Sub(hn::ConvertTo(df, whole), column);
    hn::StoreU(hn::IfThenZeroElse(hn::RebindMask(df, none), gap), df, residual + x);
    // Neighbours share a row of cells or two.
    const auto clamped = hn::Load(di, rows);
    const auto one = hn::Eq(clamped, hn::Set(di, rows[0]));
    const auto two = hn::Eq(clamped, hn::Set(di, rows[lanes - 1]));
    auto begin = hn::Set(di, origin[rows[0]]);
    if (!hn::AllTrue(di, one)) {
      begin = hn::IfThenElse(one, begin, hn::Set(di, origin[rows[lanes - 1]]));
      if (!hn::AllTrue(di, hn::Or(one, two))) {
        for (int i = 0; i < lanes; ++i) rows[i] = origin[rows[i]];
        begin = hn::Load(di, rows);
      }
    }
    // Where there is no ray, and in a stray halo, any cell will do.
    const auto cell = hn::Min(hn::Max(hn::Add(begin, whole), hn::Zero(di)), hn::Set(di, job.cells));
    hn::StoreU(hn::IfThenZeroElse(none, cell), di, base + x);
  }
}

void BoxColumns(const float* in, int stride, int width, int height, float* HWY_RESTRICT out) {
  const hn::ScalableTag<float> d;
  const int lanes = static_cast<int>(hn::Lanes(d));
  for (int x = 0; x < width; x += lanes) {
    auto sum = hn::Zero(d);
    for (int k = 0; k < kWindow - 1; ++k) sum = hn::Add(sum, hn::LoadU(d, in + k * stride + x));
    for (int y = 0; y < height; ++y) {
      sum = hn::Add(sum, hn::LoadU(d, in + (y + kWindow - 1) * stride + x));
      hn::StoreU(sum, d, out + y * stride + x);
      sum = hn::Sub(sum, hn::LoadU(d, in + y * stride + x));
    }
  }
}

void BoxMeanRow(const float* line, int count, float* HWY_RESTRICT out) {
  const hn::ScalableTag<float> d;
  const int lanes = static_cast<int>(hn::Lanes(d));
  const auto scale = hn::Set(d, 1.0f / (kWindow * kWindow));
  for (int x = 0; x < count; x += lanes) {
    auto sum = hn::LoadU(d, line + x);
    for (int k = 1; k < kWindow; ++k) sum = hn::Add(sum, hn::LoadU(d, line + x + k));
    hn::StoreU(hn::Mul(sum, scale), d, out + x);
  }
}

}  // namespace HWY_NAMESPACE
}  // namespace omnister::sweep
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace omnister::sweep {

HWY_EXPORT(MatchChunk);
HWY_EXPORT(MapCells);
HWY_EXPORT(MapRow);
HWY_EXPORT(BoxColumns);
HWY_EXPORT(BoxMeanRow);

void mapCells(const MapCellsJob& job) { HWY_DYNAMIC_DISPATCH(MapCells)(job); }

void mapRow(const MapJob& job, const std::uint16_t* phi, const float* a, int count,
            std::int32_t* base, float* residual) {
  HWY_DYNAMIC_DISPATCH(MapRow)(job, phi, a, count, base, residual);
}

void boxColumns(const float* in, int stride, int width, int height, float* out) {
  HWY_DYNAMIC_DISPATCH(BoxColumns)(in, stride, width, height, out);
}

void boxMeanRow(const float* line, int count, float* out) {
  HWY_DYNAMIC_DISPATCH(BoxMeanRow)(line, count, out);
}

void matchChunk(const ChunkJob& job) { HWY_DYNAMIC_DISPATCH(MatchChunk)(job); }

}  // namespace omnister::sweep
#endif  // HWY_ONCE
