// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/sweep_matcher.h"

#include <tbb/enumerable_thread_specific.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>

#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "omnister/stereo/matching_limits.h"
#include "sweep_filters.h"
#include "sweep_geometry.h"
#include "sweep_kernels.h"

namespace omnister {
namespace {

using namespace sweep;

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr int kRadius = 3;  ///< of the box that costs are summed over
constexpr int kWindow = 2 * kRadius + 1;
constexpr int kBlock = 16;  ///< pixels that share a local epipolar frame
constexpr float kFullCost = kWindow * kWindow * kBits;  ///< every bit of every descriptor wrong
constexpr float kWorstShare = 0.36f;  ///< of it, that a match may cost; chance gives a half

class Stopwatch {
 public:
  explicit Stopwatch(std::map<std::string, double>* seconds) : seconds_(seconds) {}
  void lap(const char* name) {
    const auto now = std::chrono::steady_clock::now();
    (*seconds_)[name] += std::chrono::duration<double>(now - last_).count();
    last_ = now;
  }

 private:
  std::map<std::string, double>* seconds_;
  std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

/// One resolution of the pair.
struct Level {
  ReferenceMap map;
  Layout layout;
  Grid grid;
  PaddedImage reference, displaced;
  std::vector<std::uint8_t> cells[kPlanes];
  cv::Mat h;  ///< CV_32FC1, hypotheses found
};

/// What a thread keeps between tiles.
struct Scratch {
  std::vector<std::int32_t> base, shifted;
  std::vector<float> column, residual, residual_row;
  std::vector<std::uint16_t> row;
  std::vector<std::uint8_t> reference[kPlanes], costs, grey;
  std::vector<std::uint16_t> cost, index, before, after;
  std::vector<int> histogram;
};

class SweepMatcher : public Matcher {
 public:
  SweepMatcher(const StereoGeometry& geometry, const MatcherOptions& options)
      : geometry_(geometry), options_(options) {
    const auto& displaced = geometry.displaced.front();
    frame_ = makeEpipolarFrame(displaced.T_ref_disp.translation());
    const WideLens reference_lens = widen(geometry.reference_lens);
    const WideLens displaced_lens = widen(displaced.lens);
    HypothesisLimits limits;
    limits.axis = Axis::kAngle;
    limits.baseline = frame_.baseline;
    limits.min_range = options.min_range;
    limits.max_range = std::isfinite(options.max_range) ? options.max_range : 0.0;
    limits.hypotheses = options.hypotheses;
    const int side = std::min({geometry.reference_size.width, geometry.reference_size.height,
                               displaced.size.width, displaced.size.height});
    int levels = 1;
    while (levels < 4 && (side >> levels) >= 100) ++levels;
    levels = std::min(levels, 3 + (side >= 1600));
    levels_.resize(levels);
    for (int l = 0; l < levels; ++l) {
      Level& level = levels_[l];
      level.map = makeReferenceMap(reference_lens, geometry.reference_size, l, frame_, limits.axis,
                                   options.mask, options.threads);
      level.layout = makeLayout(level.map, limits, cv::Size(64, 48));
      level.grid = makeGrid(level.layout, level.map, frame_, 1.0, displaced_lens, displaced.size, l,
                            displaced.T_ref_disp.linear(), kRadius, options.threads);
      limits.hypotheses = (limits.hypotheses + 1) / 2;
      for (auto& plane : level.cells) plane.resize(level.grid.cells + kCellSlack);
      const auto reduced = [l](cv::Size size) {
        return cv::Size((size.width + (1 << l) - 1) >> l, (size.height + (1 << l) - 1) >> l);
      };
      const cv::Size r = reduced(geometry.reference_size), d = reduced(displaced.size);
      level.reference.create(r.width, r.height);
      level.displaced.create(d.width, d.height);
      level.h.create(r, CV_32FC1);
    }
  }

