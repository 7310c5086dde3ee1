// SPDX-License-Identifier: Apache-2.0
#include <hwy/cache_control.h>

#include <algorithm>
#include <cmath>

#include "stereo/sweep/kernels/kernels.h"

// Highway builds this file once for every instruction set.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "src/stereo/sweep/kernels/correlation_kernels.cpp"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace omnister::sweep {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

constexpr int kCount = kWindow * kWindow;
constexpr float kUnits = static_cast<float>(1 << kCorrelationShift);
/// Of a pair of windows with C = 0.
constexpr float kUnrelated = 0.5f * kBits * kCount * kUnits;
constexpr float kDearest = 32767.0f;  ///< costs are kept in 15 bits

/// What a window of the reference image has to do with costs.
struct Own {
  float sum = 0;        ///< of its grey values
  float cost_at_0 = 0;  ///< cost where C = 0
  float slope = 0;      ///< cost = cost_at_0 - slope * (covariance or sum of products) / root
};

template <int kLanes, bool kWithoutMean>
void CorrelateLanes(const ChunkJob& job) {
  constexpr int kAhead = 3;  // rows
  const int width = job.width, height = job.height, stride = job.stride;
  const int tile_width = width - 2 * kRadius;
  const std::size_t line = static_cast<std::size_t>(width) * kLanes;
  const hn::CappedTag<std::int32_t, std::min(kLanes, 16)> d;
  const hn::RebindToFloat<decltype(d)> df;
  const hn::Rebind<std::uint8_t, decltype(d)> d8;
  const hn::Rebind<std::uint16_t, decltype(d)> d16;
  constexpr std::size_t n = hn::MaxLanes(decltype(d)());
  // Sums down the columns of windows: of the displaced image's grey values, of their squares, and
  // of their products with the reference's; then costs of a row of pixels.
  job.scratch->assign((3 * line + line) * sizeof(std::int32_t) + 256, 0);
  auto* const aligned = reinterpret_cast<std::int32_t*>(
      (reinterpret_cast<std::uintptr_t>(job.scratch->data()) + 63) / 64 * 64);
  std::int32_t* HWY_RESTRICT sums = aligned;
  std::int32_t* HWY_RESTRICT squares = aligned + line;
  std::int32_t* HWY_RESTRICT products = aligned + 2 * line;
  std::int32_t* HWY_RESTRICT costs = aligned + 3 * line;
  const std::int32_t* HWY_RESTRICT bases = job.base;
  const std::uint8_t* HWY_RESTRICT reference = job.reference[0];
  const std::uint8_t* HWY_RESTRICT cells = job.cells[0] + job.first;

  std::vector<std::int32_t> own_sums(2 * static_cast<std::size_t>(width), 0);
  for (int y = 0; y < height; ++y) {
    const std::size_t row = static_cast<std::size_t>(y) * stride;
    if (y + kAhead < height) {
      for (int x = 0; x < width; x += 32)
        hwy::Prefetch(cells + bases[row + static_cast<std::size_t>(kAhead) * stride + x]);
    }
    const bool whole = y >= kWindow;
    for (int x = 0; x < width; ++x) {
      const std::size_t pixel = row + x;
      const std::size_t gone = whole ? pixel - static_cast<std::size_t>(kWindow) * stride : pixel;
      const std::int32_t a = reference[pixel], a_gone = whole ? reference[gone] : 0;
      own_sums[2 * x] += a - a_gone;
      own_sums[2 * x + 1] += a * a - a_gone * a_gone;
      const std::uint8_t* HWY_RESTRICT in = cells + bases[pixel];
      const std::uint8_t* HWY_RESTRICT out = cells + bases[gone];
      for (std::size_t l = 0; l < kLanes; l += n) {
        const std::size_t at = static_cast<std::size_t>(x) * kLanes + l;
        const auto b = hn::PromoteTo(d, hn::LoadU(d8, in + l));
        auto sum = hn::Add(hn::LoadU(d, sums + at), b);
        auto square = hn::Add(hn::LoadU(d, squares + at), hn::Mul(b, b));
        auto product = hn::Add(hn::LoadU(d, products + at), hn::Mul(b, hn::Set(d, a)));
        if (whole) {
          const auto old = hn::PromoteTo(d, hn::LoadU(d8, out + l));
          sum = hn::Sub(sum, old);
          square = hn::Sub(square, hn::Mul(old, old));
          product = hn::Sub(product, hn::Mul(old, hn::Set(d, a_gone)));
        }
        hn::StoreU(sum, d, sums + at);
        hn::StoreU(square, d, squares + at);
        hn::StoreU(product, d, products + at);
      }
    }
    if (y < kWindow - 1) continue;

    const auto ownOf = [&](int x) {
      std::int32_t sum = 0, square = 0;
      for (int k = 0; k < kWindow; ++k) {
        sum += own_sums[2 * (x + k)];
        square += own_sums[2 * (x + k) + 1];
      }
      // Whole numbers below 2^31, and their difference is exact.
      const auto spread = static_cast<float>(kCount * square - sum * sum);
      Own own;
      own.sum = static_cast<float>(sum);
      own.cost_at_0 = kDearest;
      if (spread < kLeastVariance * kCount * kCount) return own;
      if (kWithoutMean) {
        own.cost_at_0 = kUnrelated;
        own.slope = kUnrelated / std::sqrt(spread);
      } else {
        // 1 - C of windows without relation is spread / (kCount square).
        own.cost_at_0 =
            kUnrelated * static_cast<float>(kCount) * static_cast<float>(square) / spread;
        own.slope = own.cost_at_0 / std::sqrt(static_cast<float>(square));
      }
      return own;
    };
    std::uint16_t* HWY_RESTRICT volume = job.volume + (y - kWindow + 1) * job.row_stride;
    const auto count = hn::Set(d, kCount);
    for (std::size_t l = 0; l < kLanes; l += n) {
      auto sum = hn::Zero(d), square = hn::Zero(d), product = hn::Zero(d);
      for (int x = 0; x < kWindow - 1; ++x) {
        const std::size_t at = static_cast<std::size_t>(x) * kLanes + l;
        sum = hn::Add(sum, hn::LoadU(d, sums + at));
        square = hn::Add(square, hn::LoadU(d, squares + at));
        product = hn::Add(product, hn::LoadU(d, products + at));
      }
      for (int x = 0; x < tile_width; ++x) {
        const std::size_t first = static_cast<std::size_t>(x) * kLanes + l;
        const std::size_t last = first + (kWindow - 1) * static_cast<std::size_t>(kLanes);
        sum = hn::Add(sum, hn::LoadU(d, sums + last));
        square = hn::Add(square, hn::LoadU(d, squares + last));
        product = hn::Add(product, hn::LoadU(d, products + last));
        const Own own = ownOf(x);
        const auto spread = hn::Sub(hn::Mul(count, square), hn::Mul(sum, sum));
        auto numerator = hn::ConvertTo(df, product);
        auto root = hn::Sqrt(hn::ConvertTo(df, hn::Max(square, hn::Set(d, 1))));
        if (kWithoutMean) {
          numerator = hn::ConvertTo(
              df, hn::Sub(hn::Mul(count, product),
                          hn::Mul(sum, hn::Set(d, static_cast<std::int32_t>(own.sum)))));
          root = hn::Sqrt(hn::ConvertTo(df, hn::Max(spread, hn::Set(d, 1))));
        }
        const auto cost = hn::Sub(hn::Set(df, own.cost_at_0),
                                  hn::Div(hn::Mul(hn::Set(df, own.slope), numerator), root));
        constexpr float kLeast = kLeastVariance * kCount * kCount;
        const auto plain = hn::Lt(hn::ConvertTo(df, spread), hn::Set(df, kLeast));
        const auto held = hn::Min(hn::Max(cost, hn::Zero(df)), hn::Set(df, kDearest));
        hn::StoreU(hn::NearestInt(hn::IfThenElse(plain, hn::Set(df, kDearest), held)), d,
                   costs + first);
        sum = hn::Sub(sum, hn::LoadU(d, sums + first));
        square = hn::Sub(square, hn::LoadU(d, squares + first));
        product = hn::Sub(product, hn::LoadU(d, products + first));
      }
    }
    for (int x = 0; x < tile_width; ++x)
      for (std::size_t l = 0; l < kLanes; l += n)
        hn::StoreU(
            hn::DemoteTo(d16, hn::LoadU(d, costs + static_cast<std::size_t>(x) * kLanes + l)), d16,
            volume + x * job.pixel_stride + l);
  }
}

template <bool kWithoutMean>
void CorrelateAny(const ChunkJob& job) {
  if (job.lanes == 16)
    CorrelateLanes<16, kWithoutMean>(job);
  else
    CorrelateLanes<32, kWithoutMean>(job);
}

void CorrelateChunk(const ChunkJob& job, bool without_mean) {
  if (without_mean)
    CorrelateAny<true>(job);
  else
    CorrelateAny<false>(job);
}

}  // namespace HWY_NAMESPACE
}  // namespace omnister::sweep
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace omnister::sweep {

HWY_EXPORT(CorrelateChunk);

void correlateChunk(const ChunkJob& job, bool without_mean) {
  HWY_DYNAMIC_DISPATCH(CorrelateChunk)(job, without_mean);
}

}  // namespace omnister::sweep
#endif  // HWY_ONCE
