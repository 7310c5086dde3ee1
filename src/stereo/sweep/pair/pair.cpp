// SPDX-License-Identifier: Apache-2.0
#include "stereo/sweep/pair/pair.h"

#include <hwy/cache_control.h>
#include <tbb/enumerable_thread_specific.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <numeric>
#include <opencv2/core.hpp>
#include <utility>

#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "omnister/stereo/matching_limits.h"
#include "stereo/sweep/grid/geometry.h"
#include "stereo/sweep/kernels/kernels.h"
#include "stereo/sweep/level/cost.h"
#include "stereo/sweep/level/level.h"
#include "stereo/sweep/paths/candidates.h"
#include "stereo/sweep/refine/filters.h"

namespace omnister {
namespace {

using namespace sweep;

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr float kFullCost = kWindow * kWindow * kBits;  ///< every bit of every descriptor wrong
constexpr int kTileWidth = 64, kTileHeight = 48;
constexpr float kClaimUnits = 4;     ///< of a column, in which claims are compared;
constexpr int kClaimTolerance = 7;   ///< so many of these two may differ by
constexpr float kClaimScale = 0.5f;  ///< spots a column of the claims image
constexpr std::int32_t kUnclaimed = std::numeric_limits<std::int32_t>::max();
constexpr float kEdgeJump = 1.5f;           ///< columns between surfaces at an edge,
constexpr float kSameSurface = 1.5f;        ///< and on one, at most
constexpr int kSpeckle = 100;               ///< regions of fewer pixels go,
constexpr int kSpeckleShare = 3000;         ///< or of less than this part of the image
constexpr std::uint16_t kUnowned = 0xFFFF;  ///< cost of a pixel that another guess has
constexpr float kSureTile = 0.75f;    ///< share of sure windows from which on checks are strict
constexpr float kWorstShare = 0.32f;  ///< of it, that a match may cost where few others hold;
                                      ///< chance gives a half
constexpr float kWorstCorrelation = 0.12f;  ///< likewise
constexpr float kWorstOfWindow = 0.34f;     ///< where windows decide alone
constexpr float kFewHold = 0.6f;            ///< share of a tile's matches

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

/// Whether all of an image is of one grey level, give or take one.
bool isBlank(const cv::Mat& image) {
  double least = 255, most = 0;
  for (int y = 0; y < image.rows && most - least <= 2; ++y) {
    double low = 0, high = 0;
    cv::minMaxLoc(image.row(y), &low, &high);
    least = std::min(least, low);
    most = std::max(most, high);
  }
  return most - least <= 2;
}

/// A plane of one value a pixel; vector code may read 16 elements before a row, and write up to 64
/// behind it.
cv::Mat makePlane(cv::Size size, int type, double value = -1) {
  const cv::Mat room(size.height, (size.width + 63) / 64 * 64 + 80, type, cv::Scalar(value));
  return room.colRange(16, 16 + size.width);
}

class SweepMatcher : public SweepPair {
 public:
  SweepMatcher(const StereoGeometry& geometry, const MatcherOptions& options, PairChecks checks)
      : geometry_(geometry),
        options_(options),
        compare_(costFunction(options.cost)),
        checks_(checks) {
    const auto& displaced = geometry.displaced.front();
    frame_ = makeEpipolarFrame(displaced.T_ref_disp.translation());
    const WideLens reference_lens = widen(geometry.reference_lens);
    const WideLens displaced_lens = widen(displaced.lens);
    HypothesisLimits limits;
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
      level.map = makeReferenceMap(reference_lens, geometry.reference_size, l, frame_, options.mask,
                                   options.threads);
      level.layout = makeLayout(level.map, limits,
                                l + 1 < levels ? cv::Size(kTileWidth, kTileHeight)
                                               : cv::Size(2 * kTileWidth, 2 * kTileHeight));
      level.grid = makeGrid(&level.layout, level.map, frame_, displaced_lens, displaced.size, l,
                            displaced.T_ref_disp.linear(), kRadius, options.threads);
      limits.hypotheses = (limits.hypotheses + 1) / 2;
      level.slack = 2 * kCellSlack;
      for (const Tile& tile : level.layout.tiles) {
        if (tile.band < 0) continue;
        const double step = level.layout.bands[tile.band].step_h;
        level.slack = std::max(level.slack, static_cast<int>(2 * tile.h_max / step) + kCellSlack);
      }
      for (auto& plane : level.cells) plane.resize(level.grid.cells + 2 * level.slack);
      const auto reduced = [l](cv::Size size) {
        return cv::Size((size.width + (1 << l) - 1) >> l, (size.height + (1 << l) - 1) >> l);
      };
      const cv::Size r = reduced(geometry.reference_size), d = reduced(displaced.size);
      level.reference.create(r.width, r.height);
      level.displaced.create(d.width, d.height);
      level.h = makePlane(r, CV_32FC1, kNaN);
    }
    prepareClaims();
  }

