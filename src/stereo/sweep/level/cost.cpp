// SPDX-License-Identifier: Apache-2.0
#include "stereo/sweep/level/cost.h"

#include <algorithm>
#include <cstring>
#include <string>

#include "omnister/common/error.h"

namespace omnister {

MatchCost parseMatchCost(std::string_view name) {
  if (name == "census") return MatchCost::kCensus;
  if (name == "zncc") return MatchCost::kZncc;
  if (name == "eq3.1") return MatchCost::kThesis;
  throw Error("unknown cost '" + printable(name) + "', expected census, zncc or eq3.1");
}

namespace sweep {
namespace {

class Census : public CostFunction {
 public:
  void describeRow(const std::uint8_t* const rows[5], int count,
                   std::uint8_t* const out[kPlanes]) const override {
    censusRow(rows, count, out);
  }
  void describeTile(const Level& level, bool finest, const Tile& tile, const Band& band, int stride,
                    Scratch* scratch) const override {
    sweep::describeTile(level, finest, tile, band, stride, scratch);
  }
  void matchChunk(const ChunkJob& job) const override { sweep::matchChunk(job); }
};

class Correlation : public CostFunction {
 public:
  explicit Correlation(bool without_mean) : without_mean_(without_mean) {}

  void describeRow(const std::uint8_t* const rows[5], int count,
                   std::uint8_t* const out[kPlanes]) const override {
    std::memcpy(out[0], rows[2], static_cast<std::size_t>(count));
  }
  void describeTile(const Level& level, bool, const Tile& tile, const Band&, int stride,
                    Scratch* scratch) const override {
    const int width = tile.rect.width + 2 * kRadius, height = tile.rect.height + 2 * kRadius;
    std::vector<std::uint8_t>& grey = scratch->reference[0];
    grey.assign(static_cast<std::size_t>(stride) * height + 64, 0);
    for (int y = 0; y < height; ++y) {
      const std::uint8_t* from = level.reference.row(tile.rect.y + y - kRadius);
      std::copy_n(from + tile.rect.x - kRadius, width, &grey[static_cast<std::size_t>(y) * stride]);
    }
    // Pointers to planes that are not used are made all the same.
    for (int plane = 1; plane < kPlanes; ++plane) scratch->reference[plane].resize(grey.size());
  }
  void matchChunk(const ChunkJob& job) const override { correlateChunk(job, without_mean_); }
  int shift() const override { return kCorrelationShift; }
  bool isParabola() const override { return true; }

 private:
  bool without_mean_;
};

}  // namespace

const CostFunction& costFunction(MatchCost cost) {
  static const Census census;
  static const Correlation zncc(true), thesis(false);
  if (cost == MatchCost::kZncc) return zncc;
  if (cost == MatchCost::kThesis) return thesis;
  return census;
}

}  // namespace sweep
}  // namespace omnister
