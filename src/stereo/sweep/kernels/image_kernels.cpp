// SPDX-License-Identifier: Apache-2.0
#include <hwy/cache_control.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>

#include "omnister/common/error.h"
#include "stereo/sweep/kernels/kernels.h"

// Highway builds this file once for every instruction set.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "src/stereo/sweep/kernels/image_kernels.cpp"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include "stereo/sweep/kernels/kernels-inl.h"

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

void PairBlock(const PaddedImage& image, int x0, int y0, int width, int height, Pairs pairs,
               std::uint16_t* HWY_RESTRICT out, int stride) {
  const std::ptrdiff_t other = pairs == Pairs::kAcross ? 1 : image.stride;
  for (int y = 0; y < height; ++y, out += stride) {
    const std::uint8_t* HWY_RESTRICT from = image.row(y0 + y) + x0;
    for (int x = 0; x < width; ++x)
      out[x] = static_cast<std::uint16_t>((from[x] | from[x + other] << 8) ^ 0x8080);
  }
}

/// Sums of pairs of signed bytes times the unsigned bytes of `weights`, which must fit.
template <class D, class V>
HWY_INLINE V WeighPairs(D d, V pairs, V weights) {
#if HWY_TARGET <= HWY_SSE4 && HWY_ARCH_X86
  static_cast<void>(d);
  if constexpr (hn::MaxLanes(D()) == 8) return V{_mm_maddubs_epi16(weights.raw, pairs.raw)};
#if HWY_TARGET <= HWY_AVX2
  if constexpr (hn::MaxLanes(D()) == 16) return V{_mm256_maddubs_epi16(weights.raw, pairs.raw)};
#endif
#if HWY_TARGET <= HWY_AVX3
  if constexpr (hn::MaxLanes(D()) == 32) return V{_mm512_maddubs_epi16(weights.raw, pairs.raw)};
#endif
#else
  const hn::RebindToUnsigned<D> du;
  const auto high = hn::BitCast(d, hn::ShiftRight<8>(hn::BitCast(du, weights)));
  return hn::Add(
      hn::Mul(hn::ShiftRight<8>(hn::ShiftLeft<8>(pairs)), hn::And(weights, hn::Set(d, 0xFF))),
      hn::Mul(hn::ShiftRight<8>(pairs), high));
#endif
}

/// Of four signed bytes in a word the first two and the last two, each times the lower bytes of
/// `down`; then these two times the halves of `across`; summed.
template <class D, class V>
HWY_INLINE V WeighQuads(D d, V quads, V down, V across) {
#if HWY_TARGET <= HWY_SSE4 && HWY_ARCH_X86
  const hn::RepartitionToNarrow<D> dn;
  const auto columns = WeighPairs(dn, hn::BitCast(dn, quads), hn::BitCast(dn, down));
  if constexpr (hn::MaxLanes(D()) == 4) return V{_mm_madd_epi16(columns.raw, across.raw)};
#if HWY_TARGET <= HWY_AVX2
  if constexpr (hn::MaxLanes(D()) == 8) return V{_mm256_madd_epi16(columns.raw, across.raw)};
#endif
#if HWY_TARGET <= HWY_AVX3
  if constexpr (hn::MaxLanes(D()) == 16) return V{_mm512_madd_epi16(columns.raw, across.raw)};
#endif
#else
  const auto byte = hn::Set(d, 0xFF);
  const auto upper = hn::And(down, byte), lower = hn::And(hn::ShiftRight<8>(down), byte);
  const auto left = hn::Add(hn::Mul(hn::ShiftRight<24>(hn::ShiftLeft<24>(quads)), upper),
                            hn::Mul(hn::ShiftRight<24>(hn::ShiftLeft<16>(quads)), lower));
  const auto right = hn::Add(hn::Mul(hn::ShiftRight<24>(hn::ShiftLeft<8>(quads)), upper),
                             hn::Mul(hn::ShiftRight<24>(quads), lower));
  return hn::Add(hn::Mul(left, hn::And(across, hn::Set(d, 0xFFFF))),
                 hn::Mul(right, hn::ShiftRight<16>(across)));
#endif
}

// Vector gathers are slow on many processors: addresses are computed by vectors, memory is read by
// plain loads, and vectors go on with what was read.