  MatchResult match(const cv::Mat& reference, const std::vector<cv::Mat>& displaced) override {
    checkImages(geometry_, reference, displaced);
    const auto start = std::chrono::steady_clock::now();
    for (Scratch& scratch : *scratch_) scratch.claims.clear();
    MatchResult result;
    // Plain images match each other, and what is saturated in others, anywhere.
    if (isBlank(reference) || isBlank(displaced.front())) {
      for (cv::Mat* plane : {&result.range, &result.sigma, &result.score})
        *plane = cv::Mat(reference.size(), CV_32FC1, cv::Scalar(kNaN));
      result.statistics.rejected["no contrast"] = field_;
      result.statistics.seconds["total"] =
          std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
      return result;
    }
    Stopwatch watch(&result.statistics.seconds);
    makePyramid(reference, &Level::reference);
    makePyramid(displaced.front(), &Level::displaced);
    watch.lap("prefilter");
    for (Level& level : levels_)
      describeDisplaced(
          compare_, &level, options_.threads, [this]() -> Scratch& { return scratch_->local(); },
          &pairs_);
    watch.lap("describe");
    for (std::size_t l = levels_.size(); l-- > 0;) {
      matchLevel(l);
      watch.lap(l == 0 ? "match" : "coarse");
    }
    finish(&result, &watch);
    result.statistics.seconds["total"] =
        std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    return result;
  }

  void takeBuffers(SweepPair* pair) override {
    auto* other = dynamic_cast<SweepMatcher*>(pair);
    if (other == nullptr || other == this) return;
    for (std::size_t l = 0; l < std::min(levels_.size(), other->levels_.size()); ++l) {
      Level& own = levels_[l];
      Level& theirs = other->levels_[l];
      const cv::Size size(own.displaced.width, own.displaced.height);
      own.reference = std::move(theirs.reference);
      own.displaced = std::move(theirs.displaced);
      own.displaced.create(size.width, size.height);
      own.h = theirs.h;
      theirs.h.release();
      for (int p = 0; p < kPlanes; ++p) {
        own.cells[p] = std::move(theirs.cells[p]);
        own.cells[p].resize(own.grid.cells + 2 * own.slack);
        // Stray reads find nothing there, as in a vector of one's own.
        std::fill_n(own.cells[p].begin(), own.slack, std::uint8_t{0});
        std::fill_n(own.cells[p].end() - own.slack, own.slack, std::uint8_t{0});
      }
    }
    for (auto member : {&SweepMatcher::cost_, &SweepMatcher::steep_, &SweepMatcher::claim_}) {
      this->*member = other->*member;
      (other->*member).release();
    }
    for (int i = 0; i < 3; ++i) {
      planes_[i] = other->planes_[i];
      other->planes_[i].release();
    }
    pairs_ = std::move(other->pairs_);
    std::swap(scratch_, other->scratch_);
  }