  MatchResult match(const cv::Mat& reference, const std::vector<cv::Mat>& displaced) override {
    checkImages(geometry_, reference, displaced);
    const auto start = std::chrono::steady_clock::now();
    MatchResult result;
    Stopwatch watch(&result.statistics.seconds);
    makePyramid(reference, &Level::reference);
    makePyramid(displaced.front(), &Level::displaced);
    watch.lap("prefilter");
    for (Level& level : levels_) describe(&level);
    watch.lap("describe");
    for (std::size_t l = levels_.size(); l-- > 0;) {
      matchLevel(l);
      watch.lap(l == 0 ? "match" : "coarse");
    }
    finish(&result);
    watch.lap("finish");
    result.statistics.seconds["total"] =
        std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    return result;
  }

 private:
  void makePyramid(const cv::Mat& image, PaddedImage Level::*member) {
    constexpr int kStrip = 32;
    for (std::size_t l = 0; l < levels_.size(); ++l) {
      PaddedImage& out = levels_[l].*member;
      parallelFor(0, (out.height + kStrip - 1) / kStrip, options_.threads, [&](std::size_t strip) {
        const int begin = static_cast<int>(strip) * kStrip;
        const int end = std::min(begin + kStrip, out.height);
        if (l == 0)
          smoothRows(image, &out, begin, end);
        else
          halveRows(levels_[l - 1].*member, &out, begin, end);
      });
      fillBorderRows(&out);
    }
  }

  /// Descriptors of the displaced image along its epipolar curves.
  void describe(Level* level) {
    constexpr int kStrip = 24;
    const Grid& grid = level->grid;
    for (const Band& band : grid.bands) {
      parallelFor(0, (band.rows + kStrip - 1) / kStrip, options_.threads, [&](std::size_t strip) {
        Scratch& scratch = scratch_.local();
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
          sampleRow(level->displaced, &grid.x[band.node[r]], &grid.y[band.node[r]],
                    &grid.mask[(band.origin[r] + band.begin[r]) / 8], band.runs[r],
                    greyRow(r) + band.begin[r] - lo);
        }
        for (int r = begin; r < end; ++r) {
          if (band.runs[r] == 0) continue;
          const std::uint8_t* rows[5];
          for (int k = 0; k < 5; ++k) rows[k] = greyRow(r + k - 2) + band.begin[r] - lo;
          std::uint8_t* out[kPlanes];
          for (int p = 0; p < kPlanes; ++p)
            out[p] = &level->cells[p][band.origin[r] + band.begin[r]];
          censusRow(rows, band.runs[r] * 8, out);
        }
      });
    }
  }

  /// Intervals of columns worth trying in a tile, by what the next coarser level found.
  std::vector<std::pair<int, int>> intervals(std::size_t l, const Tile& tile, const Band& band,
                                             Scratch* scratch) const {
    const int least = static_cast<int>(std::floor(tile.h_min / band.step_h)) - 1;
    const int most = static_cast<int>(std::ceil(tile.h_max / band.step_h)) + 1;
    const std::vector<std::pair<int, int>> all{{least, most}};
    if (l + 1 == levels_.size()) return all;
    const cv::Mat& coarse = levels_[l + 1].h;
    constexpr int kAround = 6;
    const int x0 = std::max(tile.rect.x / 2 - kAround, 0),
              y0 = std::max(tile.rect.y / 2 - kAround, 0);
    const int x1 = std::min(tile.rect.br().x / 2 + kAround, coarse.cols);
    const int y1 = std::min(tile.rect.br().y / 2 + kAround, coarse.rows);
    std::vector<int>& histogram = scratch->histogram;
    histogram.assign(most - least + 1, 0);
    int seen = 0, known = 0;
    for (int y = y0; y < y1; ++y) {
      const float* line = coarse.ptr<float>(y);
      for (int x = x0; x < x1; ++x) {
        ++seen;
        if (std::isnan(line[x])) continue;
        const int k = static_cast<int>(std::lround(line[x] / band.step_h)) - least;
        ++histogram[std::clamp(k, 0, most - least)];
        ++known;
      }
    }
    if (known * 8 < seen) return all;
    // A few stray pixels do not widen the search; a thin object does.
    const int needed = std::max(2, known / 400);
    constexpr int kMargin = 3;
    std::vector<std::pair<int, int>> found;
    for (int k = 0; k <= most - least; ++k) {
      const int around =
          histogram[k] + (k ? histogram[k - 1] : 0) + (k < most - least ? histogram[k + 1] : 0);
      if (histogram[k] == 0 || around < needed) continue;
      const int from = std::max(least + k - kMargin, least),
                to = std::min(least + k + kMargin, most);
      if (!found.empty() && from <= found.back().second + 3)
        found.back().second = std::max(to, found.back().second);
      else
        found.emplace_back(from, to);
    }
    return found.empty() ? all : found;
  }

