// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <limits>
#include <utility>

#include "omnister/common/parallel.h"
#include "stereo/sweep/level/cost.h"
#include "stereo/sweep/level/level.h"

namespace omnister::sweep {
namespace {

constexpr int kBlock = 16;  ///< pixels that share a local epipolar frame

}  // namespace

void describeDisplaced(const CostFunction& cost, Level* level, int threads,
                       const std::function<Scratch&()>& local, std::vector<std::uint16_t>* pairs) {
  constexpr int kStrip = 24;
  const Grid& grid = level->grid;
  // Four pixels around a cell are then one word.
  constexpr int kPad = PaddedImage::kPad;
  const PaddedImage& image = level->displaced;
  const int pairs_rows = image.height + 2 * kPad - 1;
  pairs->resize(static_cast<std::size_t>(image.stride) * pairs_rows + 64);
  parallelFor(0, (pairs_rows + kStrip - 1) / kStrip, threads, [&](std::size_t strip) {
    const int begin = static_cast<int>(strip) * kStrip;
    pairBlock(image, -kPad, begin - kPad, image.stride, std::min(kStrip, pairs_rows - begin),
              Pairs::kDown, &(*pairs)[static_cast<std::size_t>(begin) * image.stride],
              image.stride);
  });
  for (const Band& band : grid.bands) {
    parallelFor(0, (band.rows + kStrip - 1) / kStrip, threads, [&](std::size_t strip) {
      Scratch& scratch = local();
      const int begin = static_cast<int>(strip) * kStrip;
      const int end = std::min(begin + kStrip, band.rows);
      const int first = std::max(begin - 2, 0), last = std::min(end + 2, band.rows);
      // Grey rows of the strip, on common columns.
      int lo = std::numeric_limits<int>::max(), hi = std::numeric_limits<int>::min();
      for (int r = first; r < last; ++r) {
        if (band.runs[r] == 0) continue;
        lo = std::min(lo, band.begin[r]);
        hi = std::max(hi, band.begin[r] + band.runs[r] * 8);
      }
      if (lo > hi) return;
      const int line = hi - lo + 16;
      scratch.grey.assign(static_cast<std::size_t>(line) * (last - first + 4), 0);
      const auto greyRow = [&](int r) {
        return &scratch.grey[static_cast<std::size_t>(line) * (r - first + 2) + 8];
      };
      for (int r = first; r < last; ++r) {
        if (band.runs[r] == 0) continue;
        sampleRow(pairs->data(), image.stride, &grid.x[band.node[r]], &grid.y[band.node[r]],
                  &grid.mask[(band.origin[r] + band.begin[r]) / 8], band.runs[r],
                  greyRow(r) + band.begin[r] - lo);
      }
      for (int r = begin; r < end; ++r) {
        if (band.runs[r] == 0) continue;
        const std::uint8_t* rows[5];
        for (int k = 0; k < 5; ++k) rows[k] = greyRow(r + k - 2) + band.begin[r] - lo;
        std::uint8_t* out[kPlanes];
        for (int p = 0; p < kPlanes; ++p)
          out[p] = &level->cells[p][level->slack + band.origin[r] + band.begin[r]];
        cost.describeRow(rows, band.runs[r] * 8, out);
      }
    });
  }
}

void describeTile(const Level& level, bool finest, const Tile& tile, const Band& band, int stride,
                  Scratch* scratch) {
  const MapView& view = scratch->view;
  const cv::Rect& rect = tile.rect;
  const int width = rect.width + 2 * kRadius, height = rect.height + 2 * kRadius;
  for (auto& plane : scratch->reference)
    plane.assign(static_cast<std::size_t>(stride) * height + 64, 0);
  // Everything that windows of this tile can touch.
  constexpr int kAround = PaddedImage::kPad - kRadius;
  const int pairs_stride = stride + 2 * kAround;
  scratch->pairs.resize(static_cast<std::size_t>(pairs_stride) * (height + 2 * kAround) + 64);
  pairBlock(level.reference, rect.x - kRadius - kAround, rect.y - kRadius - kAround,
            width + 2 * kAround, height + 2 * kAround, Pairs::kAcross, scratch->pairs.data(),
            pairs_stride);
  const bool narrow = !finest;
  const int block = narrow ? kBlock : 2 * kBlock;
  for (int y = 0; y < height; y += kBlock) {
    for (int x = 0; x < width; x += block) {
      const int w = std::min(block, width - x), h = std::min(kBlock, height - y);
      const int u0 = rect.x + x - kRadius, v0 = rect.y + y - kRadius;
      Eigen::Vector2f d_phi, d_a;
      bool found = false;
      for (const auto& [du, dv] : {std::pair(w / 2, h / 2), std::pair(2, 2), std::pair(w - 3, 2),
                                   std::pair(2, h - 3), std::pair(w - 3, h - 3)}) {
        const int u = std::clamp(u0 + du, 0, level.map.size.width - 1);
        const int v = std::clamp(v0 + dv, 0, level.map.size.height - 1);
        if (view.phi[view.at(u, v)] == kNoRay) continue;
        if (localFrame(view, u, v, &d_phi, &d_a)) {
          found = true;
          break;
        }
      }
      if (!found) continue;
      d_phi *= static_cast<float>(band.step_phi);
      d_a *= static_cast<float>(band.step_h);
      constexpr float kLongest = 2.8f;
      if (d_phi.norm() > kLongest) d_phi *= kLongest / d_phi.norm();
      if (d_a.norm() > kLongest) d_a *= kLongest / d_a.norm();
      CensusOffsets offsets;
      for (int i = 0; i < kBits; ++i) {
        const int position = i < 12 ? i : i + 1;
        const Eigen::Vector2f offset = d_phi * (position / 5 - 2) + d_a * (position % 5 - 2);
        offsets.dx[i] = offset.x();
        offsets.dy[i] = offset.y();
      }
      std::uint8_t* out[kPlanes];
      for (int p = 0; p < kPlanes; ++p) out[p] = &scratch->reference[p][y * stride + x];
      censusBlock(&scratch->pairs[(y + kAround) * pairs_stride + x + kAround], pairs_stride, w, h,
                  offsets, narrow, out, stride);
    }
  }
}

}  // namespace omnister::sweep