 private:
  void prepareClaims() {
    const Level& level = levels_.front();
    const cv::Size size = level.map.size;
    sure_.assign(level.layout.tiles.size(), 0);
    all_.assign(level.layout.tiles.size(), 1);
    cost_ = makePlane(size, CV_16UC1);
    steep_ = makePlane(size, CV_16UC1);
    claim_ = makePlane(size, CV_32SC1);
    finest_step_ = std::numeric_limits<float>::max();
    for (const Band& band : level.grid.bands)
      finest_step_ = std::min(finest_step_, static_cast<float>(band.step_h));
    field_ = level.map.field;
    // phi sin(theta) over the field, a tile at a time.
    float least = 0, most = 0;
    MapView view;
    for (int y = 0; y < size.height; y += 7) {
      viewMap(level.map, cv::Rect(0, y, size.width, 1), &view);
      for (int x = 0; x < size.width; ++x) {
        if (view.phi[x] == kNoRay) continue;
        const float phi = static_cast<float>(view.phi[x] / kPhiUnits - 3.14159265);
        least = std::min(least, phi);
        most = std::max(most, phi);
      }
    }
    claim_x_ = kClaimScale / finest_step_;
    claim_y_offset_ = std::floor(least * claim_x_) - 4;
    claim_size_ = cv::Size(static_cast<int>(3.1416f * claim_x_) + 2,
                           static_cast<int>(most * claim_x_ - claim_y_offset_) + 8);
  }

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

  void matchLevel(std::size_t l) {
    Level& level = levels_[l];
    parallelFor(0, level.layout.tiles.size(), options_.threads,
                [&](std::size_t t) { matchTile(l, t, &scratch_->local()); });
  }

  void matchTile(std::size_t l, std::size_t t, Scratch* scratch) {
    Level& level = levels_[l];
    const Tile& tile = level.layout.tiles[t];
    const cv::Rect& rect = tile.rect;
    if (tile.band < 0) {
      level.h(rect).setTo(kNaN);
      if (l == 0) claim_(rect).setTo(-1);
      return;
    }
    const Band& band = level.grid.bands[tile.band];
    const cv::Mat* coarse = l + 1 < levels_.size() ? &levels_[l + 1].h : nullptr;
    guessTile(coarse, tile, band, scratch);
    viewMap(level.map,
            rect + cv::Size(2 * kViewHalo, 2 * kViewHalo) - cv::Point(kViewHalo, kViewHalo),
            &scratch->view);
    orientGuesses(options_.window, frame_, band, tile, scratch);
    const int stride = (rect.width + 2 * kRadius + 31) / 32 * 32;
    compare_.describeTile(level, l == 0, tile, band, stride, scratch);
    mapGuesses(level, tile, band, stride, scratch);
    fillVolume(compare_, level, tile, stride, scratch);
    const float sure = chooseCandidates(compare_, level, coarse, tile, band, choiceAt(l), scratch);
    readChosen(tile, scratch);
    for (std::size_t g = 0; g < scratch->guesses.size(); ++g)
      concludeGuess(l, t, stride, g, scratch);
    if (l > 0) return;
    sure_[t] = sure > kSureTile ? 1 : 0;
    claimTile(rect, scratch);
  }

  /// Who decides at a level.
  Choice choiceAt(std::size_t l) const {
    if (l > 0) return Choice::kPaths;
    return checks_ == PairChecks::kStrict ? Choice::kWindows : Choice::kPathsIfNeeded;
  }

