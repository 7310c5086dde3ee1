// SPDX-License-Identifier: Apache-2.0
#include "stereo/sweep/refine/filters.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "omnister/common/parallel.h"

namespace omnister::sweep {
namespace {

/// Pixels of a row that are connected along it.
struct Run {
  std::int32_t begin, end;
  std::int32_t parent;  ///< a run's index; roots point at themselves
};

/// Rows labelled by one task, then joined to the strip above.
struct Strip {
  int begin = 0, end = 0;  ///< rows
  std::vector<Run> runs;
  std::vector<std::int32_t> rows;  ///< first run of each row, and one more
  std::int32_t offset = 0;         ///< of its runs among all
};

std::int32_t rootOf(std::vector<Run>& runs, std::int32_t i) {
  while (runs[i].parent != i) {
    runs[i].parent = runs[runs[i].parent].parent;
    i = runs[i].parent;
  }
  return i;
}

void unite(std::vector<Run>& runs, std::int32_t a, std::int32_t b) {
  a = rootOf(runs, a);
  b = rootOf(runs, b);
  if (a < b)
    runs[b].parent = a;
  else
    runs[a].parent = b;
}

/// 1 where two rows, or a row and itself one pixel on, are connected.
void link(const float* a, const float* b, float step, int count, std::uint8_t* out) {
  for (int x = 0; x < count; ++x) out[x] = std::fabs(a[x] - b[x]) <= step ? 1 : 0;
}

void appendRuns(const float* h, const std::uint8_t* linked, int width, std::vector<Run>* runs) {
  int x = 0;
  while (x < width) {
    if (std::isnan(h[x])) {
      ++x;
      continue;
    }
    // linked[i]: pixel i and i + 1.
    const void* gap = std::memchr(linked + x, 0, width - 1 - x);
    const int end =
        gap ? static_cast<int>(static_cast<const std::uint8_t*>(gap) - linked) + 1 : width;
    const auto index = static_cast<std::int32_t>(runs->size());
    runs->push_back({x, end, index});
    x = end;
  }
}

/// Joins the runs [a, a_end) of one row with [b, b_end) of the next.
void joinRows(std::vector<Run>& runs, std::int32_t a, std::int32_t a_end, std::int32_t b,
              std::int32_t b_end, const std::uint8_t* linked) {
  while (a < a_end && b < b_end) {
    const std::int32_t from = std::max(runs[a].begin, runs[b].begin);
    const std::int32_t to = std::min(runs[a].end, runs[b].end);
    if (from < to && std::memchr(linked + from, 1, to - from)) unite(runs, a, b);
    if (runs[a].end < runs[b].end)
      ++a;
    else
      ++b;
  }
}

}  // namespace

std::size_t removeSpeckles(cv::Mat* h, float step, int least, int threads) {
  constexpr int kStripRows = 48;
  const int width = h->cols, height = h->rows;
  std::vector<Strip> strips((height + kStripRows - 1) / kStripRows);
  parallelFor(0, strips.size(), threads, [&](std::size_t s) {
    Strip& strip = strips[s];
    strip.begin = static_cast<int>(s) * kStripRows;
    strip.end = std::min(strip.begin + kStripRows, height);
    std::vector<std::uint8_t> linked(width + 1, 0);
    strip.runs.reserve(static_cast<std::size_t>(kStripRows) * 32);
    for (int y = strip.begin; y < strip.end; ++y) {
      const float* here = h->ptr<float>(y);
      strip.rows.push_back(static_cast<std::int32_t>(strip.runs.size()));
      link(here, here + 1, step, width - 1, linked.data());
      appendRuns(here, linked.data(), width, &strip.runs);
      if (y == strip.begin) continue;
      link(here, h->ptr<float>(y - 1), step, width, linked.data());
      const std::size_t row = strip.rows.size() - 1;
      joinRows(strip.runs, strip.rows[row - 1], strip.rows[row], strip.rows[row],
               static_cast<std::int32_t>(strip.runs.size()), linked.data());
    }
    strip.rows.push_back(static_cast<std::int32_t>(strip.runs.size()));
  });

  std::vector<Run> runs;
  std::size_t count = 0;
  for (Strip& strip : strips) {
    strip.offset = static_cast<std::int32_t>(count);
    count += strip.runs.size();
  }
  runs.reserve(count);
  std::vector<std::uint8_t> linked(width + 1, 0);
  for (std::size_t s = 0; s < strips.size(); ++s) {
    const Strip& strip = strips[s];
    for (Run run : strip.runs) {
      run.parent += strip.offset;
      runs.push_back(run);
    }
    if (s == 0) continue;
    const Strip& above = strips[s - 1];
    const std::size_t last = above.rows.size() - 2;
    link(h->ptr<float>(strip.begin), h->ptr<float>(strip.begin - 1), step, width, linked.data());
    joinRows(runs, above.rows[last] + above.offset, above.rows[last + 1] + above.offset,
             strip.rows[0] + strip.offset, strip.rows[1] + strip.offset, linked.data());
  }
  std::vector<std::int32_t> size(runs.size(), 0);
  for (std::size_t i = 0; i < runs.size(); ++i) {
    // A parent is never behind its child, so one look is enough once parents are flat.
    runs[i].parent = runs[runs[i].parent].parent;
    size[runs[i].parent] += runs[i].end - runs[i].begin;
  }
  std::atomic<std::size_t> removed{0};
  parallelFor(0, strips.size(), threads, [&](std::size_t s) {
    const Strip& strip = strips[s];
    std::size_t gone = 0;
    for (int y = strip.begin; y < strip.end; ++y) {
      float* here = h->ptr<float>(y);
      const std::int32_t first = strip.rows[y - strip.begin] + strip.offset;
      const std::int32_t end = strip.rows[y - strip.begin + 1] + strip.offset;
      for (std::int32_t i = first; i < end; ++i) {
        if (size[runs[i].parent] >= least) continue;
        std::fill(here + runs[i].begin, here + runs[i].end,
                  std::numeric_limits<float>::quiet_NaN());
        gone += runs[i].end - runs[i].begin;
      }
    }
    removed += gone;
  });
  return removed;
}

}  // namespace omnister::sweep
