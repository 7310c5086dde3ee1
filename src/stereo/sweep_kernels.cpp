// SPDX-License-Identifier: Apache-2.0
#include "sweep_kernels.h"

#include <hwy/cache_control.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>

#include "omnister/common/error.h"
#include "sweep_geometry.h"

// The AVX-512 of Ice Lake and Zen 4, with its population count of bytes, is only built when asked
// for.
#define HWY_WANT_AVX3_DL
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "src/stereo/sweep_kernels.cpp"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace omnister::sweep {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

void SmoothRows(const cv::Mat& image, PaddedImage* out, int begin, int end) {
  const int width = image.cols, height = image.rows;
  std::vector<std::uint16_t> line(width + 2);
  for (int y = begin; y < end; ++y) {
    const std::uint8_t* above = image.ptr(std::max(y - 1, 0));
    const std::uint8_t* here = image.ptr(y);
    const std::uint8_t* below = image.ptr(std::min(y + 1, height - 1));
    std::uint16_t* HWY_RESTRICT column = line.data() + 1;
    // 43 170 43 of 256 both ways; the vertical sum keeps 8 bits below the point.
    for (int x = 0; x < width; ++x)
      column[x] = static_cast<std::uint16_t>(43 * (above[x] + below[x]) + 170 * here[x]);
    column[-1] = column[0];
    column[width] = column[width - 1];
    std::uint8_t* HWY_RESTRICT to = out->row(y);
    for (int x = 0; x < width; ++x) {
      to[x] = static_cast<std::uint8_t>(
          (43u * (column[x - 1] + column[x + 1]) + 170u * column[x] + 32768u) >> 16);
    }
    std::memset(to - PaddedImage::kPad, to[0], PaddedImage::kPad);
    std::memset(to + width, to[width - 1], out->stride - PaddedImage::kPad - width);
  }
}

void HalveRows(const PaddedImage& image, PaddedImage* out, int begin, int end) {
  for (int y = begin; y < end; ++y) {
    const std::uint8_t* HWY_RESTRICT a = image.row(2 * y);
    const std::uint8_t* HWY_RESTRICT b = image.row(2 * y + 1);
    std::uint8_t* HWY_RESTRICT to = out->row(y);
    for (int x = 0; x < out->width; ++x)
      to[x] =
          static_cast<std::uint8_t>((a[2 * x] + a[2 * x + 1] + b[2 * x] + b[2 * x + 1] + 2) >> 2);
    std::memset(to - PaddedImage::kPad, to[0], PaddedImage::kPad);
    std::memset(to + out->width, to[out->width - 1], out->stride - PaddedImage::kPad - out->width);
  }
}

/// x, x + 1, and so on. Iota of a variable is put together in memory, lane by lane.
template <class D>
HWY_INLINE hn::Vec<D> Count(D d, int x) {
  HWY_ALIGN static constexpr std::int32_t kFirst[16] = {0, 1, 2,  3,  4,  5,  6,  7,
                                                        8, 9, 10, 11, 12, 13, 14, 15};
  return hn::Add(hn::Load(d, kFirst), hn::Set(d, x));
}

// Vector gathers are slow on many processors: addresses are computed by vectors, memory is read by
// plain loads, and vectors go on with what was read.

void SampleRow(const PaddedImage& image, const float* x, const float* y, const std::uint8_t* mask,
               int runs, std::uint8_t* grey) {
  constexpr int kBatch = 32;  // runs
  const hn::CappedTag<std::int32_t, 8> d;
  const hn::Rebind<std::uint16_t, decltype(d)> d16;
  const int lanes = static_cast<int>(hn::Lanes(d));
  const hn::CappedTag<std::int16_t, 32> dv16;
  const hn::RebindToUnsigned<decltype(dv16)> du16;
  const hn::Rebind<std::uint8_t, decltype(dv16)> d8;
  const int lanes16 = static_cast<int>(hn::Lanes(dv16));
  const std::ptrdiff_t stride = image.stride;
  const std::uint8_t* corner = image.row(0) - PaddedImage::kPad * (stride + 1);
  struct Batch {
    HWY_ALIGN std::int32_t at[kBatch * 8];
    HWY_ALIGN std::uint16_t fu[kBatch * 8], fv[kBatch * 8];
  };
  Batch batches[2];
  HWY_ALIGN std::uint16_t upper[kBatch * 8], lower[kBatch * 8];

  const auto address = [&](int begin, Batch* batch) {
    const int count = std::min(kBatch, runs - begin);
    for (int n = 0; n < count; ++n) {
      const int run = begin + n;
      // 16 bits below the point, of which 7 are used, rounded; counted from the corner of the
      // padding so that all are positive.
      constexpr float kOne = 65536.0f;
      const bool seen = mask[run] != 0;
      const auto u0 =
          static_cast<std::int32_t>(seen ? (x[run] + PaddedImage::kPad) * kOne + 256.0f : 0.0f);
      const auto v0 =
          static_cast<std::int32_t>(seen ? (y[run] + PaddedImage::kPad) * kOne + 256.0f : 0.0f);
      const auto du = static_cast<std::int32_t>(seen ? (x[run + 1] - x[run]) * (kOne / 8) : 0.0f);
      const auto dv = static_cast<std::int32_t>(seen ? (y[run + 1] - y[run]) * (kOne / 8) : 0.0f);
      for (int i = 0; i < 8; i += lanes) {
        const auto step = Count(d, i);
        auto u = hn::Add(hn::Set(d, u0), hn::Mul(step, hn::Set(d, du)));
        auto v = hn::Add(hn::Set(d, v0), hn::Mul(step, hn::Set(d, dv)));
        if (mask[run] != 0xFF) {
          // Cells that the mask leaves out may lie anywhere: they ask for the first pixel.
          const auto bit = hn::And(hn::Shr(hn::Set(d, mask[run]), step), hn::Set(d, 1));
          const auto inside = hn::Ne(bit, hn::Zero(d));
          u = hn::IfThenElseZero(inside, u);
          v = hn::IfThenElseZero(inside, v);
        }
        hn::Store(hn::Add(hn::Mul(hn::ShiftRight<16>(v), hn::Set(d, image.stride)),
                          hn::ShiftRight<16>(u)),
                  d, batch->at + n * 8 + i);
        const auto low = hn::Set(d, 127);
        hn::Store(hn::DemoteTo(d16, hn::And(hn::ShiftRight<9>(u), low)), d16,
                  batch->fu + n * 8 + i);
        hn::Store(hn::DemoteTo(d16, hn::And(hn::ShiftRight<9>(v), low)), d16,
                  batch->fv + n * 8 + i);
      }
      hwy::Prefetch(corner + batch->at[n * 8 + 4]);
      hwy::Prefetch(corner + batch->at[n * 8 + 4] + stride);
    }
  };

  address(0, &batches[0]);
  for (int begin = 0, turn = 0; begin < runs; begin += kBatch, grey += kBatch * 8, turn ^= 1) {
    if (begin + kBatch < runs) address(begin + kBatch, &batches[turn ^ 1]);
    const Batch& batch = batches[turn];
    const int count = std::min(kBatch, runs - begin);
    for (int i = 0; i < count * 8; ++i) {
      std::memcpy(&upper[i], corner + batch.at[i], 2);
      std::memcpy(&lower[i], corner + batch.at[i] + stride, 2);
    }
    // The last vectors may go past the batch, into what earlier ones left: it is not used.
    for (int i = 0; i < count * 8; i += lanes16) {
      const auto wu = hn::Load(du16, batch.fu + i);
      const auto across = [&](const std::uint16_t* pairs) {
        const auto pair = hn::Load(du16, pairs + i);
        const auto p = hn::And(pair, hn::Set(du16, 0xFF)), q = hn::ShiftRight<8>(pair);
        return hn::BitCast(dv16, hn::Add(hn::ShiftLeft<7>(p), hn::Mul(hn::Sub(q, p), wu)));
      };
      const auto top = across(upper), bottom = across(lower);
      const auto wv = hn::BitCast(dv16, hn::ShiftLeft<8>(hn::Load(du16, batch.fv + i)));
      const auto value = hn::Add(top, hn::MulFixedPoint15(hn::Sub(bottom, top), wv));
      const auto rounded = hn::ShiftRight<7>(hn::Add(value, hn::Set(dv16, 64)));
      const auto bytes = hn::DemoteTo(d8, hn::Max(rounded, hn::Set(dv16, 1)));
      if (i + lanes16 <= count * 8) {
        hn::StoreU(bytes, d8, grey + i);
      } else {
        HWY_ALIGN std::uint8_t last[64];
        hn::StoreU(bytes, d8, last);
        std::memcpy(grey + i, last, count * 8 - i);
      }
    }
    for (int n = 0; n < count; ++n) {
      if (mask[begin + n] == 0xFF) continue;
      for (int i = 0; i < 8; ++i)
        if (!(mask[begin + n] >> i & 1)) grey[n * 8 + i] = 0;
    }
  }
}

void CensusRow(const std::uint8_t* const rows[5], int count, std::uint8_t* const out[kPlanes]) {
  const std::uint8_t* HWY_RESTRICT centre = rows[2];
  int bit = 0;
  for (int plane = 0; plane < kPlanes; ++plane) {
    const std::uint8_t* neighbour[8];
    for (int i = 0; i < 8; ++i, ++bit) {
      const int position = bit < 12 ? bit : bit + 1;
      neighbour[i] = rows[position / 5] + position % 5 - 2;
    }
    std::uint8_t* HWY_RESTRICT to = out[plane];
    const hn::ScalableTag<std::uint8_t> d;
    const int lanes = static_cast<int>(hn::Lanes(d));
    int x = 0;
    for (; x + lanes <= count; x += lanes) {
      const auto c = hn::LoadU(d, centre + x);
      auto bits = hn::Zero(d);
      for (int i = 0; i < 8; ++i) {
        // a > c is a saturating difference that is not zero.
        const auto more = hn::Gt(hn::LoadU(d, neighbour[i] + x), c);
        bits =
            hn::Or(bits, hn::IfThenElseZero(more, hn::Set(d, static_cast<std::uint8_t>(1u << i))));
      }
      // A cell that sees nothing has no structure, lest the edge of the field be matched.
      hn::StoreU(hn::IfThenZeroElse(hn::Eq(c, hn::Zero(d)), bits), d, to + x);
    }
    for (; x < count; ++x) {
      unsigned bits = 0;
      for (int i = 0; i < 8; ++i) bits |= (neighbour[i][x] > centre[x] ? 1u : 0u) << i;
      to[x] = static_cast<std::uint8_t>(centre[x] == 0 ? 0 : bits);
    }
  }
}

void WidenBlock(const PaddedImage& image, int x0, int y0, int width, int height,
                std::int16_t* HWY_RESTRICT out, int stride) {
  for (int y = 0; y < height; ++y, out += stride) {
    const std::uint8_t* HWY_RESTRICT from = image.row(y0 + y) + x0;
    for (int x = 0; x < width; ++x) out[x] = static_cast<std::int16_t>(from[x] << 7);
  }
}

template <int kWide>
void CensusWide(const std::int16_t* grey, int grey_stride, int width, int height,
                const CensusOffsets& offsets, std::uint8_t* const out[kPlanes], int stride) {
  std::ptrdiff_t shift[kBits];
  std::int16_t fu[kBits], fv[kBits];
  for (int i = 0; i < kBits; ++i) {
    const float ix = std::floor(offsets.dx[i]), iy = std::floor(offsets.dy[i]);
    shift[i] = static_cast<std::ptrdiff_t>(iy) * grey_stride + static_cast<std::ptrdiff_t>(ix);
    fu[i] = static_cast<std::int16_t>((offsets.dx[i] - ix) * 32767.0f);
    fv[i] = static_cast<std::int16_t>((offsets.dy[i] - iy) * 32767.0f);
  }
  const hn::CappedTag<std::int16_t, kWide> d;
  const hn::Rebind<std::uint8_t, decltype(d)> d8;
  const int lanes = static_cast<int>(hn::Lanes(d));
  for (int y = 0; y < height; ++y) {
    // The last vector of a row may reach past it; the caller leaves room.
    for (int x = 0; x < width; x += lanes) {
      const std::int16_t* HWY_RESTRICT here =
          grey + static_cast<std::ptrdiff_t>(y) * grey_stride + x;
      const auto c = hn::LoadU(d, here);
      for (int plane = 0; plane < kPlanes; ++plane) {
        auto bits = hn::Zero(d);
        for (int i = 0; i < 8; ++i) {
          const int n = plane * 8 + i;
          const std::int16_t* HWY_RESTRICT p = here + shift[n];
          const auto wu = hn::Set(d, fu[n]), wv = hn::Set(d, fv[n]);
          const auto a0 = hn::LoadU(d, p), b0 = hn::LoadU(d, p + grey_stride);
          const auto a = hn::Add(a0, hn::MulFixedPoint15(hn::Sub(hn::LoadU(d, p + 1), a0), wu));
          const auto b =
              hn::Add(b0, hn::MulFixedPoint15(hn::Sub(hn::LoadU(d, p + grey_stride + 1), b0), wu));
          const auto value = hn::Add(a, hn::MulFixedPoint15(hn::Sub(b, a), wv));
          bits = hn::Or(bits, hn::IfThenElseZero(hn::Gt(value, c),
                                                 hn::Set(d, static_cast<std::int16_t>(1 << i))));
        }
        hn::StoreU(hn::DemoteTo(d8, bits), d8, out[plane] + y * stride + x);
      }
    }
  }
}

void CensusBlock(const std::int16_t* grey, int grey_stride, int width, int height,
                 const CensusOffsets& offsets, bool narrow, std::uint8_t* const out[kPlanes],
                 int stride) {
  if (narrow)
    CensusWide<16>(grey, grey_stride, width, height, offsets, out, stride);
  else
    CensusWide<32>(grey, grey_stride, width, height, offsets, out, stride);
}

/// Least lane of a vector of at most 32.
template <class D, class V>
HWY_INLINE std::uint16_t LeastLane(D d, V v) {
#if HWY_TARGET == HWY_SCALAR
  static_cast<void>(d);
  return hn::GetLane(v);
#else
  if constexpr (hn::MaxLanes(D()) > 8) {
    const hn::Half<D> half;
    return LeastLane(half, hn::Min(hn::LowerHalf(half, v), hn::UpperHalf(half, v)));
  } else {
#if HWY_TARGET <= HWY_SSE4 && HWY_ARCH_X86
    static_cast<void>(d);
    return static_cast<std::uint16_t>(_mm_cvtsi128_si32(_mm_minpos_epu16(v.raw)));
#else
    return hn::GetLane(hn::MinOfLanes(d, v));
#endif
  }
#endif
}

template <int kLanes, bool kFirst>
void MatchLanes(const ChunkJob& job) {
  constexpr int kRowWidth = 128;
  constexpr int kAhead = 3;  // rows
  const int width = job.width, height = job.height, stride = job.stride;
  const int tile_width = width - 2 * kRadius;
  const std::size_t line = static_cast<std::size_t>(width) * kLanes;
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

  const hn::CappedTag<std::uint8_t, kLanes> d8;
  const hn::CappedTag<std::uint16_t, kLanes> d16;
  const hn::Rebind<std::uint8_t, decltype(d16)> d8h;
  constexpr std::size_t n8 = hn::MaxLanes(decltype(d8)());
  constexpr std::size_t n16 = hn::MaxLanes(decltype(d16)());
  HWY_ALIGN std::uint16_t lane_index[kLanes];
  for (int i = 0; i < kLanes; ++i)
    lane_index[i] = (i == 0 || i == kLanes - 1) ? 0xFFFF : static_cast<std::uint16_t>(i);

  HWY_ALIGN std::uint16_t boxes[kRowWidth * kLanes];
  HWY_ALIGN std::uint16_t packed[kRowWidth];
  for (int y = 0; y < height; ++y) {
    std::uint8_t* HWY_RESTRICT old = ring + static_cast<std::size_t>(y % kWindow) * line;
    const std::size_t row = static_cast<std::size_t>(y) * stride;
    if (y + kAhead < height) {
      // Cells of rows to come: the processor does not see these leaps coming.
      for (int x = 0; x < width; x += 32) {
        const std::ptrdiff_t base = bases[row + static_cast<std::size_t>(kAhead) * stride + x];
        hwy::Prefetch(cells0 + base);
        hwy::Prefetch(cells1 + base);
        hwy::Prefetch(cells2 + base);
      }
    }
    for (int x = 0; x < width; ++x) {
      const std::size_t pixel = row + x;
      const std::ptrdiff_t base = bases[pixel];
      for (std::size_t l = 0; l < kLanes; l += n8) {
        const auto cost0 = hn::PopulationCount(
            hn::Xor(hn::LoadU(d8, cells0 + base + l), hn::Set(d8, reference0[pixel])));
        const auto cost1 = hn::PopulationCount(
            hn::Xor(hn::LoadU(d8, cells1 + base + l), hn::Set(d8, reference1[pixel])));
        const auto cost2 = hn::PopulationCount(
            hn::Xor(hn::LoadU(d8, cells2 + base + l), hn::Set(d8, reference2[pixel])));
        const auto cost = hn::Add(hn::Add(cost0, cost1), cost2);
        const std::size_t at = static_cast<std::size_t>(x) * kLanes + l;
        const auto sum = hn::LoadU(d8, sums + at);
        hn::StoreU(hn::Add(sum, hn::Sub(cost, hn::LoadU(d8, old + at))), d8, sums + at);
        hn::StoreU(cost, d8, old + at);
      }
    }
    if (y < kWindow - 1) continue;
    for (std::size_t l = 0; l < kLanes; l += n16) {
      const auto index = hn::Load(d16, lane_index + l);
      auto sum = hn::Zero(d16);
      for (int x = 0; x < kWindow - 1; ++x)
        sum = hn::Add(sum, hn::PromoteTo(d16, hn::LoadU(d8h, sums + x * kLanes + l)));
      for (int x = 0; x < tile_width; ++x) {
        const std::uint8_t* HWY_RESTRICT gone = sums + static_cast<std::size_t>(x) * kLanes + l;
        sum = hn::Add(sum, hn::PromoteTo(d16, hn::LoadU(d8h, gone + (kWindow - 1) * kLanes)));
        hn::Store(sum, d16, boxes + static_cast<std::size_t>(x) * kLanes + l);
        const std::uint16_t least = LeastLane(d16, hn::Or(hn::ShiftLeft<5>(sum), index));
        packed[x] = l == 0 ? least : std::min(packed[x], least);
        sum = hn::Sub(sum, hn::PromoteTo(d16, hn::LoadU(d8h, gone)));
      }
    }
    const std::size_t out = static_cast<std::size_t>(y - kWindow + 1) * tile_width;
    std::uint16_t* HWY_RESTRICT cost = job.cost + out;
    std::int16_t* HWY_RESTRICT index = job.index + out;
    std::uint16_t* HWY_RESTRICT before = job.before + out;
    std::uint16_t* HWY_RESTRICT after = job.after + out;
    const int first = job.first;
    for (int x = 0; x < tile_width; ++x) {
      const std::uint16_t c = packed[x] >> 5;
      if (!kFirst && c >= cost[x]) continue;
      const int lane = packed[x] & 31;
      cost[x] = c;
      index[x] = static_cast<std::int16_t>(first + lane);
      before[x] = boxes[x * kLanes + lane - 1];
      after[x] = boxes[x * kLanes + lane + 1];
    }
  }
}

void MatchChunk(const ChunkJob& job) {
  if (job.lanes == 16 && job.fresh)
    MatchLanes<16, true>(job);
  else if (job.lanes == 16)
    MatchLanes<16, false>(job);
  else if (job.fresh)
    MatchLanes<32, true>(job);
  else
    MatchLanes<32, false>(job);
}

// Polynomials in place of the library's functions: the same bits whatever the instruction set.

/// Sine on [0, pi], to 1e-7.
template <class D, class V>
HWY_INLINE V SineUpper(D d, V x) {
  const V y = hn::Sub(x, hn::Set(d, 1.57079633f));
  const V s = hn::Mul(y, y);
  V r = hn::Set(d, 2.0876757e-9f);
  r = hn::Add(hn::Mul(r, s), hn::Set(d, -2.7557319e-7f));
  r = hn::Add(hn::Mul(r, s), hn::Set(d, 2.4801587e-5f));
  r = hn::Add(hn::Mul(r, s), hn::Set(d, -1.3888889e-3f));
  r = hn::Add(hn::Mul(r, s), hn::Set(d, 4.1666668e-2f));
  r = hn::Add(hn::Mul(r, s), hn::Set(d, -0.5f));
  return hn::Add(hn::Mul(r, s), hn::Set(d, 1.0f));
}

/// Sine near zero, to 1e-7 of itself up to 1.5.
template <class D, class V>
HWY_INLINE V SineSmall(D d, V x) {
  const V s = hn::Mul(x, x);
  V r = hn::Set(d, 1.6059044e-10f);
  r = hn::Add(hn::Mul(r, s), hn::Set(d, -2.5052108e-8f));
  r = hn::Add(hn::Mul(r, s), hn::Set(d, 2.7557319e-6f));
  r = hn::Add(hn::Mul(r, s), hn::Set(d, -1.9841270e-4f));
  r = hn::Add(hn::Mul(r, s), hn::Set(d, 8.3333333e-3f));
  r = hn::Add(hn::Mul(r, s), hn::Set(d, -0.16666667f));
  return hn::Add(hn::Mul(hn::Mul(r, s), x), x);
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

void ConcludeRow(ConcludeJob* in_out) {
  ConcludeJob& job = *in_out;
  const hn::ScalableTag<float> df;
  const hn::RebindToSigned<decltype(df)> di;
  const hn::Rebind<std::uint16_t, decltype(df)> du16;
  const hn::Rebind<std::int16_t, decltype(df)> di16;
  const int lanes = static_cast<int>(hn::Lanes(df));
  const auto load = [&](const std::uint16_t* p) {
    return hn::ConvertTo(df, hn::PromoteTo(di, hn::LoadU(du16, p)));
  };
  HWY_ALIGN std::int32_t words[HWY_MAX_BYTES / 4];
  for (int x = 0; x < job.count; x += lanes) {
    const auto c = load(job.cost + x), before = load(job.before + x), after = load(job.after + x);
    const auto k = hn::PromoteTo(di, hn::LoadU(di16, job.index + x));
    const auto steep = hn::Sub(hn::Max(before, after), c);
    const auto cell = hn::Add(hn::LoadU(di, job.base + x), k);
    const auto phi = hn::PromoteTo(di, hn::LoadU(du16, job.phi + x));
    auto good = hn::Ne(phi, hn::Set(di, kNoRay));
    if (job.mask) {
      const auto legal =
          hn::And(hn::Gt(cell, hn::Set(di, -1)), hn::Lt(cell, hn::Set(di, job.cells)));
      const auto safe = hn::IfThenElseZero(legal, cell);
      hn::Store(safe, di, words);
      for (int i = 0; i < lanes; ++i) words[i] = job.mask[words[i] >> 3];
      const auto bit =
          hn::And(hn::Shr(hn::Load(di, words), hn::And(safe, hn::Set(di, 7))), hn::Set(di, 1));
      good = hn::And(good, hn::And(legal, hn::Eq(bit, hn::Set(di, 1))));
    }
    auto fine = hn::And(hn::RebindMask(df, good), hn::Gt(steep, hn::Zero(df)));
    // The least at the end of an interval is the foot of one beyond it.
    fine = hn::And(fine, hn::And(hn::Ge(before, c), hn::Ge(after, c)));
    fine = hn::And(fine, hn::Le(c, hn::Set(df, job.worst_cost)));
    // The pixels of a window fall between columns, each elsewhere: their sum is rounder than two
    // lines and sharper than a parabola. With this gain a shift of all columns leaves no bias.
    constexpr float kGain = 0.62f;
    const auto shift =
        hn::Div(hn::Mul(hn::Sub(before, after), hn::Set(df, kGain)),
                hn::Max(hn::Sub(hn::Add(before, after), hn::Add(c, c)), hn::Set(df, 1.0f)));
    const auto guess = hn::Add(hn::Mul(hn::ConvertTo(df, Count(di, x)), hn::Set(df, job.guess_x)),
                               hn::Set(df, job.guess));
    const auto columns =
        hn::Add(hn::Add(hn::ConvertTo(df, k), shift), hn::LoadU(df, job.residual + x));
    const auto h = hn::Mul(hn::Add(columns, guess), hn::Set(df, job.step_h));
    hn::StoreU(hn::IfThenElse(fine, h, hn::NaN(df)), df, job.h + x);
    if (job.steep) {
      hn::StoreU(hn::DemoteTo(du16, hn::ConvertTo(di, hn::Max(steep, hn::Zero(df)))), du16,
                 job.steep + x);
    }
    if (job.claim) {
      const auto theta = hn::Add(hn::LoadU(df, job.a + x), h);
      const auto angle =
          hn::Sub(hn::Mul(hn::ConvertTo(df, phi), hn::Set(df, static_cast<float>(1.0 / kPhiUnits))),
                  hn::Set(df, 3.14159265f));
      const auto u = hn::NearestInt(hn::Mul(theta, hn::Set(df, job.claim_x)));
      const auto v = hn::NearestInt(
          hn::Sub(hn::Mul(hn::Mul(angle, SineUpper(df, theta)), hn::Set(df, job.claim_y)),
                  hn::Set(df, job.claim_y_offset)));
      const auto column = hn::Min(hn::Max(u, hn::Zero(di)), hn::Set(di, job.claim_width - 1));
      const auto row = hn::Min(hn::Max(v, hn::Zero(di)), hn::Set(di, job.claim_height - 1));
      const auto at = hn::Add(hn::Mul(row, hn::Set(di, job.claim_width)), column);
      const auto counted =
          hn::And(hn::RebindMask(di, fine), hn::Lt(Count(di, x), hn::Set(di, job.count)));
      hn::StoreU(hn::IfThenElse(counted, at, hn::Set(di, -1)), di, job.claim + x);
    }
  }
}

/// Where pixels claim, and with what hypothesis.
template <class DI>
HWY_INLINE void Claim(DI di, const ClaimJob& job, int x, hn::Vec<DI>* at, hn::Vec<DI>* units) {
  const hn::RebindToFloat<DI> df;
  const auto claim = hn::LoadU(di, job.claim + x);
  const auto made =
      hn::And(hn::Gt(claim, hn::Set(di, -1)), hn::Lt(Count(di, x), hn::Set(di, job.count)));
  // Those that claim nothing go each to an element of its own, so that none waits.
  *at = hn::IfThenElse(made, claim, Count(di, job.none));
  // An offset, so that small negative hypotheses can be told.
  const auto counted = hn::NearestInt(
      hn::Add(hn::Mul(hn::LoadU(df, job.h + x), hn::Set(df, job.units)), hn::Set(df, 64.0f)));
  *units = hn::Min(hn::Max(counted, hn::Zero(di)), hn::Set(di, 0x7FFF));
}

void ClaimRow(const ClaimJob& job) {
  const hn::ScalableTag<std::int32_t> di;
  const hn::Rebind<std::uint16_t, decltype(di)> du16;
  const int lanes = static_cast<int>(hn::Lanes(di));
  HWY_ALIGN std::int32_t at[HWY_MAX_BYTES / 4], value[HWY_MAX_BYTES / 4];
  std::int32_t* HWY_RESTRICT claims = job.claims;
  for (int x = 0; x < job.count; x += lanes) {
    hn::Vec<decltype(di)> element, units;
    Claim(di, job, x, &element, &units);
    const auto cost = hn::PromoteTo(di, hn::LoadU(du16, job.cost + x));
    hn::Store(element, di, at);
    hn::Store(hn::Or(hn::ShiftLeft<16>(cost), units), di, value);
    for (int i = 0; i < lanes; ++i) {
      // The lesser of two that are not negative, without a branch that half would take wrongly.
      const std::int32_t less = value[i] - claims[at[i]];
      claims[at[i]] += less & (less >> 31);
    }
  }
}

void RejectRow(RejectJob* in_out) {
  RejectJob& job = *in_out;
  const hn::ScalableTag<float> df;
  const hn::RebindToSigned<decltype(df)> di;
  const hn::Rebind<std::uint16_t, decltype(df)> du16;
  const int lanes = static_cast<int>(hn::Lanes(df));
  constexpr int kReach = RejectJob::kReach;
  const int count = job.claimed.count;
  const auto jump = hn::Set(df, job.jump);
  const auto cost = [&](int row, int x) {
    return hn::PromoteTo(di, hn::LoadU(du16, job.cost[row] + x));
  };
  const std::int32_t* HWY_RESTRICT claims = job.claimed.claims;
  HWY_ALIGN std::int32_t at[HWY_MAX_BYTES / 4];
  for (int x = 0; x < count; x += lanes) {
    const auto h = hn::LoadU(df, job.h[1] + x);
    const auto known =
        hn::And(hn::RebindMask(df, hn::Lt(Count(di, x), hn::Set(di, count))), hn::Eq(h, h));
    hn::Vec<decltype(di)> element, mine;
    Claim(di, job.claimed, x, &element, &mine);
    hn::Store(element, di, at);
    for (int i = 0; i < lanes; ++i) at[i] = claims[at[i]];
    const auto theirs = hn::And(hn::Load(di, at), hn::Set(di, 0xFFFF));
    const auto apart = hn::Gt(hn::Abs(hn::Sub(theirs, mine)), hn::Set(di, job.tolerance));
    const auto lost = hn::And(known, hn::RebindMask(df, apart));

    const auto side = [&](int row, int dx) { return hn::LoadU(df, job.h[row] + x + dx); };
    const auto up = side(0, 0), down = side(2, 0);
    const auto left = side(1, -kReach), right = side(1, kReach);
    // Comparisons with NaN are false.
    const auto beyond = [&](decltype(h) other) { return hn::Gt(hn::Sub(h, other), jump); };
    auto edge = hn::Or(hn::Or(beyond(up), beyond(down)), hn::Or(beyond(left), beyond(right)));
    if (!hn::AllFalse(df, edge)) {
      // More than 1.3 times and another kMore.
      constexpr int kMore = 40;
      const auto own = hn::Mul(hn::Sub(cost(1, x), hn::Set(di, kMore)), hn::Set(di, 10));
      const auto dear = [&](decltype(h) outside, decltype(h) inside, int row, int dx) {
        const auto same = hn::Lt(hn::Abs(hn::Sub(inside, h)), jump);
        const auto more = hn::Gt(own, hn::Mul(cost(row, x + dx), hn::Set(di, 13)));
        return hn::And(hn::And(beyond(outside), same), hn::RebindMask(df, more));
      };
      edge = hn::Or(hn::Or(dear(up, down, 2, 0), dear(down, up, 0, 0)),
                    hn::Or(dear(left, right, 1, kReach), dear(right, left, 1, -kReach)));
    }
    edge = hn::AndNot(lost, hn::And(known, edge));
    hn::StoreU(hn::IfThenElse(hn::Or(lost, edge), hn::NaN(df), h), df, job.out + x);
    job.found += hn::CountTrue(df, known);
    job.lost += hn::CountTrue(df, lost);
    job.edge += hn::CountTrue(df, edge);
  }
}

/// Stores the first `count` lanes, for rows that end where another begins.
template <class D>
HWY_INLINE void StoreFront(D d, hn::Vec<D> v, float* to, int count) {
  if (count >= static_cast<int>(hn::Lanes(d))) {
    hn::StoreU(v, d, to);
  } else {
    HWY_ALIGN float last[HWY_MAX_BYTES / sizeof(float)];
    hn::Store(v, d, last);
    std::copy(last, last + count, to);
  }
}

void MedianRow(const float* const rows[3], int count, float* HWY_RESTRICT out) {
  const hn::ScalableTag<float> d;
  const int lanes = static_cast<int>(hn::Lanes(d));
  for (int x = 0; x < count; x += lanes) {
    const auto middle = hn::LoadU(d, rows[1] + x);
    const auto load = [&](int row, int dx) {
      const auto v = hn::LoadU(d, rows[row] + x + dx);
      return hn::IfThenElse(hn::IsNaN(v), middle, v);
    };
    auto a = load(0, -1), b = load(0, 0), c = load(0, 1);
    auto e = load(1, -1), f = middle, g = load(1, 1);
    auto i = load(2, -1), j = load(2, 0), k = load(2, 1);
    const auto sort = [](auto& p, auto& q) {
      const auto low = hn::Min(p, q);
      q = hn::Max(p, q);
      p = low;
    };
    // Paeth's network of 19 exchanges (Graphics Gems, 1990).
    sort(b, c);
    sort(f, g);
    sort(j, k);
    sort(a, b);
    sort(e, f);
    sort(i, j);
    sort(b, c);
    sort(f, g);
    sort(j, k);
    i = hn::Max(hn::Max(a, e), i);
    c = hn::Min(hn::Min(c, g), k);
    sort(f, j);
    f = hn::Max(b, f);
    f = hn::Min(f, j);
    sort(f, c);
    f = hn::Max(i, f);
    f = hn::Min(f, c);
    StoreFront(d, hn::IfThenElse(hn::IsNaN(middle), middle, f), out + x, count - x);
  }
}

void TriangulateRow(TriangulateJob* job) {
  const hn::ScalableTag<float> d;
  const hn::RebindToSigned<decltype(d)> di;
  const hn::Rebind<std::uint16_t, decltype(d)> du16;
  const int lanes = static_cast<int>(hn::Lanes(d));
  const auto load = [&](const std::uint16_t* p) {
    return hn::ConvertTo(d, hn::PromoteTo(di, hn::LoadU(du16, p)));
  };
  const auto nan = hn::NaN(d);
  for (int x = 0; x < job->count; x += lanes) {
    const auto in = hn::RebindMask(d, hn::Lt(Count(di, x), hn::Set(di, job->count)));
    HWY_ALIGN float ends[HWY_MAX_BYTES / sizeof(float)] = {};
    const bool whole = x + lanes <= job->count;
    if (!whole) std::copy(job->h + x, job->h + job->count, ends);
    const auto h = whole ? hn::LoadU(d, job->h + x) : hn::Load(d, ends);
    const auto a = hn::LoadU(d, job->a + x);
    const auto known = hn::And(in, hn::Not(hn::IsNaN(h)));
    const auto cost = load(job->cost + x);
    const auto steep = hn::Max(load(job->steep + x), hn::Set(d, 1.0f));
    const auto one = hn::Set(d, 1.0f);
    // Spread of the least: noise of the costs over the slope beside it.
    const auto sigma_h = hn::Mul(hn::Add(hn::Div(hn::Mul(hn::Sqrt(hn::Add(cost, hn::Set(d, 20.0f))),
                                                         hn::Set(d, kSigmaOfCost)),
                                                 steep),
                                         hn::Set(d, 0.05f)),
                                 hn::Set(d, job->step_h));
    auto range = nan, sigma = nan;
    if (job->inverse) {
      // 1 / rho to range along the ray: rho / sin(theta), and 1 / sin(theta) from -cot(theta).
      const auto cosec = hn::Sqrt(hn::Add(hn::Mul(a, a), one));
      range = hn::Div(cosec, h);
      sigma = hn::Div(hn::Mul(range, sigma_h), h);
    } else {
      const auto sine = SineSmall(d, h);
      const auto b = hn::Set(d, job->baseline);
      range = hn::Div(hn::Mul(b, SineUpper(d, hn::Add(a, h))), sine);
      sigma = hn::Div(hn::Mul(hn::Mul(b, SineUpper(d, a)), sigma_h), hn::Mul(sine, sine));
    }
    // Where the parallax drowns in its own error there is no range.
    const auto sure = hn::And(
        hn::Gt(h, hn::Zero(d)),
        hn::And(hn::Gt(range, hn::Zero(d)), hn::Lt(sigma, hn::Mul(range, hn::Set(d, 0.5f)))));
    const auto meant = hn::And(hn::Ge(range, hn::Set(d, job->min_range)),
                               hn::Le(range, hn::Set(d, job->max_range)));
    const auto valid = hn::And(known, hn::And(sure, meant));
    const auto worth = hn::Mul(
        hn::Max(hn::Sub(one, hn::Mul(cost, hn::Set(d, 1.0f / job->full_cost))), hn::Zero(d)),
        hn::Min(hn::Mul(steep, hn::Set(d, 1.0f / 60.0f)), one));
    const auto put = [&](float* to, decltype(range) value) {
      StoreFront(d, hn::IfThenElse(valid, value, nan), to + x, job->count - x);
    };
    put(job->range, range);
    put(job->sigma, sigma);
    put(job->score, worth);
    job->valid += hn::CountTrue(d, valid);
    job->no_parallax += hn::CountTrue(d, hn::AndNot(sure, known));
    job->out_of_range += hn::CountTrue(d, hn::And(known, hn::AndNot(meant, sure)));
  }
}

std::string TargetName() { return hwy::TargetName(HWY_TARGET); }

}  // namespace HWY_NAMESPACE
}  // namespace omnister::sweep
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace omnister::sweep {

HWY_EXPORT(SmoothRows);
HWY_EXPORT(HalveRows);
HWY_EXPORT(SampleRow);
HWY_EXPORT(CensusRow);
HWY_EXPORT(WidenBlock);
HWY_EXPORT(CensusBlock);
HWY_EXPORT(MatchChunk);
HWY_EXPORT(TriangulateRow);
HWY_EXPORT(MedianRow);
HWY_EXPORT(ClaimRow);
HWY_EXPORT(RejectRow);
HWY_EXPORT(ConcludeRow);
HWY_EXPORT(MapCells);
HWY_EXPORT(MapRow);
HWY_EXPORT(BoxColumns);
HWY_EXPORT(BoxMeanRow);
HWY_EXPORT(TargetName);

void smoothRows(const cv::Mat& image, PaddedImage* out, int begin, int end) {
  HWY_DYNAMIC_DISPATCH(SmoothRows)(image, out, begin, end);
}

void halveRows(const PaddedImage& image, PaddedImage* out, int begin, int end) {
  HWY_DYNAMIC_DISPATCH(HalveRows)(image, out, begin, end);
}

void fillBorderRows(PaddedImage* image) {
  const std::size_t bytes = image->stride;
  for (int i = 1; i <= PaddedImage::kPad; ++i) {
    std::memcpy(image->row(-i) - PaddedImage::kPad, image->row(0) - PaddedImage::kPad, bytes);
    std::memcpy(image->row(image->height - 1 + i) - PaddedImage::kPad,
                image->row(image->height - 1) - PaddedImage::kPad, bytes);
  }
}

void sampleRow(const PaddedImage& image, const float* x, const float* y, const std::uint8_t* mask,
               int runs, std::uint8_t* grey) {
  HWY_DYNAMIC_DISPATCH(SampleRow)(image, x, y, mask, runs, grey);
}

void censusRow(const std::uint8_t* const rows[5], int count, std::uint8_t* const out[kPlanes]) {
  HWY_DYNAMIC_DISPATCH(CensusRow)(rows, count, out);
}

void widenBlock(const PaddedImage& image, int x0, int y0, int width, int height, std::int16_t* out,
                int stride) {
  HWY_DYNAMIC_DISPATCH(WidenBlock)(image, x0, y0, width, height, out, stride);
}

void censusBlock(const std::int16_t* grey, int grey_stride, int width, int height,
                 const CensusOffsets& offsets, bool narrow, std::uint8_t* const out[kPlanes],
                 int stride) {
  HWY_DYNAMIC_DISPATCH(CensusBlock)
  (grey, grey_stride, width, height, offsets, narrow, out, stride);
}

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

void concludeRow(ConcludeJob* job) { HWY_DYNAMIC_DISPATCH(ConcludeRow)(job); }

void claimRow(const ClaimJob& job) { HWY_DYNAMIC_DISPATCH(ClaimRow)(job); }

void rejectRow(RejectJob* job) { HWY_DYNAMIC_DISPATCH(RejectRow)(job); }

void medianRow(const float* const rows[3], int count, float* out) {
  HWY_DYNAMIC_DISPATCH(MedianRow)(rows, count, out);
}

void triangulateRow(TriangulateJob* job) { HWY_DYNAMIC_DISPATCH(TriangulateRow)(job); }

void matchChunk(const ChunkJob& job) { HWY_DYNAMIC_DISPATCH(MatchChunk)(job); }

void holdSimd(const std::string& name) {
  std::int64_t disabled = 0;
  if (name == "avx2")
    disabled = HWY_AVX3 | HWY_AVX3_DL;
  else if (name == "sse4")
    disabled = HWY_AVX3 | HWY_AVX3_DL | HWY_AVX2;
  else if (name == "scalar")
    disabled = ~static_cast<std::int64_t>(HWY_SCALAR | HWY_EMU128);
  else if (!name.empty() && name != "best")
    throw Error("OMNISTER_SIMD is '" + printable(name) + "', expected best, avx2, sse4 or scalar");
  hwy::DisableTargets(disabled);
}

void holdSimdByEnvironment() {
  static const bool once = [] {
    const char* name = std::getenv("OMNISTER_SIMD");
    if (name && *name) holdSimd(name);
    return true;
  }();
  static_cast<void>(once);
}

std::string simdName() { return HWY_DYNAMIC_DISPATCH(TargetName)(); }

}  // namespace omnister::sweep
#endif  // HWY_ONCE