  void matchLevel(std::size_t l) {
    Level& level = levels_[l];
    if (l == 0) {
      cost_.create(level.map.size, CV_16UC1);
      sharpness_.create(level.map.size, CV_16UC1);
      target_.create(level.map.size, CV_32SC1);
    }
    parallelFor(0, level.layout.tiles.size(), options_.threads,
                [&](std::size_t t) { matchTile(l, level.layout.tiles[t], &scratch_.local()); });
  }

  void matchTile(std::size_t l, const Tile& tile, Scratch* scratch) {
    Level& level = levels_[l];
    const ReferenceMap& map = level.map;
    const cv::Rect& rect = tile.rect;
    if (tile.band < 0) {
      level.h(rect).setTo(kNaN);
      if (l == 0) {
        cost_(rect).setTo(0xFFFF);
        target_(rect).setTo(-1);
      }
      return;
    }
    const Band& band = level.grid.bands[tile.band];
    const int width = rect.width + 2 * kRadius, height = rect.height + 2 * kRadius;
    const int pixels = width * height;
    scratch->base.resize(pixels);
    scratch->shifted.resize(pixels);
    scratch->row.resize(pixels);
    scratch->residual.resize(pixels);
    const double to_column = level.grid.column_scale / band.step_h;
    for (int y = 0; y < height; ++y) {
      const int v = std::clamp(rect.y + y - kRadius, 0, map.size.height - 1);
      for (int x = 0; x < width; ++x) {
        const int u = std::clamp(rect.x + x - kRadius, 0, map.size.width - 1);
        const std::size_t i = static_cast<std::size_t>(v) * map.size.width + u;
        const int at = y * width + x;
        if (map.phi[i] == kNoRay) {
          scratch->base[at] = -1;
          scratch->residual[at] = 0;
          continue;
        }
        const int row =
            std::clamp(static_cast<int>(map.phi[i] * band.row_scale + band.row_offset + 0.5), 0,
                       band.rows - 1);
        const float column = static_cast<float>(map.a[i] * to_column);
        const float whole = std::floor(column + 0.5f);
        scratch->row[at] = static_cast<std::uint16_t>(row);
        scratch->residual[at] = whole - column;
        scratch->base[at] = band.origin[row] + static_cast<std::int32_t>(whole);
      }
    }
    describeTile(level, tile, band, scratch);

    const std::size_t inner = rect.area();
    scratch->cost.assign(inner, 0xFFFF);
    scratch->index.assign(inner, 0);
    scratch->before.assign(inner, 0);
    scratch->after.assign(inner, 0);
    ChunkJob job;
    job.width = width;
    job.height = height;
    job.radius = kRadius;
    job.base = scratch->shifted.data();
    for (int p = 0; p < kPlanes; ++p) {
      job.reference[p] = scratch->reference[p].data();
      job.cells[p] = level.cells[p].data();
    }
    job.cost = scratch->cost.data();
    job.index = scratch->index.data();
    job.before = scratch->before.data();
    job.after = scratch->after.data();
    job.scratch = &scratch->costs;
    const auto found = intervals(l, tile, band, scratch);
    const int origin = found.front().first - 1;
    for (const auto& [from, to] : found) {
      for (int first = from - 1; first < to; first += kLanes - 2) {
        for (int i = 0; i < pixels; ++i) {
          // Stray reads of the halo are harmless inside the array.
          scratch->shifted[i] =
              scratch->base[i] < 0 ? 0 : std::clamp(scratch->base[i] + first, 0, level.grid.cells);
        }
        job.first = first - origin;
        matchChunk(job);
      }
    }
    concludeTile(l, tile, band, origin, scratch);
  }

