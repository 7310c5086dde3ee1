// SPDX-License-Identifier: Apache-2.0
#include "sweep_kernels.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <mutex>

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
  const std::ptrdiff_t stride = image.stride;
  const std::uint8_t* origin = image.row(0);
  for (int n = 0; n < runs; ++n, grey += 8) {
    if (mask[n] == 0) {
      std::memset(grey, 0, 8);
      continue;
    }
    // 16 bits below the point, counted from the corner of the padding so that all are positive.
    constexpr float kOne = 65536.0f;
    const std::int32_t u0 = static_cast<std::int32_t>((x[n] + PaddedImage::kPad) * kOne);
    const std::int32_t v0 = static_cast<std::int32_t>((y[n] + PaddedImage::kPad) * kOne);
    const std::int32_t du = static_cast<std::int32_t>((x[n + 1] - x[n]) * (kOne / 8));
    const std::int32_t dv = static_cast<std::int32_t>((y[n + 1] - y[n]) * (kOne / 8));
    const std::uint8_t* corner = origin - PaddedImage::kPad * (stride + 1);
    for (int i = 0; i < 8; ++i) {
      if (!(mask[n] >> i & 1)) {
        grey[i] = 0;
        continue;
      }
      const std::int32_t u = u0 + i * du, v = v0 + i * dv;
      const std::uint8_t* p = corner + (v >> 16) * stride + (u >> 16);
      const int fu = (u >> 9) & 127, fv = (v >> 9) & 127;
      const int top = (p[0] << 7) + (p[1] - p[0]) * fu;
      const int bottom = (p[stride] << 7) + (p[stride + 1] - p[stride]) * fu;
      const int value = ((top << 7) + (bottom - top) * fv + 8192) >> 14;
      grey[i] = static_cast<std::uint8_t>(std::max(value, 1));
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

void CensusBlock(const PaddedImage& image, int x0, int y0, int width, int height,
                 const CensusOffsets& offsets, std::uint8_t* const out[kPlanes], int stride) {
  const std::ptrdiff_t image_stride = image.stride;
  for (int plane = 0; plane < kPlanes; ++plane) {
    for (int y = 0; y < height; ++y) std::memset(out[plane] + y * stride, 0, width);
    for (int i = 0; i < 8; ++i) {
      const float dx = offsets.dx[plane * 8 + i], dy = offsets.dy[plane * 8 + i];
      const int ix = static_cast<int>(std::floor(dx)), iy = static_cast<int>(std::floor(dy));
      const int fu = static_cast<int>((dx - ix) * 128), fv = static_cast<int>((dy - iy) * 128);
      const std::uint16_t w11 = static_cast<std::uint16_t>((fu * fv + 64) >> 7);
      const std::uint16_t w10 = static_cast<std::uint16_t>(fu - w11),
                          w01 = static_cast<std::uint16_t>(fv - w11);
      const std::uint16_t w00 = static_cast<std::uint16_t>(128 - fu - fv + w11);
      for (int y = 0; y < height; ++y) {
        const std::uint8_t* HWY_RESTRICT c = image.row(y0 + y) + x0;
        const std::uint8_t* HWY_RESTRICT p = image.row(y0 + y + iy) + x0 + ix;
        const std::uint8_t* HWY_RESTRICT q = p + image_stride;
        std::uint8_t* HWY_RESTRICT to = out[plane] + y * stride;
        for (int x = 0; x < width; ++x) {
          const std::uint16_t value = static_cast<std::uint16_t>(
              (w00 * p[x] + w10 * p[x + 1] + w01 * q[x] + w11 * q[x + 1] + 64) >> 7);
          to[x] = static_cast<std::uint8_t>(to[x] | ((value > c[x] ? 1 : 0) << i));
        }
      }
    }
  }
}

void MatchChunk(const ChunkJob& job) {
  const int window = 2 * job.radius + 1;
  const int tile_width = job.width - 2 * job.radius;
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
    const std::size_t row = static_cast<std::size_t>(y) * job.width;
    for (int x = 0; x < job.width; ++x) {
      const std::size_t pixel = row + x;
      const std::int32_t base = job.base[pixel];
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
      const std::uint16_t packed = hn::GetLane(hn::MinOfLanes(d16, least));
      const std::uint16_t cost = packed >> 5;
      const std::size_t pixel = out + x - window + 1;
      if (cost < job.cost[pixel]) {
        const int lane = packed & 31;
        job.cost[pixel] = cost;
        job.index[pixel] = static_cast<std::uint16_t>(job.first + lane);
        job.before[pixel] = box[lane - 1];
        job.after[pixel] = box[lane + 1];
      }
    }
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
HWY_EXPORT(CensusBlock);
HWY_EXPORT(MatchChunk);
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

void censusBlock(const PaddedImage& image, int x0, int y0, int width, int height,
                 const CensusOffsets& offsets, std::uint8_t* const out[kPlanes], int stride) {
  HWY_DYNAMIC_DISPATCH(CensusBlock)(image, x0, y0, width, height, offsets, out, stride);
}

void matchChunk(const ChunkJob& job) { HWY_DYNAMIC_DISPATCH(MatchChunk)(job); }

std::string simdName() { return HWY_DYNAMIC_DISPATCH(TargetName)(); }

}  // namespace omnister::sweep
#endif  // HWY_ONCE
