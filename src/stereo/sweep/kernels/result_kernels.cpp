// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "stereo/sweep/kernels/kernels.h"

// Highway builds this file once for every instruction set.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "src/stereo/sweep/kernels/result_kernels.cpp"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include "stereo/sweep/kernels/kernels-inl.h"

HWY_BEFORE_NAMESPACE();
namespace omnister::sweep {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

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
  for (int begin = 0; begin < job.count; begin += lanes) {
    // The last vector ends where the row does: behind it lie pixels of others.
    const int x = std::max(std::min(begin, job.count - lanes), 0);
    const auto own = hn::LoadU(du16, job.cost + x);
    auto lower = hn::FirstN(du16, lanes);
    if (job.merge) {
      lower = hn::Lt(own, hn::LoadU(du16, job.best + x));
      if (hn::AllFalse(du16, lower)) continue;
    }
    const auto c = load(job.cost + x), before = load(job.before + x), after = load(job.after + x);
    const auto k = hn::PromoteTo(di, hn::LoadU(di16, job.index + x));
    const auto steep = hn::Sub(hn::Max(before, after), c);
    const auto cell = hn::Add(hn::LoadU(di, job.base + x), k);
    const auto phi = hn::PromoteTo(di, hn::LoadU(du16, job.phi + x));
    auto good =
        hn::And(hn::Ne(phi, hn::Set(di, kNoRay)), hn::Lt(Count(di, x), hn::Set(di, job.count)));
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
    auto fine = hn::RebindMask(df, good);
    fine = hn::And(fine, hn::Le(c, hn::Set(df, job.worst_cost)));
    if (!job.chosen) {
      fine = hn::And(fine, hn::Gt(steep, hn::Zero(df)));
      // The least at the end of an interval is the foot of one beyond it.
      fine = hn::And(fine, hn::And(hn::Ge(before, c), hn::Ge(after, c)));
    }
    // The pixels of a window fall between columns, each elsewhere: their sum is rounder than two
    // lines and sharper than a parabola. With this gain a shift of all columns leaves no bias.
    constexpr float kGain = 0.62f, kParabola = 0.5f;
    const auto bend =
        hn::Div(hn::Mul(hn::Sub(before, after), hn::Set(df, job.parabola ? kParabola : kGain)),
                hn::Max(hn::Sub(hn::Add(before, after), hn::Add(c, c)), hn::Set(df, 1.0f)));
    // Beyond that where the middle is not the least.
    constexpr float kMost = 0.62f;
    const auto shift = hn::Min(hn::Max(bend, hn::Set(df, -kMost)), hn::Set(df, kMost));
    const auto guess = hn::Add(hn::Mul(hn::ConvertTo(df, Count(di, x)), hn::Set(df, job.guess_x)),
                               hn::Set(df, job.guess));
    const auto columns =
        hn::Add(hn::Add(hn::ConvertTo(df, k), shift), hn::LoadU(df, job.residual + x));
    const auto h = hn::Mul(hn::Add(columns, guess), hn::Set(df, job.step_h));
    const auto change = hn::Lt(c, job.merge ? load(job.best + x) : hn::Inf(df));
    const auto put = [&](auto d, auto where, auto value, auto* to) {
      hn::StoreU(job.merge ? hn::IfThenElse(where, value, hn::LoadU(d, to)) : value, d, to);
    };
    put(df, change, hn::IfThenElse(fine, h, hn::NaN(df)), job.h + x);
    if (job.steep) {
      auto rise = hn::Max(steep, hn::Zero(df));
      if (job.parabola) rise = hn::Mul(hn::Sqrt(rise), hn::Set(df, kSteepOfParabola));
      put(du16, lower, hn::DemoteTo(du16, hn::ConvertTo(di, rise)), job.steep + x);
    }
    put(du16, lower, own, job.best + x);
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
      put(di, hn::RebindMask(di, change),
          hn::IfThenElse(hn::RebindMask(di, fine), at, hn::Set(di, -1)), job.claim + x);
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
    // Neighbours often claim the same: between them come others, so that none waits.
    for (const int first : {0, 1}) {
      for (int i = first; i < lanes; i += 2) {
        // The lesser of two that are not negative, without a branch that half would take wrongly.
        const std::int32_t less = value[i] - claims[at[i]];
        claims[at[i]] += less & (less >> 31);
      }
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
  HWY_ALIGN std::int32_t at[HWY_MAX_BYTES / 4], spot[HWY_MAX_BYTES / 4];
  for (int x = 0; x < count; x += lanes) {
    const auto h = hn::LoadU(df, job.h[1] + x);
    const auto known =
        hn::And(hn::RebindMask(df, hn::Lt(Count(di, x), hn::Set(di, count))), hn::Eq(h, h));
    if (hn::AllFalse(df, known)) {
      hn::StoreU(hn::NaN(df), df, job.out + x);
      continue;
    }
    hn::Vec<decltype(di)> element, mine;
    Claim(di, job.claimed, x, &element, &mine);
    // A spot beside its own will do: claims stand on a grid.
    hn::Store(element, di, at);
    auto nearest = hn::Set(di, 0x7FFF);
    const bool strict = job.strict && job.strict[x / job.tile_width];
    for (const int aside : {0, -1, 1}) {
      if (aside != 0 && strict) break;
      for (int i = 0; i < lanes; ++i) spot[i] = claims[std::max(at[i] + aside, 0)];
      const auto theirs = hn::And(hn::Load(di, spot), hn::Set(di, 0xFFFF));
      nearest = hn::Min(nearest, hn::Abs(hn::Sub(theirs, mine)));
    }
    const auto apart = hn::Gt(nearest, hn::Set(di, job.tolerance));
    const auto lost = hn::And(known, hn::RebindMask(df, apart));

    const auto side = [&](int row, int dx) { return hn::LoadU(df, job.h[row] + x + dx); };
    const auto up = side(0, 0), down = side(2, 0);
    const auto left = side(1, -kReach), right = side(1, kReach);
    // Comparisons with NaN are false.
    const auto beyond = [&](decltype(h) other) { return hn::Gt(hn::Sub(h, other), jump); };
    auto edge = hn::Or(hn::Or(beyond(up), beyond(down)), hn::Or(beyond(left), beyond(right)));
    if (!strict) edge = hn::RebindMask(df, hn::Ne(mine, mine));
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
    // Not std::copy: to GCC, that looks like one of less than nothing where a vector has one lane.
    for (int i = 0; i < count; ++i) to[i] = last[i];
  }
}

void AverageRow(const float* const rows[kAverageRows], int count, float near,
                float* HWY_RESTRICT out) {
  constexpr int kReach = kAverageRows / 2;
  const hn::ScalableTag<float> d;
  const int lanes = static_cast<int>(hn::Lanes(d));
  for (int x = 0; x < count; x += lanes) {
    const auto middle = hn::LoadU(d, rows[kReach] + x);
    if (hn::AllTrue(d, hn::IsNaN(middle))) {
      StoreFront(d, middle, out + x, count - x);
      continue;
    }
    const auto load = [&](int dx, int dy) {
      const auto v = hn::LoadU(d, rows[kReach + dy] + x + dx);
      return hn::IfThenElse(hn::IsNaN(v), middle, v);
    };
    auto a = load(-1, -1), b = load(0, -1), c = load(1, -1);
    auto e = load(-1, 0), f = middle, g = load(1, 0);
    auto i = load(-1, 1), j = load(0, 1), k = load(1, 1);
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
    auto sum = hn::Zero(d), number = hn::Set(d, 1.0f);
    for (int dy = -kReach; dy <= kReach; dy += kReach) {
      for (int dx = -kReach; dx <= kReach; dx += kReach) {
        if (dx == 0 && dy == 0) continue;
        // Comparisons with NaN are false.
        const auto apart = hn::Sub(hn::LoadU(d, rows[kReach + dy] + x + dx), f);
        const auto close = hn::Le(hn::Abs(apart), hn::Set(d, near));
        sum = hn::Add(sum, hn::IfThenElseZero(close, apart));
        number = hn::Add(number, hn::IfThenElseZero(close, hn::Set(d, 1.0f)));
      }
    }
    f = hn::Add(f, hn::Div(sum, number));
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
    if (hn::AllFalse(d, known)) {
      for (float* to : {job->range, job->sigma, job->score})
        StoreFront(d, nan, to + x, job->count - x);
      continue;
    }
    const auto cost = load(job->cost + x);
    const auto steep = hn::Max(load(job->steep + x), hn::Set(d, 1.0f));
    const auto one = hn::Set(d, 1.0f);
    // Spread of the least: noise of the costs over the slope beside it.
    const bool settled = !job->sure || job->sure[x / job->tile_width];
    const auto slope = hn::Set(d, settled ? kSigmaOfCost : kSigmaOfDoubt);
    const auto least = hn::Set(d, settled ? kLeastSpread : kLeastOfDoubt);
    const auto noise = hn::Sqrt(hn::Add(cost, hn::Set(d, 20.0f)));
    const auto sigma_h =
        hn::Mul(hn::Add(hn::Div(hn::Mul(noise, slope), steep), least), hn::Set(d, job->step_h));
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

}  // namespace HWY_NAMESPACE
}  // namespace omnister::sweep
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace omnister::sweep {

HWY_EXPORT(ConcludeRow);
HWY_EXPORT(ClaimRow);
HWY_EXPORT(RejectRow);
HWY_EXPORT(AverageRow);
HWY_EXPORT(TriangulateRow);

void concludeRow(ConcludeJob* job) { HWY_DYNAMIC_DISPATCH(ConcludeRow)(job); }

void claimRow(const ClaimJob& job) { HWY_DYNAMIC_DISPATCH(ClaimRow)(job); }

void rejectRow(RejectJob* job) { HWY_DYNAMIC_DISPATCH(RejectRow)(job); }

void averageRow(const float* const rows[kAverageRows], int count, float near, float* out) {
  HWY_DYNAMIC_DISPATCH(AverageRow)(rows, count, near, out);
}

void triangulateRow(TriangulateJob* job) { HWY_DYNAMIC_DISPATCH(TriangulateRow)(job); }

}  // namespace omnister::sweep
#endif  // HWY_ONCE