  /// Census of the tile's pixels and halo in the local epipolar frames.
  void describeTile(const Level& level, const Tile& tile, const Band& band,
                    Scratch* scratch) const {
    const cv::Rect& rect = tile.rect;
    const int width = rect.width + 2 * kRadius, height = rect.height + 2 * kRadius;
    for (auto& plane : scratch->reference) plane.assign(width * height, 0);
    for (int y = 0; y < height; y += kBlock) {
      for (int x = 0; x < width; x += kBlock) {
        const int w = std::min(kBlock, width - x), h = std::min(kBlock, height - y);
        const int u0 = rect.x + x - kRadius, v0 = rect.y + y - kRadius;
        Eigen::Vector2f d_phi, d_a;
        bool found = false;
        for (const auto& [du, dv] : {std::pair(w / 2, h / 2), std::pair(2, 2), std::pair(w - 3, 2),
                                     std::pair(2, h - 3), std::pair(w - 3, h - 3)}) {
          const int u = std::clamp(u0 + du, 0, level.map.size.width - 1);
          const int v = std::clamp(v0 + dv, 0, level.map.size.height - 1);
          if (level.map.phi[static_cast<std::size_t>(v) * level.map.size.width + u] == kNoRay)
            continue;
          if (localFrame(level.map, u, v, &d_phi, &d_a)) {
            found = true;
            break;
          }
        }
        if (!found) continue;
        d_phi *= static_cast<float>(band.step_phi);
        d_a *= static_cast<float>(band.step_h / level.grid.column_scale);
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
        for (int p = 0; p < kPlanes; ++p) out[p] = &scratch->reference[p][y * width + x];
        censusBlock(level.reference, u0, v0, w, h, offsets, out, width);
      }
    }
  }

  void concludeTile(std::size_t l, const Tile& tile, const Band& band, int origin,
                    Scratch* scratch) {
    Level& level = levels_[l];
    const cv::Rect& rect = tile.rect;
    const int width = rect.width + 2 * kRadius;
    // Mean of the residual over the window: what rounding to whole columns did to it.
    std::vector<float>& mean = scratch->residual_row;
    mean.resize(width);
    for (int y = 0; y < rect.height; ++y) {
      for (int x = 0; x < width; ++x) {
        float sum = 0;
        for (int k = 0; k < kWindow; ++k) sum += scratch->residual[(y + k) * width + x];
        mean[x] = sum * (1.0f / (kWindow * kWindow));
      }
      float* h = level.h.ptr<float>(rect.y + y) + rect.x;
      std::uint16_t* cost = l == 0 ? cost_.ptr<std::uint16_t>(rect.y + y) + rect.x : nullptr;
      std::uint16_t* sharpness =
          l == 0 ? sharpness_.ptr<std::uint16_t>(rect.y + y) + rect.x : nullptr;
      std::int32_t* target = l == 0 ? target_.ptr<std::int32_t>(rect.y + y) + rect.x : nullptr;
      for (int x = 0; x < rect.width; ++x) {
        const std::size_t i = static_cast<std::size_t>(y) * rect.width + x;
        const int at = (y + kRadius) * width + x + kRadius;
        h[x] = kNaN;
        if (l == 0) cost[x] = 0xFFFF, target[x] = -1, sharpness[x] = 0;
        const float c = scratch->cost[i];
        if (scratch->base[at] < 0 || c > kWorstShare * kFullCost) continue;
        const float cm = scratch->before[i], cp = scratch->after[i];
        const float steep = std::max(cm, cp) - c;
        if (!(steep > 0)) continue;
        float residual = 0;
        for (int k = 0; k < kWindow; ++k) residual += mean[x + k];
        const float shift = (cm - cp) / (2 * steep);
        const int k = scratch->index[i] + origin;
        const std::int32_t cell = scratch->base[at] + k;
        if (cell < 0 || cell >= level.grid.cells || !(level.grid.mask[cell / 8] >> (cell % 8) & 1))
          continue;
        h[x] = (k + shift + residual) * static_cast<float>(band.step_h);
        if (l > 0) continue;
        cost[x] = static_cast<std::uint16_t>(c);
        sharpness[x] = static_cast<std::uint16_t>(steep);
        const int row = scratch->row[at];
        const int column = cell - band.origin[row] - band.begin[row];
        const float* nx = &level.grid.x[band.node[row] + column / 8];
        const float* ny = &level.grid.y[band.node[row] + column / 8];
        const float t = (column % 8) * 0.125f;
        const int u = static_cast<int>(nx[0] + t * (nx[1] - nx[0]) + 0.5f);
        const int v = static_cast<int>(ny[0] + t * (ny[1] - ny[0]) + 0.5f);
        target[x] = std::clamp(v, 0, level.displaced.height - 1) * level.displaced.width +
                    std::clamp(u, 0, level.displaced.width - 1);
      }
    }
  }

