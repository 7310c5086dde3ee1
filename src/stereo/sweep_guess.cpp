// SPDX-License-Identifier: Apache-2.0
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "sweep_level.h"

namespace omnister::sweep {
namespace {

constexpr float kMiddleX = 32, kMiddleY = 24;   ///< where planes are fitted about
constexpr int kNarrowLanes = 14;                ///< hypotheses of the cheapest chunk
constexpr int kSearchMargin = 3;                ///< columns beyond what the coarser level found
constexpr int kMostPlanes = 3;                  ///< of a tile
constexpr int kSampleStep = 3;                  ///< pixels of the coarser level between samples
constexpr int kNeeded = 3, kNeededShare = 150;  ///< samples that make the search go somewhere
constexpr float kOnPlane = 3.4f;                ///< columns off a plane that still belong to it,
constexpr float kFarOff = 16;                   ///< or are looked for from it
constexpr int kBeyond = 8;                      ///< pixels around where a plane was seen
constexpr float kSteepest = 1.2f;               ///< columns a pixel that a plane may rise

/// Least squares, reweighted. @param rounds 1: from scratch; 3: only refined
bool fitPlane(const std::vector<Sample>& samples, int start, Guess* guess) {
  const std::size_t stride = std::max<std::size_t>(1, samples.size() / 96);
  Eigen::Vector3f plane((*guess).x, (*guess).y, (*guess)(kMiddleX, kMiddleY));
  for (int iteration = start - 1; iteration < 4; ++iteration) {
    Eigen::Matrix3f A = Eigen::Matrix3f::Zero();
    Eigen::Vector3f b = Eigen::Vector3f::Zero();
    for (std::size_t i = 0; i < samples.size(); i += stride) {
      const Eigen::Vector3f row(samples[i].x - kMiddleX, samples[i].y - kMiddleY, 1);
      const float error = samples[i].columns - plane.dot(row);
      const float scale = iteration == 1 ? 6.0f : 2.0f;
      const float weight = iteration == 0 ? 1.0f : 1 / (1 + error * error / (scale * scale));
      A += weight * row * row.transpose();
      b += weight * samples[i].columns * row;
    }
    A.diagonal().array() += 1e-3f;
    plane = A.inverse() * b;
    if (!plane.allFinite()) return false;
  }
  guess->x = plane.x();
  guess->y = plane.y();
  guess->at = plane.z() - kMiddleX * plane.x() - kMiddleY * plane.y();
  return std::hypot(guess->x, guess->y) <= kSteepest;
}

/// The plane through three neighbouring samples that most others lie on.
bool samplePlane(const std::vector<Sample>& samples, int needed, Guess* guess) {
  constexpr int kTrials = 12;
  const std::size_t n = samples.size();
  const std::size_t stride = std::max<std::size_t>(1, n / 96);
  std::uint32_t random = 12345;
  int best = 3 * needed / static_cast<int>(stride);
  bool found = false;
  for (int trial = 0; trial < kTrials; ++trial) {
    random = random * 1664525u + 1013904223u;
    const std::size_t i = (random >> 8) % n;
    const Sample &a = samples[i], &b = samples[(i + 3 + trial % 4) % n];
    const Sample& c = samples[(i + 42 + trial) % n];
    const float bx = b.x - a.x, by = b.y - a.y, cx = c.x - a.x, cy = c.y - a.y;
    const float area = bx * cy - by * cx;
    if (std::fabs(area) < 40) continue;
    const float bz = b.columns - a.columns, cz = c.columns - a.columns;
    Guess trial_plane;
    trial_plane.x = (bz * cy - cz * by) / area;
    trial_plane.y = (cz * bx - bz * cx) / area;
    if (std::hypot(trial_plane.x, trial_plane.y) > kSteepest) continue;
    trial_plane.at = a.columns - trial_plane.x * a.x - trial_plane.y * a.y;
    int on = 0;
    for (std::size_t k = 0; k < n; k += stride) {
      on += std::fabs(samples[k].columns - trial_plane(samples[k].x, samples[k].y)) < 1.5f;
    }
    if (on <= best) continue;
    best = on;
    *guess = trial_plane;
    found = true;
  }
  return found;
}

/// The planes that most samples lie on, one after the other.
void findPlanes(int needed, Scratch* scratch) {
  std::vector<Sample>& left = scratch->others;
  left = scratch->samples;
  for (int plane = 0; plane < kMostPlanes; ++plane) {
    Guess guess;
    const auto isOff = [&](const Sample& s) {
      return std::fabs(s.columns - guess(s.x, s.y)) > kOnPlane;
    };
    const bool smooth = plane == 0 && fitPlane(left, 1, &guess) &&
                        std::count_if(left.begin(), left.end(), isOff) * 6 <=
                            static_cast<std::ptrdiff_t>(left.size());
    if (!smooth && (!samplePlane(left, needed, &guess) || !fitPlane(left, 3, &guess))) return;
    const auto end =
        std::remove_if(left.begin(), left.end(), [&](const Sample& s) { return !isOff(s); });
    if (left.end() - end < 3 * needed) return;
    left.erase(end, left.end());
    scratch->guesses.push_back(guess);
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
  guesses.assign(1, {0, 0, 0, {{least, most}}, whole});
  if (!coarse) return;
  constexpr int kAround = 6;
  const int x0 = std::max(tile.rect.x / 2 - kAround, 0);
  const int y0 = std::max(tile.rect.y / 2 - kAround, 0);
  const int x1 = std::min(tile.rect.br().x / 2 + kAround, coarse->cols);
  const int y1 = std::min(tile.rect.br().y / 2 + kAround, coarse->rows);
  std::vector<Sample>& samples = scratch->samples;
  samples.clear();
  int seen = 0;
  for (int y = y0; y < y1; y += kSampleStep) {
    const float* line = coarse->ptr<float>(y);
    for (int x = x0 + y % 2; x < x1; x += kSampleStep) {
      ++seen;
      const float columns = line[x] * to_columns;
      if (columns >= least - 2 && columns <= most + 2)  // neither NaN nor beyond
        samples.push_back({2 * x + 0.5f - tile.rect.x, 2 * y + 0.5f - tile.rect.y, columns});
    }
  }
  if (static_cast<int>(samples.size()) * 8 < seen) return;
  // A few stray pixels do not widen the search; a thin object does.
  const int needed = std::max(kNeeded, static_cast<int>(samples.size()) / kNeededShare);
  guesses.clear();
  if (most - least > kNarrowLanes) findPlanes(needed, scratch);

  // Every sample goes to the plane nearest to it, or to none; these are looked for one and all
  // where they are.
  const std::size_t planes = guesses.size();
  std::vector<std::uint8_t>& owner = scratch->owner;
  owner.resize(samples.size());
  std::size_t strays = 0;
  for (std::size_t i = 0; i < samples.size(); ++i) {
    float nearest = kFarOff;
    owner[i] = static_cast<std::uint8_t>(planes);
    for (std::size_t p = 0; p < planes; ++p) {
      const float off = std::fabs(samples[i].columns - guesses[p](samples[i].x, samples[i].y));
      if (off > nearest) continue;
      nearest = off;
      owner[i] = static_cast<std::uint8_t>(p);
    }
    strays += owner[i] == planes;
  }
  if (strays > 0) guesses.push_back({});
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
    const auto bin = [&](const Sample& s) {
      const float off = s.columns - guess(s.x, s.y);
      return 1 + std::clamp(static_cast<int>(std::lround(off)), from, to) - from;
    };
    for (std::size_t i = 0; i < samples.size(); ++i) {
      if (owner[i] == p) ++histogram[bin(samples[i])];
    }
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
    for (std::size_t i = 0; i < samples.size(); ++i) {
      const int* count = &histogram[owner[i] == p ? bin(samples[i]) : 1];
      if (owner[i] != p || count[-1] + count[0] + count[1] < needed) continue;
      x_min = std::min(x_min, samples[i].x);
      x_max = std::max(x_max, samples[i].x);
      y_min = std::min(y_min, samples[i].y);
      y_max = std::max(y_max, samples[i].y);
    }
    const cv::Point corner(static_cast<int>(x_min) - kBeyond, static_cast<int>(y_min) - kBeyond);
    const cv::Point end(static_cast<int>(x_max) + kBeyond, static_cast<int>(y_max) + kBeyond);
    guess.where &= cv::Rect(corner, end);
  }
  guesses.erase(std::remove_if(guesses.begin(), guesses.end(),
                               [](const Guess& guess) {
                                 return guess.intervals.empty() || guess.where.empty();
                               }),
                guesses.end());
  if (guesses.empty()) guesses.push_back({0, 0, 0, {{least, most}}, whole});
}

}  // namespace omnister::sweep