  /// The pixels that took a candidate of a guess.
  void concludeGuess(std::size_t l, std::size_t t, int stride, std::size_t g, Scratch* scratch) {
    Level& level = levels_[l];
    const Tile& tile = level.layout.tiles[t];
    const Band& band = level.grid.bands[tile.band];
    const Guess& guess = scratch->guesses[g];
    const cv::Rect where = guess.where + tile.rect.tl();
    const std::size_t room = guessRoom(tile, stride);
    const auto owns = [&](std::uint8_t owner) { return owner == g; };
    const auto owner_end = scratch->guess_chosen.begin() + tile.rect.area();
    const bool merge = g > 0;
    if (merge && std::none_of(scratch->guess_chosen.begin(), owner_end, owns)) return;
    scratch->own_cost.resize(where.width + 64);
    scratch->residual_sums.resize(static_cast<std::size_t>(stride) * where.height + 64);
    boxColumns(&scratch->residual[g * room + static_cast<std::size_t>(guess.where.y) * stride +
                                  guess.where.x],
               stride, where.width + 2 * kRadius, where.height, scratch->residual_sums.data());
    scratch->residual_mean.resize(stride + 64);
    // The finest level's costs are kept, in whole bits.
    const int shift = compare_.shift();
    const bool keeps_cost = l == 0 && shift == 0;
    const int best_stride = (tile.rect.width + 15) / 16 * 16;
    scratch->best_cost.resize(static_cast<std::size_t>(best_stride) * tile.rect.height);
    const std::size_t h_step = level.h.step1(), claim_step = claim_.step1();
    ConcludeJob job;
    job.count = where.width;
    job.residual = scratch->residual_mean.data();
    job.mask = tile.clear ? nullptr : level.grid.mask.data();
    job.cells = level.grid.cells;
    job.step_h = static_cast<float>(band.step_h);
    job.guess_x = guess.x;
    job.merge = merge;
    // Coarse levels say where to look, whatever it costs.
    job.chosen = l > 0 || checks_ == PairChecks::kByTexture;
    job.worst_cost = job.chosen ? std::numeric_limits<float>::max()
                                : kWorstOfWindow * kFullCost * static_cast<float>(1 << shift);
    job.parabola = compare_.isParabola();
    job.claim_x = claim_x_;
    job.claim_y = claim_x_;
    job.claim_y_offset = claim_y_offset_;
    job.claim_width = claim_size_.width;
    job.claim_height = claim_size_.height;
    for (int y = 0; y < where.height; ++y) {
      const std::size_t corner =
          static_cast<std::size_t>(guess.where.y + y) * stride + guess.where.x;
      boxMeanRow(&scratch->residual_sums[static_cast<std::size_t>(y) * stride], where.width,
                 scratch->residual_mean.data());
      const std::size_t i =
          static_cast<std::size_t>(guess.where.y + y) * tile.rect.width + guess.where.x;
      const std::size_t pixel = scratch->view.at(where.x, where.y + y);
      for (int x = 0; x < where.width; ++x)
        scratch->own_cost[x] = owns(scratch->guess_chosen[i + x]) ? scratch->cost[i + x] : kUnowned;
      job.cost = scratch->own_cost.data();
      job.index = &scratch->index[i];
      job.before = &scratch->before[i];
      job.after = &scratch->after[i];
      job.base = &scratch->base[g * room + corner + kRadius * stride + kRadius];
      job.phi = &scratch->view.phi[pixel];
      job.a = &scratch->view.a[pixel];
      job.guess = guess(static_cast<float>(guess.where.x), static_cast<float>(guess.where.y + y));
      job.best = &scratch->best_cost[static_cast<std::size_t>(guess.where.y + y) * best_stride +
                                     guess.where.x];
      job.h = level.h.ptr<float>(where.y + y) + where.x;
      std::uint16_t* cost = nullptr;
      if (l == 0) {
        cost = cost_.ptr<std::uint16_t>(where.y + y) + where.x;
        if (keeps_cost) job.best = cost;
        job.steep = steep_.ptr<std::uint16_t>(where.y + y) + where.x;
        job.claim = claim_.ptr<std::int32_t>(where.y + y) + where.x;
      }
      if (y + 2 < where.height) {
        for (int x = 0; x < where.width; x += 16) {
          __builtin_prefetch(job.h + 2 * h_step + x, 1);
          if (l == 0) __builtin_prefetch(job.claim + 2 * claim_step + x, 1);
        }
      }
      concludeRow(&job);
      if (l == 0 && !keeps_cost)
        for (int x = 0; x < where.width; ++x) cost[x] = job.best[x] >> shift;
    }
  }

