// SPDX-License-Identifier: Apache-2.0
#include "sweep_filters.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "omnister/common/parallel.h"

namespace omnister::sweep {

void medianFilter(const cv::Mat& in, cv::Mat* out, int threads) {
  out->create(in.size(), CV_32FC1);
  parallelFor(0, in.rows, threads, [&](std::size_t row) {
    const int y = static_cast<int>(row);
    const float* here = in.ptr<float>(y);
    float* to = out->ptr<float>(y);
    for (int x = 0; x < in.cols; ++x) {
      to[x] = here[x];
      if (std::isnan(here[x])) continue;
      float values[9];
      int count = 0;
      for (int v = std::max(y - 1, 0); v <= std::min(y + 1, in.rows - 1); ++v) {
        const float* line = in.ptr<float>(v);
        for (int u = std::max(x - 1, 0); u <= std::min(x + 1, in.cols - 1); ++u)
          if (!std::isnan(line[u])) values[count++] = line[u];
      }
      if (count % 2 == 0) continue;
      std::nth_element(values, values + count / 2, values + count);
      to[x] = values[count / 2];
    }
  });
}

namespace {

std::int32_t rootOf(std::vector<std::int32_t>& parent, std::int32_t i) {
  while (parent[i] != i) {
    parent[i] = parent[parent[i]];
    i = parent[i];
  }
  return i;
}

}  // namespace

std::size_t removeSpeckles(cv::Mat* h, float step, int least, int) {
  const int width = h->cols, height = h->rows;
  std::vector<std::int32_t> parent(static_cast<std::size_t>(width) * height);
  std::iota(parent.begin(), parent.end(), 0);
  const auto unite = [&](std::int32_t a, std::int32_t b) {
    a = rootOf(parent, a);
    b = rootOf(parent, b);
    if (a != b) parent[std::max(a, b)] = std::min(a, b);
  };
  for (int y = 0; y < height; ++y) {
    const float* here = h->ptr<float>(y);
    const float* above = y ? h->ptr<float>(y - 1) : nullptr;
    for (int x = 0; x < width; ++x) {
      const std::int32_t i = y * width + x;
      if (x && std::fabs(here[x] - here[x - 1]) <= step) unite(i, i - 1);
      if (above && std::fabs(here[x] - above[x]) <= step) unite(i, i - width);
    }
  }
  std::vector<std::int32_t> size(parent.size(), 0);
  for (std::int32_t i = 0; i < static_cast<std::int32_t>(parent.size()); ++i)
    ++size[rootOf(parent, i)];
  std::size_t removed = 0;
  for (int y = 0; y < height; ++y) {
    float* here = h->ptr<float>(y);
    for (int x = 0; x < width; ++x) {
      if (std::isnan(here[x]) || size[rootOf(parent, y * width + x)] >= least) continue;
      here[x] = std::numeric_limits<float>::quiet_NaN();
      ++removed;
    }
  }
  return removed;
}

}  // namespace omnister::sweep