  void finish(MatchResult* result) {
    Level& level = levels_.front();
    const int width = level.map.size.width, height = level.map.size.height;
    float step = std::numeric_limits<float>::max();
    for (const Band& band : level.grid.bands)
      step = std::min(step, static_cast<float>(band.step_h));
    auto& rejected = result->statistics.rejected;
    // Two pixels that fall on one pixel of the displaced image: the better match has it.
    std::vector<std::uint32_t> claims(
        static_cast<std::size_t>(level.displaced.width) * level.displaced.height, 0xFFFFFFFFu);
    const float to_quarters = 4 / step;
    for (int y = 0; y < height; ++y) {
      for (int x = 0; x < width; ++x) {
        const std::int32_t target = target_.at<std::int32_t>(y, x);
        if (target < 0) continue;
        const auto h = static_cast<std::uint32_t>(
            std::clamp(level.h.at<float>(y, x) * to_quarters + 64.0f, 0.0f, 65535.0f));
        claims[target] = std::min(
            claims[target], static_cast<std::uint32_t>(cost_.at<std::uint16_t>(y, x)) << 16 | h);
      }
    }
    std::size_t inconsistent = 0, field = 0, matched = 0;
    for (int y = 0; y < height; ++y) {
      for (int x = 0; x < width; ++x) {
        field += level.map.phi[static_cast<std::size_t>(y) * width + x] != kNoRay;
        const std::int32_t target = target_.at<std::int32_t>(y, x);
        if (target < 0) continue;
        ++matched;
        float& value = level.h.at<float>(y, x);
        const float h = std::clamp(value * to_quarters + 64.0f, 0.0f, 65535.0f);
        if (std::fabs(h - static_cast<float>(claims[target] & 0xFFFF)) > 6.0f) {
          value = kNaN;
          ++inconsistent;
        }
      }
    }
    rejected["no match"] = field - matched;
    rejected["left-right"] = inconsistent;
    cv::Mat smooth;
    medianFilter(level.h, &smooth, options_.threads);
    rejected["speckle"] = removeSpeckles(&smooth, step, 100, options_.threads);

    result->range.create(height, width, CV_32FC1);
    result->sigma.create(height, width, CV_32FC1);
    result->score.create(height, width, CV_32FC1);
    std::size_t out_of_range = 0, no_parallax = 0, valid = 0;
    const float b = static_cast<float>(frame_.baseline);
    for (int y = 0; y < height; ++y) {
      for (int x = 0; x < width; ++x) {
        const std::size_t i = static_cast<std::size_t>(y) * width + x;
        float& range = result->range.at<float>(y, x);
        float& sigma = result->sigma.at<float>(y, x);
        float& score = result->score.at<float>(y, x);
        range = sigma = score = kNaN;
        const float delta = smooth.at<float>(y, x);
        if (std::isnan(delta)) continue;
        const float theta = level.map.a[i];
        const float sine = std::sin(theta), s = std::sin(delta);
        if (!(s > 0)) {
          ++no_parallax;
          continue;
        }
        const float r = b * std::sin(theta + delta) / s;
        const float c = cost_.at<std::uint16_t>(y, x), steep = sharpness_.at<std::uint16_t>(y, x);
        const float sigma_h = step * (0.05f + 0.35f * std::sqrt(c + 20.0f) / std::max(steep, 1.0f));
        const float sr = b * sine / (s * s) * sigma_h;
        if (!(r > 0) || !(sr < 0.5f * r)) {
          ++no_parallax;
          continue;
        }
        if ((options_.min_range > 0 && r < options_.min_range) ||
            (options_.max_range > 0 && r > options_.max_range)) {
          ++out_of_range;
          continue;
        }
        range = r;
        sigma = sr;
        score = std::clamp(1.0f - c / (kWorstShare * kFullCost), 0.0f, 1.0f) *
                std::min(1.0f, steep / 60.0f);
        ++valid;
      }
    }
    rejected["range limits"] = out_of_range;
    rejected["parallax"] = no_parallax;
    result->statistics.valid = valid;
  }