  ClaimJob claimJob(std::int32_t* claims) const {
    ClaimJob job;
    job.claims = claims;
    job.none = claim_size_.area();
    job.units = kClaimUnits / finest_step_;
    return job;
  }

  /// Of pixels that see one spot of the displaced image the best match has it.
  void claimTile(const cv::Rect& rect, Scratch* scratch) const {
    const Level& level = levels_.front();
    std::vector<std::int32_t>& claims = scratch->claims;
    if (claims.empty()) claims.assign(claim_size_.area() + kClaimSlack, kUnclaimed);
    ClaimJob job = claimJob(claims.data());
    job.count = rect.width;
    for (int y = rect.y; y < rect.br().y; ++y) {
      job.claim = claim_.ptr<std::int32_t>(y) + rect.x;
      job.h = level.h.ptr<float>(y) + rect.x;
      job.cost = cost_.ptr<std::uint16_t>(y) + rect.x;
      claimRow(job);
    }
  }

  /// Brings together what the threads have.
  /// @return null where nothing was claimed
  std::int32_t* settleClaims() {
    std::vector<std::int32_t*> all;
    for (Scratch& scratch : *scratch_)
      if (!scratch.claims.empty()) all.push_back(scratch.claims.data());
    if (all.size() < 2) return all.empty() ? nullptr : all.front();
    constexpr int kPart = 16384;
    const int count = claim_size_.area();
    parallelFor(0, (count + kPart - 1) / kPart, options_.threads, [&](std::size_t part) {
      const int begin = static_cast<int>(part) * kPart, end = std::min(begin + kPart, count);
      for (std::size_t k = 1; k < all.size(); ++k) {
        std::int32_t* to = all[0];
        const std::int32_t* from = all[k];
        for (int i = begin; i < end; ++i) to[i] = std::min(to[i], from[i]);
      }
    });
    return all.front();
  }

  /// Where most matches of a tile did not pass the checks, only windows that match well by
  /// themselves stay: paths lay surfaces through whatever they are given.
  /// @return pixels that went
  std::size_t dropDoubtful(cv::Mat* h) const {
    const Level& level = levels_.front();
    const float share = compare_.isParabola() ? kWorstCorrelation : kWorstShare;
    const auto worst = static_cast<std::uint16_t>(share * kFullCost);
    std::vector<std::size_t> dropped(level.layout.tiles.size(), 0);
    parallelFor(
        0, dropped.size(), options_.threads,
        [&](std::size_t t) {
          const Tile& tile = level.layout.tiles[t];
          if (tile.band < 0 || sure_[t]) return;
          int found = 0, left = 0;
          for (int y = tile.rect.y; y < tile.rect.br().y; ++y) {
            const float* before = level.h.ptr<float>(y) + tile.rect.x;
            const float* after = h->ptr<float>(y) + tile.rect.x;
            for (int x = 0; x < tile.rect.width; ++x) {
              found += before[x] == before[x];  // not NaN
              left += after[x] == after[x];
            }
          }
          if (static_cast<float>(left) > kFewHold * static_cast<float>(found)) return;
          for (int y = tile.rect.y; y < tile.rect.br().y; ++y) {
            const std::uint16_t* cost = cost_.ptr<std::uint16_t>(y) + tile.rect.x;
            float* here = h->ptr<float>(y) + tile.rect.x;
            for (int x = 0; x < tile.rect.width; ++x) {
              if (std::isnan(here[x]) || cost[x] <= worst) continue;
              here[x] = kNaN;
              ++dropped[t];
            }
          }
        },
        8);
    return std::accumulate(dropped.begin(), dropped.end(), std::size_t{0});
  }

