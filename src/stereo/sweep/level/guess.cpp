// SPDX-License-Identifier: Apache-2.0
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "stereo/sweep/level/level.h"

namespace omnister::sweep {
namespace {

constexpr float kMiddleX = 32, kMiddleY = 24;  ///< where planes are fitted about
constexpr int kNarrowLanes = 14;               ///< hypotheses of the cheapest chunk
constexpr int kSearchMargin = 3;               ///< columns beyond what the coarser level found
constexpr int kMostPlanes = 3;                 ///< of a tile
constexpr int kSampleStep = 3;                 ///< pixels of the coarser level between samples
constexpr int kNeeded = 4, kNeededShare = 80;  ///< samples that make the search go somewhere
constexpr float kOnPlane = 3.4f;               ///< columns off a plane that still belong to it,
constexpr float kFarOff = 16;                  ///< or are looked for from it
constexpr int kLeastWidth = 16;                ///< pixels, of what is searched at once
constexpr int kBeyond = 8;                     ///< pixels around where a plane was seen
constexpr float kSteepest = 1.2f;              ///< columns a pixel that a plane may rise

/// Least squares, reweighted. @param rounds 1: from scratch; 3: only refined
bool fitPlane(const Samples& samples, int start, Plane* guess) {
  using Lanes = Eigen::Array4f;
  constexpr std::size_t kLanes = 4;
  const std::size_t n = samples.size(), whole = n / kLanes * kLanes;
  // Those that fill no vector, and how many count.
  Lanes last[3] = {Lanes::Zero(), Lanes::Zero(), Lanes::Zero()}, counted = Lanes::Zero();
  for (std::size_t i = whole; i < n; ++i) {
    const auto k = static_cast<Eigen::Index>(i - whole);
    last[0][k] = samples.x[i];
    last[1][k] = samples.y[i];
    last[2][k] = samples.columns[i];
    counted[k] = 1;
  }
  Eigen::Vector3f plane((*guess).x, (*guess).y, (*guess)(kMiddleX, kMiddleY));
  for (int iteration = start - 1; iteration < 4; ++iteration) {
    Lanes w = Lanes::Zero(), u = w, v = w, uu = w, uv = w, vv = w, z = w, uz = w, vz = w;
    const float scale = iteration == 1 ? 6.0f : 2.0f;
    const float inverse = iteration == 0 ? 0.0f : 1 / (scale * scale);
    const auto add = [&](const Lanes& x, const Lanes& y, const Lanes& columns, const Lanes& most) {
      const Lanes du = x - kMiddleX, dv = y - kMiddleY;
      const Lanes error = columns - (plane.x() * du + plane.y() * dv + plane.z());
      const Lanes weight = most / (1 + error * error * inverse);
      const Lanes wu = weight * du, wv = weight * dv;
      w += weight;
      u += wu;
      v += wv;
      uu += wu * du;
      uv += wu * dv;
      vv += wv * dv;
      z += weight * columns;
      uz += wu * columns;
      vz += wv * columns;
    };
    for (std::size_t i = 0; i < whole; i += kLanes) {
      add(Lanes::Map(&samples.x[i]), Lanes::Map(&samples.y[i]), Lanes::Map(&samples.columns[i]),
          Lanes::Ones());
    }
    if (whole < n) add(last[0], last[1], last[2], counted);
    Eigen::Matrix3f A;
    A << uu.sum(), uv.sum(), u.sum(), uv.sum(), vv.sum(), v.sum(), u.sum(), v.sum(), w.sum();
    A.diagonal().array() += 1e-3f;
    plane = A.inverse() * Eigen::Vector3f(uz.sum(), vz.sum(), z.sum());
    if (!plane.allFinite()) return false;
  }
  guess->x = plane.x();
  guess->y = plane.y();
  guess->at = plane.z() - kMiddleX * plane.x() - kMiddleY * plane.y();
  return std::hypot(guess->x, guess->y) <= kSteepest;
}

/// Samples that are nearer to a plane than that.
int countNear(const Samples& samples, const Plane& plane, float limit) {
  const float *x = samples.x.data(), *y = samples.y.data(), *columns = samples.columns.data();
  const int n = static_cast<int>(samples.size());
  int near = 0;
  for (int i = 0; i < n; ++i) near += std::fabs(columns[i] - plane(x[i], y[i])) < limit ? 1 : 0;
  return near;
}

/// The plane through three neighbouring samples that most others lie on.
bool samplePlane(const Samples& samples, int needed, Plane* guess) {
  constexpr int kTrials = 12;
  const std::size_t n = samples.size();
  std::uint32_t random = 12345;
  int best = 3 * needed;
  bool found = false;
  for (int trial = 0; trial < kTrials; ++trial) {
    random = random * 1664525u + 1013904223u;
    const std::size_t a = (random >> 8) % n, b = (a + 3 + trial % 4) % n, c = (a + 42 + trial) % n;
    const float ax = samples.x[a], ay = samples.y[a], az = samples.columns[a];
    const float bx = samples.x[b] - ax, by = samples.y[b] - ay, bz = samples.columns[b] - az;
    const float cx = samples.x[c] - ax, cy = samples.y[c] - ay, cz = samples.columns[c] - az;
    const float area = bx * cy - by * cx;
    if (std::fabs(area) < 40) continue;
    Plane trial_plane;
    trial_plane.x = (bz * cy - cz * by) / area;
    trial_plane.y = (cz * bx - bz * cx) / area;
    if (std::hypot(trial_plane.x, trial_plane.y) > kSteepest) continue;
    trial_plane.at = az - trial_plane.x * ax - trial_plane.y * ay;
    const int on = countNear(samples, trial_plane, 1.5f);
    if (on <= best) continue;
    best = on;
    *guess = trial_plane;
    found = true;
  }
  return found;
}

/// Keeps the samples off a plane. @return how many went
int removeNear(const Plane& plane, Samples* samples) {
  std::size_t kept = 0;
  for (std::size_t i = 0; i < samples->size(); ++i) {
    const float x = samples->x[i], y = samples->y[i], columns = samples->columns[i];
    samples->x[kept] = x;
    samples->y[kept] = y;
    samples->columns[kept] = columns;
    kept += std::fabs(columns - plane(x, y)) > kOnPlane;
  }
  const int gone = static_cast<int>(samples->size() - kept);
  samples->resize(kept);
  return gone;
}

/// The planes that most samples lie on, one after the other.
void findPlanes(int needed, Scratch* scratch) {
  Samples& left = scratch->others;
  left = scratch->samples;
  for (int found = 0; found < kMostPlanes; ++found) {
    Plane plane;
    const int n = static_cast<int>(left.size());
    const bool smooth =
        found == 0 && fitPlane(left, 1, &plane) && (n - countNear(left, plane, kOnPlane)) * 6 <= n;
    if (!smooth && (!samplePlane(left, needed, &plane) || !fitPlane(left, 3, &plane))) return;
    if (removeNear(plane, &left) < 3 * needed) return;
    scratch->guesses.push_back({plane, {}, {}});
    if (static_cast<int>(left.size()) < 3 * needed) return;
  }
}

}  // namespace

void guessTile(const cv::Mat* coarse, const Tile& tile, const Band& band, Scratch* scratch) {
  std::vector<Guess>& guesses = scratch->guesses;
  const float to_columns = static_cast<float>(1 / band.step_h);
  const int least = static_cast<int>(std::floor(tile.h_min * to_columns)) - 1;
  const int most = static_cast<int>(std::ceil(tile.h_max * to_columns)) + 1;
  const cv::Rect whole(0, 0, tile.rect.width, tile.rect.height);
  guesses.assign(1, {{}, {{least, most}}, whole});
  if (!coarse) return;
  constexpr int kAround = 6;
  const int x0 = std::max(tile.rect.x / 2 - kAround, 0);
  const int y0 = std::max(tile.rect.y / 2 - kAround, 0);
  const int x1 = std::min(tile.rect.br().x / 2 + kAround, coarse->cols);
  const int y1 = std::min(tile.rect.br().y / 2 + kAround, coarse->rows);
  Samples& samples = scratch->samples;
  samples.resize(static_cast<std::size_t>(std::max((y1 - y0) / kSampleStep + 1, 0)) *
                 std::max((x1 - x0) / kSampleStep + 1, 0));
  int seen = 0;
  std::size_t found = 0;
  for (int y = y0; y < y1; y += kSampleStep) {
    const float* line = coarse->ptr<float>(y);
    for (int x = x0 + y % 2; x < x1; x += kSampleStep) {
      ++seen;
      const float seen_at = line[x] * to_columns;
      samples.x[found] = 2 * x + 0.5f - tile.rect.x;
      samples.y[found] = 2 * y + 0.5f - tile.rect.y;
      samples.columns[found] = seen_at;
      found += seen_at >= least - 2 && seen_at <= most + 2;  // neither NaN nor beyond
    }
  }
  samples.resize(found);
  if (static_cast<int>(found) * 8 < seen) return;
  // A few stray pixels do not widen the search; a thin object does.
  const int needed = std::max(kNeeded, static_cast<int>(found) / kNeededShare);
  guesses.clear();
  if (most - least > kNarrowLanes) findPlanes(needed, scratch);

  // Every sample goes to the plane nearest to it, or to none; these are looked for one and all
  // where they are.
  const std::size_t planes = guesses.size();
  const float *x = samples.x.data(), *y = samples.y.data(), *columns = samples.columns.data();
  std::vector<std::int32_t>& owner = scratch->owner;
  owner.assign(found, static_cast<std::int32_t>(planes));
  std::vector<float>& nearest = scratch->nearest;
  nearest.assign(found, kFarOff);
  for (std::size_t p = 0; p < planes; ++p) {
    const Plane plane = guesses[p];
    const auto number = static_cast<std::int32_t>(p);
    for (std::size_t i = 0; i < found; ++i) {
      const float off = std::fabs(columns[i] - plane(x[i], y[i]));
      owner[i] = off <= nearest[i] ? number : owner[i];
      nearest[i] = std::min(nearest[i], off);
    }
  }
  const bool strays =
      std::find(owner.begin(), owner.end(), static_cast<std::int32_t>(planes)) != owner.end();
  if (strays) guesses.push_back({});
  const float right = static_cast<float>(tile.rect.width - 1);
  const float bottom = static_cast<float>(tile.rect.height - 1);
  bool covered = false;
  for (std::size_t p = 0; p < guesses.size(); ++p) {
    Guess& guess = guesses[p];
    const auto [low, high] =
        std::minmax({guess(0, 0), guess(right, 0), guess(0, bottom), guess(right, bottom)});
    const int from = least - static_cast<int>(std::ceil(high));
    const int to = most - static_cast<int>(std::floor(low));
    std::vector<int>& histogram = scratch->histogram;
    histogram.assign(to - from + 3, 0);
    // The first bin stays empty: it is that of others' samples.
    std::vector<std::int32_t>& bins = scratch->bins;
    bins.resize(found);
    const Plane plane = guess;
    const auto number = static_cast<std::int32_t>(p);
    const float first_bin = static_cast<float>(from), last_bin = static_cast<float>(to);
    for (std::size_t i = 0; i < found; ++i) {
      const float off = columns[i] - plane(x[i], y[i]);
      const float held = std::min(std::max(off, first_bin), last_bin);
      const int bin = 1 + static_cast<int>(held - first_bin + 0.5f);
      bins[i] = owner[i] == number ? bin : 0;
    }
    for (const std::int32_t bin : bins) ++histogram[bin];
    histogram[0] = 0;
    for (int k = from; k <= to; ++k) {
      const int* count = &histogram[1 + k - from];
      if (count[0] == 0 || count[-1] + count[0] + count[1] < needed) continue;
      const int first = std::max(k - kSearchMargin, from);
      const int last = std::min(k + kSearchMargin, to);
      if (!guess.intervals.empty() && first <= guess.intervals.back().second + 4)
        guess.intervals.back().second = last;
      else
        guess.intervals.emplace_back(first, last);
    }
    // The first is looked for all over, so that every pixel is told something.
    guess.where = whole;
    if (guess.intervals.empty() || !std::exchange(covered, true)) continue;
    float x_min = right, x_max = 0, y_min = bottom, y_max = 0;
    for (std::size_t i = 0; i < found; ++i) {
      if (bins[i] == 0) continue;
      const int* count = &histogram[bins[i]];
      if (count[-1] + count[0] + count[1] < needed) continue;
      x_min = std::min(x_min, x[i]);
      x_max = std::max(x_max, x[i]);
      y_min = std::min(y_min, y[i]);
      y_max = std::max(y_max, y[i]);
    }
    const cv::Point corner(static_cast<int>(x_min) - kBeyond, static_cast<int>(y_min) - kBeyond);
    const cv::Point end(static_cast<int>(x_max) + kBeyond, static_cast<int>(y_max) + kBeyond);
    guess.where &= cv::Rect(corner, end);
    // No narrower than the widest vector, which must not reach into another tile.
    const int lacking = std::min(kLeastWidth, whole.width) - guess.where.width;
    if (lacking > 0) {
      guess.where.x = std::max(guess.where.x - lacking, 0);
      guess.where.width += lacking;
    }
  }
  guesses.erase(std::remove_if(guesses.begin(), guesses.end(),
                               [](const Guess& guess) {
                                 return guess.intervals.empty() || guess.where.empty();
                               }),
                guesses.end());
  if (guesses.empty()) guesses.push_back({{}, {{least, most}}, whole});
}

}  // namespace omnister::sweep
