// SPDX-License-Identifier: Apache-2.0
/// @file What the sweep's inner loops share; included once for every instruction set.
#include <cstdint>

#if defined(OMNISTER_SWEEP_KERNELS_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef OMNISTER_SWEEP_KERNELS_INL_H_
#undef OMNISTER_SWEEP_KERNELS_INL_H_
#else
#define OMNISTER_SWEEP_KERNELS_INL_H_
#endif

#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace omnister::sweep {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// x, x + 1, and so on. Iota of a variable is put together in memory, lane by lane.
template <class D>
HWY_INLINE hn::Vec<D> Count(D d, int x) {
  HWY_ALIGN static constexpr std::int32_t kFirst[16] = {0, 1, 2,  3,  4,  5,  6,  7,
                                                        8, 9, 10, 11, 12, 13, 14, 15};
  return hn::Add(hn::Load(d, kFirst), hn::Set(d, x));
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

}  // namespace HWY_NAMESPACE
}  // namespace omnister::sweep
HWY_AFTER_NAMESPACE();

#endif  // per-target include guard