  void finish(MatchResult* result, Stopwatch* watch) {
    Level& level = levels_.front();
    const int width = level.map.size.width, height = level.map.size.height;
    constexpr int kStrip = 48;
    const int strips = (height + kStrip - 1) / kStrip;
    const auto forRows = [&](const auto& body) {
      parallelFor(0, strips, options_.threads, [&](std::size_t s) {
        const int begin = static_cast<int>(s) * kStrip;
        body(s, begin, std::min(begin + kStrip, height));
      });
    };
    auto& rejected = result->statistics.rejected;

    // Planes that nobody holds any more are used again: fresh memory costs a millisecond.
    cv::Mat* planes[3] = {&result->range, &result->sigma, &result->score};
    for (int i = 0; i < 3; ++i) {
      if (planes_[i].empty() || planes_[i].u->refcount != 1)
        planes_[i] = cv::Mat(height, width, CV_32FC1);
      *planes[i] = planes_[i];
    }
    cv::Mat& smooth = result->range;  // till it is range

    std::vector<std::int32_t> unclaimed;
    std::int32_t* claims = settleClaims();
    if (!claims) {
      unclaimed.assign(claim_size_.area() + kClaimSlack, kUnclaimed);
      claims = unclaimed.data();
    }
    watch->lap("claims");
    std::vector<RejectJob> jobs(strips);
    forRows([&](std::size_t s, int begin, int end) {
      // The rows of the strip and those around it, free of what is not to be believed.
      Scratch& scratch = scratch_->local();
      scratch.nothing.assign(width + 128, kNaN);
      for (auto& row : scratch.rows) row.assign(width + 128, kNaN);
      RejectJob& job = jobs[s];
      job.claimed = claimJob(claims);
      job.claimed.count = width;
      job.tolerance = kClaimTolerance;
      job.jump = kEdgeJump * finest_step_;
      job.tile_width = kTileWidth;
      const auto reject = [&](int y) {
        job.out = scratch.rows[(y + kAverageRows) % kAverageRows].data() + 16;
        if (y < 0 || y >= height) {
          std::fill(job.out, job.out + width, kNaN);
          return;
        }
        for (int k = 0; k < 3; ++k) {
          const int v = y + (k - 1) * RejectJob::kReach;
          const bool there = v >= 0 && v < height;
          job.h[k] = there ? level.h.ptr<float>(v) : scratch.nothing.data() + 16;
          job.cost[k] = cost_.ptr<std::uint16_t>(there ? v : y);
        }
        job.claimed.h = job.h[1];
        job.claimed.cost = job.cost[1];
        job.claimed.claim = claim_.ptr<std::int32_t>(y);
        const std::vector<std::uint8_t>& strict = checks_ == PairChecks::kStrict ? all_ : sure_;
        job.strict = &strict[static_cast<std::size_t>(y / kTileHeight) * level.layout.tiles_x];
        const RejectJob before = job;
        rejectRow(&job);
        // What belongs to the strips around is counted there.
        if (y < begin || y >= end) job = before;
        std::fill_n(job.out + width, 32, kNaN);
      };
      constexpr int kReach = kAverageRows / 2;
      for (int y = begin - kReach; y < begin + kReach; ++y) reject(y);
      for (int y = begin; y < end; ++y) {
        reject(y + kReach);
        const float* rows[kAverageRows];
        for (int k = 0; k < kAverageRows; ++k)
          rows[k] = scratch.rows[(y + k + kAverageRows - kReach) % kAverageRows].data() + 16;
        averageRow(rows, width, kSameSurface * finest_step_, smooth.ptr<float>(y));
      }
    });
    std::size_t found = 0, lost = 0, edge = 0;
    for (const RejectJob& job : jobs) {
      found += job.found;
      lost += job.lost;
      edge += job.edge;
    }
    rejected["no match"] = field_ - found;
    rejected["left-right"] = lost;
    rejected["depth edge"] = edge;
    watch->lap("check");
    const int region = std::max(kSpeckle, width * height / kSpeckleShare);
    rejected["speckle"] = removeSpeckles(&smooth, finest_step_, region, options_.threads);
    const std::size_t doubtful = dropDoubtful(&smooth);
    if (doubtful > 0)
      rejected["speckle"] += removeSpeckles(&smooth, finest_step_, region, options_.threads);
    rejected["no match"] += doubtful;
    watch->lap("speckle");

    std::vector<TriangulateJob> points(strips);
    forRows([&](std::size_t s, int begin, int end) {
      TriangulateJob& job = points[s];
      MapView& view = scratch_->local().view;
      job.count = width;
      job.baseline = static_cast<float>(frame_.baseline);
      job.step_h = finest_step_;
      job.min_range = static_cast<float>(options_.min_range);
      job.max_range = options_.max_range > 0 ? static_cast<float>(options_.max_range)
                                             : std::numeric_limits<float>::max();
      job.full_cost = kWorstShare * kFullCost;
      job.tile_width = kTileWidth;
      for (int y = begin; y < end; ++y) {
        viewMap(level.map, cv::Rect(0, y, width, 1), &view);
        // Several pairs tell their errors apart by themselves.
        const std::vector<std::uint8_t>& sure = checks_ == PairChecks::kStrict ? all_ : sure_;
        job.sure = &sure[static_cast<std::size_t>(y / kTileHeight) * level.layout.tiles_x];
        job.a = view.a.data();
        job.h = smooth.ptr<float>(y);
        job.cost = cost_.ptr<std::uint16_t>(y);
        job.steep = steep_.ptr<std::uint16_t>(y);
        job.range = result->range.ptr<float>(y);
        job.sigma = result->sigma.ptr<float>(y);
        job.score = result->score.ptr<float>(y);
        triangulateRow(&job);
      }
    });
    std::size_t out_of_range = 0, no_parallax = 0, valid = 0;
    for (const TriangulateJob& job : points) {
      out_of_range += job.out_of_range;
      no_parallax += job.no_parallax;
      valid += job.valid;
    }
    rejected["range limits"] = out_of_range;
    rejected["parallax"] = no_parallax;
    result->statistics.valid = valid;
    watch->lap("triangulate");
  }

