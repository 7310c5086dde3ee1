// SPDX-License-Identifier: Apache-2.0
#include "sweep_kernels.h"

#include <hwy/cache_control.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>

#include "omnister/common/error.h"

// Highway builds this file once for every instruction set.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "src/stereo/sweep_kernels.cpp"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include "sweep_kernels-inl.h"

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
