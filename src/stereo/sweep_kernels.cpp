// SPDX-License-Identifier: Apache-2.0
#include "sweep_kernels.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <mutex>

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

void SampleRow(const PaddedImage& image, const float* x, const float* y, const std::uint8_t* mask,
               int runs, std::uint8_t* grey) {
  const hn::CappedTag<std::int32_t, 8> d;
  const hn::Rebind<std::uint8_t, decltype(d)> d8;
  const int lanes = static_cast<int>(hn::Lanes(d));
  const auto stride = hn::Set(d, image.stride);
  const auto* corner = reinterpret_cast<const std::int32_t*>(
      image.row(0) - PaddedImage::kPad * (static_cast<std::ptrdiff_t>(image.stride) + 1));
  const auto byte = hn::Set(d, 0xFF);
  for (int n = 0; n < runs; ++n, grey += 8) {
    if (mask[n] == 0) {
      std::memset(grey, 0, 8);
      continue;
    }
    // 16 bits below the point, of which 7 are used, rounded; counted from the corner of the padding
    // so that all are positive.
    constexpr float kOne = 65536.0f;
    const auto u0 = static_cast<std::int32_t>((x[n] + PaddedImage::kPad) * kOne + 256.0f);
    const auto v0 = static_cast<std::int32_t>((y[n] + PaddedImage::kPad) * kOne + 256.0f);
    const auto du = static_cast<std::int32_t>((x[n + 1] - x[n]) * (kOne / 8));
    const auto dv = static_cast<std::int32_t>((y[n + 1] - y[n]) * (kOne / 8));
    for (int i = 0; i < 8; i += lanes) {
      const auto step = hn::Iota(d, i);
      // Cells that the mask leaves out may lie anywhere: they ask for the first pixel.
      const auto bit = hn::And(hn::Shr(hn::Set(d, mask[n]), step), hn::Set(d, 1));
      const auto inside = hn::Ne(bit, hn::Zero(d));
      const auto u =
          hn::IfThenElseZero(inside, hn::Add(hn::Set(d, u0), hn::Mul(step, hn::Set(d, du))));
      const auto v =
          hn::IfThenElseZero(inside, hn::Add(hn::Set(d, v0), hn::Mul(step, hn::Set(d, dv))));
      const auto at = hn::Add(hn::Mul(hn::ShiftRight<16>(v), stride), hn::ShiftRight<16>(u));
      const auto upper = hn::GatherOffset(d, corner, at);
      const auto lower = hn::GatherOffset(d, corner, hn::Add(at, stride));
      const auto fu = hn::And(hn::ShiftRight<9>(u), hn::Set(d, 127));
      const auto fv = hn::And(hn::ShiftRight<9>(v), hn::Set(d, 127));
      const auto across = [&](auto pair) {
        const auto p = hn::And(pair, byte);
        const auto q = hn::And(hn::ShiftRight<8>(pair), byte);
        return hn::Add(hn::ShiftLeft<7>(p), hn::Mul(hn::Sub(q, p), fu));
      };
      const auto top = across(upper), bottom = across(lower);
      const auto sum = hn::Add(hn::ShiftLeft<7>(top), hn::Mul(hn::Sub(bottom, top), fv));
      const auto value = hn::ShiftRight<14>(hn::Add(sum, hn::Set(d, 8192)));
      const auto seen = hn::IfThenElseZero(inside, hn::Max(value, hn::Set(d, 1)));
      hn::StoreU(hn::DemoteTo(d8, seen), d8, grey + i);
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
      hn::StoreU(bits, d, to + x);
    }
    for (; x < count; ++x) {
      unsigned bits = 0;
      for (int i = 0; i < 8; ++i) bits |= (neighbour[i][x] > centre[x] ? 1u : 0u) << i;
      to[x] = static_cast<std::uint8_t>(bits);
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

template <int kLanes>
void MatchLanes(const ChunkJob& job) {
  constexpr int window = kWindow;
  const int tile_width = job.width - 2 * kRadius;
  const std::size_t line = static_cast<std::size_t>(job.width) * kLanes;
  job.scratch->assign(line * (window + 1) + 256, 0);
  std::uint8_t* HWY_RESTRICT sums = job.scratch->data();
  std::uint8_t* ring = sums + line;

  const hn::CappedTag<std::uint8_t, kLanes> d8;
  const hn::CappedTag<std::uint16_t, kLanes> d16;
  const hn::Rebind<std::uint8_t, decltype(d16)> d8h;
  const std::size_t n8 = hn::Lanes(d8), n16 = hn::Lanes(d16);
  HWY_ALIGN std::uint16_t lane_index[kLanes];
  for (int i = 0; i < kLanes; ++i)
    lane_index[i] = (i == 0 || i == kLanes - 1) ? 0xFFFF : static_cast<std::uint16_t>(i);

  HWY_ALIGN std::uint16_t box[kLanes];
  for (int y = 0; y < job.height; ++y) {
    std::uint8_t* HWY_RESTRICT old = ring + (y % window) * line;
    const std::size_t row = static_cast<std::size_t>(y) * job.stride;
    for (int x = 0; x < job.width; ++x) {
      const std::size_t pixel = row + x;
      // Where there is no ray, and in a stray halo, any cell will do.
      const std::int32_t base = std::min(std::max(job.base[pixel] + job.first, 0), job.cells_end);
      for (std::size_t l = 0; l < kLanes; l += n8) {
        auto cost = hn::PopulationCount(
            hn::Xor(hn::LoadU(d8, job.cells[0] + base + l), hn::Set(d8, job.reference[0][pixel])));
        for (int p = 1; p < kPlanes; ++p) {
          cost = hn::Add(cost, hn::PopulationCount(hn::Xor(hn::LoadU(d8, job.cells[p] + base + l),
                                                           hn::Set(d8, job.reference[p][pixel]))));
        }
        const std::size_t at = static_cast<std::size_t>(x) * kLanes + l;
        const auto sum = hn::LoadU(d8, sums + at);
        hn::StoreU(hn::Add(sum, hn::Sub(cost, hn::LoadU(d8, old + at))), d8, sums + at);
        hn::StoreU(cost, d8, old + at);
      }
    }
    if (y < window - 1) continue;
    const std::size_t out = static_cast<std::size_t>(y - window + 1) * tile_width;
    std::memset(box, 0, sizeof box);
    for (int x = 0; x < job.width; ++x) {
      const std::uint8_t* HWY_RESTRICT in = sums + static_cast<std::size_t>(x) * kLanes;
      const std::uint8_t* HWY_RESTRICT gone = in - static_cast<std::ptrdiff_t>(window) * kLanes;
      auto least = hn::Set(d16, std::uint16_t{0xFFFF});
      for (std::size_t l = 0; l < kLanes; l += n16) {
        auto sum = hn::Add(hn::Load(d16, box + l), hn::PromoteTo(d16, hn::LoadU(d8h, in + l)));
        if (x >= window) sum = hn::Sub(sum, hn::PromoteTo(d16, hn::LoadU(d8h, gone + l)));
        hn::Store(sum, d16, box + l);
        least = hn::Min(least, hn::Or(hn::ShiftLeft<5>(sum), hn::Load(d16, lane_index + l)));
      }
      if (x < window - 1) continue;
      const std::uint16_t packed = LeastLane(d16, least);
      const std::uint16_t cost = packed >> 5;
      const std::size_t pixel = out + x - window + 1;
      if (cost < job.cost[pixel]) {
        const int lane = packed & 31;
        job.cost[pixel] = cost;
        job.index[pixel] = static_cast<std::int16_t>(job.first + lane);
        job.before[pixel] = box[lane - 1];
        job.after[pixel] = box[lane + 1];
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

void MapRow(const MapJob& job, const std::uint16_t* phi, const float* a, int count,
            std::int32_t* base, float* residual) {
  const hn::ScalableTag<float> df;
  const hn::RebindToSigned<decltype(df)> di;
  const hn::Rebind<std::uint16_t, decltype(df)> du16;
  const int lanes = static_cast<int>(hn::Lanes(df));
  for (int x = 0; x < count; x += lanes) {
    const auto p = hn::PromoteTo(di, hn::LoadU(du16, phi + x));
    const auto row = hn::NearestInt(hn::Add(
        hn::Mul(hn::ConvertTo(df, p), hn::Set(df, job.row_scale)), hn::Set(df, job.row_offset)));
    const auto inside = hn::Min(hn::Max(row, hn::Zero(di)), hn::Set(di, job.rows - 1));
    const auto slope = hn::Mul(hn::ConvertTo(df, hn::Iota(di, x)), hn::Set(df, job.guess_x));
    const auto column = hn::Add(hn::Mul(hn::LoadU(df, a + x), hn::Set(df, job.to_column)),
                                hn::Add(slope, hn::Set(df, job.guess)));
    const auto pattern = hn::And(
        hn::Add(hn::Mul(hn::Iota(di, x), hn::Set(di, kDitherX)), hn::Set(di, job.dither_phase)),
        hn::Set(di, 255));
    const auto dither = hn::Mul(hn::ConvertTo(df, hn::Sub(pattern, hn::Set(di, 128))),
                                hn::Set(df, job.dither / 256.0f));
    const auto whole = hn::NearestInt(hn::Add(column, dither));
    const auto none = hn::Eq(p, hn::Set(di, kNoRay));
    const auto cell = hn::Add(hn::GatherIndex(di, job.origin, inside), whole);
    hn::StoreU(hn::IfThenElse(none, hn::Set(di, -1), cell), di, base + x);
    const auto gap = hn::Sub(hn::ConvertTo(df, whole), column);
    hn::StoreU(hn::IfThenZeroElse(hn::RebindMask(df, none), gap), df, residual + x);
  }
}

void BoxMeanRow(const float* in, int stride, int count, float* HWY_RESTRICT line,
                float* HWY_RESTRICT out) {
  const hn::ScalableTag<float> d;
  const int lanes = static_cast<int>(hn::Lanes(d));
  for (int x = 0; x < count + kWindow - 1; x += lanes) {
    auto sum = hn::LoadU(d, in + x);
    for (int k = 1; k < kWindow; ++k) sum = hn::Add(sum, hn::LoadU(d, in + k * stride + x));
    hn::StoreU(sum, d, line + x);
  }
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
  auto first = hn::Set(di, job.claim_first), last = hn::Set(di, job.claim_last);
  for (int x = 0; x < job.count; x += lanes) {
    const auto c = load(job.cost + x), before = load(job.before + x), after = load(job.after + x);
    const auto k = hn::PromoteTo(di, hn::LoadU(di16, job.index + x));
    const auto steep = hn::Sub(hn::Max(before, after), c);
    const auto cell = hn::Add(hn::LoadU(di, job.base + x), k);
    const auto phi = hn::PromoteTo(di, hn::LoadU(du16, job.phi + x));
    const auto legal = hn::And(hn::Gt(cell, hn::Set(di, -1)), hn::Lt(cell, hn::Set(di, job.cells)));
    const auto safe = hn::IfThenElseZero(legal, cell);
    // The mask bit of the cell; four bytes are read, the lowest counts.
    const auto word = hn::GatherOffset(di, reinterpret_cast<const std::int32_t*>(job.mask),
                                       hn::ShiftRight<3>(safe));
    const auto bit = hn::And(hn::Shr(word, hn::And(safe, hn::Set(di, 7))), hn::Set(di, 1));
    auto good = hn::And(legal, hn::Eq(bit, hn::Set(di, 1)));
    good = hn::And(good, hn::Ne(phi, hn::Set(di, kNoRay)));
    auto fine = hn::And(hn::RebindMask(df, good), hn::Gt(steep, hn::Zero(df)));
    fine = hn::And(fine, hn::Le(c, hn::Set(df, job.worst_cost)));
    // The pixels of a window fall between columns, each elsewhere: their sum is rounder than two
    // lines and sharper than a parabola. With this gain a shift of all columns leaves no bias.
    constexpr float kGain = 0.62f;
    const auto shift =
        hn::Div(hn::Mul(hn::Sub(before, after), hn::Set(df, kGain)),
                hn::Max(hn::Sub(hn::Add(before, after), hn::Add(c, c)), hn::Set(df, 1.0f)));
    const auto guess =
        hn::Add(hn::Mul(hn::ConvertTo(df, hn::Iota(di, x)), hn::Set(df, job.guess_x)),
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
          hn::And(hn::RebindMask(di, fine), hn::Lt(hn::Iota(di, x), hn::Set(di, job.count)));
      hn::StoreU(hn::IfThenElse(counted, at, hn::Set(di, -1)), di, job.claim + x);
      first = hn::Min(first, hn::IfThenElse(counted, row, first));
      last = hn::Max(last, hn::IfThenElse(counted, row, last));
    }
  }
  job.claim_first = hn::GetLane(hn::MinOfLanes(di, first));
  job.claim_last = hn::GetLane(hn::MaxOfLanes(di, last));
}

std::size_t CheckRow(const std::uint32_t* claims, const std::int32_t* claim, float to_units,
                     float tolerance, float* h, int count) {
  const hn::ScalableTag<float> df;
  const hn::RebindToSigned<decltype(df)> di;
  const int lanes = static_cast<int>(hn::Lanes(df));
  std::size_t gone = 0;
  for (int x = 0; x < count; x += lanes) {
    const auto at = hn::LoadU(di, claim + x);
    const auto some = hn::Gt(at, hn::Set(di, -1));
    const auto value = hn::LoadU(df, h + x);
    const auto found = hn::GatherIndex(di, reinterpret_cast<const std::int32_t*>(claims),
                                       hn::IfThenElseZero(some, at));
    const auto theirs = hn::ConvertTo(df, hn::And(found, hn::Set(di, 0xFFFF)));
    const auto mine = hn::Add(hn::Mul(value, hn::Set(df, to_units)), hn::Set(df, kClaimOffset));
    const auto lost = hn::And(hn::RebindMask(df, some),
                              hn::Gt(hn::Abs(hn::Sub(mine, theirs)), hn::Set(df, tolerance)));
    hn::StoreU(hn::IfThenElse(lost, hn::NaN(df), value), df, h + x);
    gone += hn::CountTrue(df, lost);
  }
  return gone;
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
    hn::StoreU(hn::IfThenElse(hn::IsNaN(middle), middle, f), d, out + x);
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
    const auto in = hn::RebindMask(d, hn::Lt(hn::Iota(di, x), hn::Set(di, job->count)));
    const auto h = hn::LoadU(d, job->h + x), a = hn::LoadU(d, job->a + x);
    const auto known = hn::And(in, hn::Not(hn::IsNaN(h)));
    const auto cost = load(job->cost + x);
    const auto steep = hn::Max(load(job->steep + x), hn::Set(d, 1.0f));
    const auto one = hn::Set(d, 1.0f);
    // Spread of the least: noise of the costs over the slope beside it.
    const auto sigma_h = hn::Mul(
        hn::Add(
            hn::Div(hn::Mul(hn::Sqrt(hn::Add(cost, hn::Set(d, 20.0f))), hn::Set(d, 0.35f)), steep),
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
      const auto v = hn::IfThenElse(valid, value, nan);
      if (x + lanes <= job->count) {
        hn::StoreU(v, d, to + x);
      } else {
        HWY_ALIGN float last[HWY_MAX_BYTES / sizeof(float)];
        hn::Store(v, d, last);
        std::copy(last, last + (job->count - x), to + x);
      }
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
HWY_EXPORT(CheckRow);
HWY_EXPORT(ConcludeRow);
HWY_EXPORT(MapRow);
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

void mapRow(const MapJob& job, const std::uint16_t* phi, const float* a, int count,
            std::int32_t* base, float* residual) {
  HWY_DYNAMIC_DISPATCH(MapRow)(job, phi, a, count, base, residual);
}

void boxMeanRow(const float* in, int stride, int count, float* line, float* out) {
  HWY_DYNAMIC_DISPATCH(BoxMeanRow)(in, stride, count, line, out);
}

void concludeRow(ConcludeJob* job) { HWY_DYNAMIC_DISPATCH(ConcludeRow)(job); }

std::size_t checkRow(const std::uint32_t* claims, const std::int32_t* claim, float to_units,
                     float tolerance, float* h, int count) {
  return HWY_DYNAMIC_DISPATCH(CheckRow)(claims, claim, to_units, tolerance, h, count);
}

void medianRow(const float* const rows[3], int count, float* out) {
  HWY_DYNAMIC_DISPATCH(MedianRow)(rows, count, out);
}

void triangulateRow(TriangulateJob* job) { HWY_DYNAMIC_DISPATCH(TriangulateRow)(job); }

void matchChunk(const ChunkJob& job) { HWY_DYNAMIC_DISPATCH(MatchChunk)(job); }

std::string simdName() { return HWY_DYNAMIC_DISPATCH(TargetName)(); }

}  // namespace omnister::sweep
#endif  // HWY_ONCE