  StereoGeometry geometry_;
  MatcherOptions options_;
  const CostFunction& compare_;
  PairChecks checks_;
  EpipolarFrame frame_;
  std::vector<Level> levels_;
  std::unique_ptr<tbb::enumerable_thread_specific<Scratch>> scratch_ =
      std::make_unique<tbb::enumerable_thread_specific<Scratch>>();
  std::vector<std::uint16_t> pairs_;  ///< of the displaced image that is described
  cv::Mat cost_, steep_, claim_;      ///< of the finest level
  cv::Mat planes_[3];                 ///< of the last result
  std::vector<std::uint8_t> all_;     ///< as sure_, of ones
  std::vector<std::uint8_t> sure_;    ///< by tile of the finest level: nearly all windows are sure
  std::size_t field_ = 0;             ///< pixels with a ray
  float finest_step_ = 0;             ///< least hypothesis step of any band
  // Claims on spots of the displaced image, kept on an equal-area map of (phi, theta').
  cv::Size claim_size_;
  float claim_x_ = 0, claim_y_offset_ = 0;
};

}  // namespace

void checkSweep(const StereoGeometry& geometry, const MatcherOptions& options) {
  checkMatching(geometry, options);
  sweep::holdSimdByEnvironment();
  // What a pair takes for each pixel, and the descriptors of each displaced image.
  const double pixels = geometry.reference_size.area();
  double bytes = 60 * pixels;
  for (const auto& displaced : geometry.displaced)
    bytes += 20 * std::max(pixels, static_cast<double>(displaced.size.area()));
  checkMemory(bytes, "the sweep");
}

std::unique_ptr<SweepPair> makeSweepPair(const StereoGeometry& geometry,
                                         const MatcherOptions& options, PairChecks checks) {
  checkSweep(geometry, options);
  return std::make_unique<SweepMatcher>(geometry, options, checks);
}

}  // namespace omnister