void SampleRow(const std::uint16_t* pairs, int stride, const float* x, const float* y,
               const std::uint8_t* mask, int runs, std::uint8_t* grey) {
  constexpr int kBatch = 32;  // runs
  const hn::CappedTag<std::int32_t, 8> d;
  const int lanes = static_cast<int>(hn::Lanes(d));
  const hn::CappedTag<std::int32_t, 16> dw;
  const hn::Rebind<std::uint8_t, decltype(dw)> d8;
  const int wide = static_cast<int>(hn::Lanes(dw));
  struct Batch {
    HWY_ALIGN std::int32_t u[kBatch], v[kBatch], du[kBatch], dv[kBatch];  // by run
    HWY_ALIGN std::int32_t at[kBatch * 8], across[kBatch * 8], down[kBatch * 8];
  };
  Batch batches[2];
  HWY_ALIGN std::int32_t corners[kBatch * 8];

  const auto address = [&](int begin, Batch* batch) {
    const int count = std::min(kBatch, runs - begin);
    // 16 bits below the point, of which 7 are used, rounded; counted from the corner of the padding
    // so that all are positive.
    constexpr float kOne = 65536.0f, kCorner = PaddedImage::kPad * kOne + 256.0f;
    for (int n = 0; n < count; ++n) {
      const int run = begin + n;
      const bool seen = mask[run] != 0;
      batch->u[n] = static_cast<std::int32_t>(seen ? x[run] * kOne + kCorner : 0.0f);
      batch->v[n] = static_cast<std::int32_t>(seen ? y[run] * kOne + kCorner : 0.0f);
      batch->du[n] = static_cast<std::int32_t>(seen ? (x[run + 1] - x[run]) * (kOne / 8) : 0.0f);
      batch->dv[n] = static_cast<std::int32_t>(seen ? (y[run + 1] - y[run]) * (kOne / 8) : 0.0f);
    }
    for (int n = 0; n < count; ++n) {
      for (int i = 0; i < 8; i += lanes) {
        const auto step = Count(d, i);
        auto u = hn::Add(hn::Set(d, batch->u[n]), hn::Mul(step, hn::Set(d, batch->du[n])));
        auto v = hn::Add(hn::Set(d, batch->v[n]), hn::Mul(step, hn::Set(d, batch->dv[n])));
        if (mask[begin + n] != 0xFF) {
          // Cells that the mask leaves out may lie anywhere: they ask for the first pixel.
          const auto bit = hn::And(hn::Shr(hn::Set(d, mask[begin + n]), step), hn::Set(d, 1));
          const auto inside = hn::Ne(bit, hn::Zero(d));
          u = hn::IfThenElseZero(inside, u);
          v = hn::IfThenElseZero(inside, v);
        }
        hn::Store(
            hn::Add(hn::Mul(hn::ShiftRight<16>(v), hn::Set(d, stride)), hn::ShiftRight<16>(u)), d,
            batch->at + n * 8 + i);
        const auto low = hn::Set(d, 127), whole = hn::Set(d, 128);
        const auto fu = hn::And(hn::ShiftRight<9>(u), low);
        const auto fv = hn::And(hn::ShiftRight<9>(v), low);
        hn::Store(hn::Add(hn::Sub(whole, fu), hn::ShiftLeft<16>(fu)), d, batch->across + n * 8 + i);
        const auto column = hn::Add(hn::Sub(whole, fv), hn::ShiftLeft<8>(fv));
        hn::Store(hn::Or(column, hn::ShiftLeft<16>(column)), d, batch->down + n * 8 + i);
      }
      hwy::Prefetch(pairs + batch->at[n * 8]);
      hwy::Prefetch(pairs + batch->at[n * 8 + 7]);
    }
  };

  address(0, &batches[0]);
  for (int begin = 0, turn = 0; begin < runs; begin += kBatch, grey += kBatch * 8, turn ^= 1) {
    if (begin + kBatch < runs) address(begin + kBatch, &batches[turn ^ 1]);
    const Batch& batch = batches[turn];
    const int count = std::min(kBatch, runs - begin);
    for (int n = 0; n < count * 8; n += 8) {
      for (int i = n; i < n + 8; ++i) {
        std::uint32_t corner;
        std::memcpy(&corner, pairs + batch.at[i], 4);
        asm("" : "+r"(corner));  // lest the loop be made of vectors again, lane by lane
        std::memcpy(&corners[i], &corner, 4);
      }
    }
    for (int i = 0; i < count * 8; i += wide) {
      const auto sum = WeighQuads(dw, hn::Load(dw, corners + i), hn::Load(dw, batch.down + i),
                                  hn::Load(dw, batch.across + i));
      const auto value = hn::ShiftRight<14>(hn::Add(sum, hn::Set(dw, (128 << 14) + (1 << 13))));
      const auto bytes = hn::DemoteTo(d8, hn::Max(value, hn::Set(dw, 1)));
      if (i + wide <= count * 8) {
        hn::StoreU(bytes, d8, grey + i);
      } else {
        HWY_ALIGN std::uint8_t last[16];
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
      for (int i = 0; i < 8; ++i) {
        const unsigned more = neighbour[i][x] > centre[x] ? 1 : 0;
        bits |= more << i;
      }
      to[x] = static_cast<std::uint8_t>(centre[x] == 0 ? 0 : bits);
    }
  }
}

template <int kWide>
void CensusWide(const std::uint16_t* pairs, int pairs_stride, int width, int height,
                const CensusOffsets& offsets, std::uint8_t* const out[kPlanes], int stride) {
  constexpr int kWhole = 128;  // of the weights of the four pixels around a neighbour
  std::ptrdiff_t shift[kBits];
  std::int16_t upper[kBits], lower[kBits];
  for (int i = 0; i < kBits; ++i) {
    const float ix = std::floor(offsets.dx[i]), iy = std::floor(offsets.dy[i]);
    const float u = offsets.dx[i] - ix, v = offsets.dy[i] - iy;
    shift[i] = static_cast<std::ptrdiff_t>(iy) * pairs_stride + static_cast<std::ptrdiff_t>(ix);
    const int low = static_cast<int>(kWhole * v + 0.5f), high = kWhole - low;
    const int high_right = static_cast<int>(static_cast<float>(high) * u + 0.5f);
    const int low_right = static_cast<int>(static_cast<float>(low) * u + 0.5f);
    upper[i] = static_cast<std::int16_t>((high - high_right) + 256 * high_right);
    lower[i] = static_cast<std::int16_t>((low - low_right) + 256 * low_right);
  }
  const hn::CappedTag<std::int16_t, kWide> d;
  const hn::Rebind<std::uint8_t, decltype(d)> d8;
  const int lanes = static_cast<int>(hn::Lanes(d));
  const auto load = [&](const std::uint16_t* p) {
    const hn::RebindToUnsigned<decltype(d)> du;
    return hn::BitCast(d, hn::LoadU(du, p));
  };
  for (int y = 0; y < height; ++y) {
    // The last vector of a row may reach past it; the caller leaves room.
    for (int x = 0; x < width; x += lanes) {
      const std::uint16_t* HWY_RESTRICT here =
          pairs + static_cast<std::ptrdiff_t>(y) * pairs_stride + x;
      const auto centre = WeighPairs(d, load(here), hn::Set(d, kWhole));
      for (int plane = 0; plane < kPlanes; ++plane) {
        auto bits = hn::Zero(d);
        for (int i = 0; i < 8; ++i) {
          const int n = plane * 8 + i;
          const std::uint16_t* HWY_RESTRICT p = here + shift[n];
          const auto value = hn::Add(WeighPairs(d, load(p), hn::Set(d, upper[n])),
                                     WeighPairs(d, load(p + pairs_stride), hn::Set(d, lower[n])));
          bits = hn::Or(bits, hn::IfThenElseZero(hn::Gt(value, centre),
                                                 hn::Set(d, static_cast<std::int16_t>(1 << i))));
        }
        hn::StoreU(hn::DemoteTo(d8, bits), d8, out[plane] + y * stride + x);
      }
    }
  }
}

void CensusBlock(const std::uint16_t* pairs, int pairs_stride, int width, int height,
                 const CensusOffsets& offsets, bool narrow, std::uint8_t* const out[kPlanes],
                 int stride) {
  if (narrow || width <= 16)
    CensusWide<16>(pairs, pairs_stride, width, height, offsets, out, stride);
  else
    CensusWide<32>(pairs, pairs_stride, width, height, offsets, out, stride);
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
HWY_EXPORT(PairBlock);
HWY_EXPORT(CensusBlock);
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

void sampleRow(const std::uint16_t* pairs, int stride, const float* x, const float* y,
               const std::uint8_t* mask, int runs, std::uint8_t* grey) {
  HWY_DYNAMIC_DISPATCH(SampleRow)(pairs, stride, x, y, mask, runs, grey);
}

void censusRow(const std::uint8_t* const rows[5], int count, std::uint8_t* const out[kPlanes]) {
  HWY_DYNAMIC_DISPATCH(CensusRow)(rows, count, out);
}

void pairBlock(const PaddedImage& image, int x0, int y0, int width, int height, Pairs pairs,
               std::uint16_t* out, int stride) {
  HWY_DYNAMIC_DISPATCH(PairBlock)(image, x0, y0, width, height, pairs, out, stride);
}

void censusBlock(const std::uint16_t* pairs, int pairs_stride, int width, int height,
                 const CensusOffsets& offsets, bool narrow, std::uint8_t* const out[kPlanes],
                 int stride) {
  HWY_DYNAMIC_DISPATCH(CensusBlock)
  (pairs, pairs_stride, width, height, offsets, narrow, out, stride);
}

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