  StereoGeometry geometry_;
  MatcherOptions options_;
  EpipolarFrame frame_;
  std::vector<Level> levels_;
  tbb::enumerable_thread_specific<Scratch> scratch_;
  cv::Mat cost_, sharpness_, target_;
};

/// Several displaced images, matched pair by pair; what agrees is averaged by its weight.
class PairwiseMatcher : public Matcher {
 public:
  PairwiseMatcher(const StereoGeometry& geometry, const MatcherOptions& options)
      : geometry_(geometry) {
    for (const auto& displaced : geometry.displaced) {
      StereoGeometry pair = geometry;
      pair.displaced = {displaced};
      matchers_.push_back(std::make_unique<SweepMatcher>(pair, options));
    }
  }

  MatchResult match(const cv::Mat& reference, const std::vector<cv::Mat>& displaced) override {
    checkImages(geometry_, reference, displaced);
    std::vector<MatchResult> results;
    for (std::size_t i = 0; i < matchers_.size(); ++i)
      results.push_back(matchers_[i]->match(reference, {displaced[i]}));
    MatchResult out = results.front();
    for (std::size_t i = 1; i < results.size(); ++i) {
      for (const auto& [name, seconds] : results[i].statistics.seconds)
        out.statistics.seconds[name] += seconds;
      for (const auto& [name, count] : results[i].statistics.rejected)
        out.statistics.rejected[name] += count;
    }
    out.statistics.valid = 0;
    for (int y = 0; y < reference.rows; ++y) {
      for (int x = 0; x < reference.cols; ++x) {
        // The estimate that carries most weight leads; others join when they agree with it.
        const auto weight = [&](const MatchResult& r) {
          const double sigma = r.sigma.at<float>(y, x), range = r.range.at<float>(y, x);
          return std::isnan(range) ? 0.0 : std::pow(range * range / sigma, 2);  // of 1 / range
        };
        double best = 0, inverse = 0;
        for (const auto& r : results) {
          const double w = weight(r);
          if (w <= best) continue;
          best = w;
          inverse = 1.0 / r.range.at<float>(y, x);
        }
        if (best == 0) {
          out.range.at<float>(y, x) = out.sigma.at<float>(y, x) = out.score.at<float>(y, x) = kNaN;
          continue;
        }
        double sum = 0, weights = 0, score = 0;
        for (const auto& r : results) {
          const double w = weight(r);
          if (w == 0) continue;
          const double value = 1.0 / r.range.at<float>(y, x);
          if (std::fabs(value - inverse) > 4 * std::sqrt(1 / w + 1 / best)) continue;
          sum += w * value;
          weights += w;
          score = std::max<double>(score, r.score.at<float>(y, x));
        }
        const double range = weights / sum;
        out.range.at<float>(y, x) = static_cast<float>(range);
        out.sigma.at<float>(y, x) = static_cast<float>(range * range / std::sqrt(weights));
        out.score.at<float>(y, x) = static_cast<float>(score);
        ++out.statistics.valid;
      }
    }
    return out;
  }

 private:
  StereoGeometry geometry_;
  std::vector<std::unique_ptr<SweepMatcher>> matchers_;
};

}  // namespace

std::unique_ptr<Matcher> makeSweepMatcher(const StereoGeometry& geometry,
                                          const MatcherOptions& options) {
  checkMatching(geometry, options);
  if (geometry.displaced.size() > 1) return std::make_unique<PairwiseMatcher>(geometry, options);
  return std::make_unique<SweepMatcher>(geometry, options);
}

}  // namespace omnister
