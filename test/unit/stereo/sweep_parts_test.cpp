// SPDX-License-Identifier: Apache-2.0
/// The sweep's parts against slow, plain versions of themselves.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <deque>
#include <limits>
#include <opencv2/core.hpp>
#include <random>

#include "omnister/common/error.h"
#include "omnister/lens/lens_models.h"
#include "stereo/sweep/grid/geometry.h"
#include "stereo/sweep/kernels/kernels.h"
#include "stereo/sweep/level/cost.h"
#include "stereo/sweep/refine/filters.h"

namespace omnister::sweep {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();

LensPtr wideLens(cv::Size size, double half_field) {
  LensStructure structure;
  structure.model = "spline";
  return makeLens(structure, {0.5 * size.width, 0.5 * size.height}, 0.5 * size.width / half_field,
                  half_field);
}

TEST(SweepGeometry, InterpolatedMapIsTheLens) {
  const cv::Size size(520, 400);
  for (const double half : {1.2, 1.9}) {
    for (const Eigen::Vector3d& t :
         {Eigen::Vector3d(0.2, 0, 0), Eigen::Vector3d(0.02, -0.01, 0.3)}) {
      const LensPtr lens = wideLens(size, half);
      const EpipolarFrame frame = makeEpipolarFrame(t);
      EXPECT_NEAR((frame.basis * frame.basis.transpose() - Eigen::Matrix3d::Identity()).norm(), 0,
                  1e-12);
      const ReferenceMap map = makeReferenceMap(widen(lens), size, 0, frame, cv::Mat(), 2);
      MapView view;
      viewMap(map, cv::Rect(-3, -2, size.width + 5, size.height + 7), &view);
      EXPECT_EQ(view.phi[view.at(-3, 50)], view.phi[view.at(0, 50)]);
      EXPECT_EQ(view.a[view.at(70, size.height + 4)], view.a[view.at(70, size.height - 1)]);
      EXPECT_GT(std::count(map.exact.begin(), map.exact.end(), ReferenceMap::kInterpolated), 100);
      std::size_t field = 0;
      int checked = 0;
      for (int y = 0; y < size.height; ++y) {
        for (int x = 0; x < size.width; ++x) {
          const std::size_t i = view.at(x, y);
          field += view.phi[i] != kNoRay;
          const auto ray = lens->unproject(Eigen::Vector2d(x, y));
          if (!ray) {
            EXPECT_EQ(view.phi[i], kNoRay);
            continue;
          }
          const Eigen::Vector3d b = frame.basis * *ray;
          const double radius = std::hypot(b.y(), b.z());
          if (radius < 0.03) continue;
          if (view.phi[i] == kNoRay) {
            // Only at the very rim may rounding leave a pixel out.
            EXPECT_GT(std::acos(ray->z()), half - 1e-4);
            continue;
          }
          ++checked;
          const double theta = std::atan2(radius, b.x());
          ASSERT_NEAR(view.a[i], theta, 1e-4) << x << " " << y;
          double turn = view.phi[i] / kPhiUnits - M_PI - std::atan2(b.z(), b.y());
          turn -= 2 * M_PI * std::round(turn / (2 * M_PI));
          ASSERT_NEAR(turn, 0, 2e-4 / radius) << x << " " << y;
        }
      }
      EXPECT_GT(checked, 120000);
      EXPECT_EQ(field, map.field);
    }
  }
}

TEST(SweepGeometry, NodesLieWhereTheLensPutsThem) {
  const cv::Size size(260, 220);
  const LensPtr lens = wideLens(size, 1.7);
  const Eigen::Matrix3d R =
      Eigen::AngleAxisd(0.2, Eigen::Vector3d(0.1, 1, 0.3).normalized()).toRotationMatrix();
  const Eigen::Vector3d t(0.1, 0.02, 0.04);
  const EpipolarFrame frame = makeEpipolarFrame(t);
  const WideLens wide = widen(lens);
  const ReferenceMap map = makeReferenceMap(wide, size, 0, frame, cv::Mat(), 1);
  HypothesisLimits limits;
  limits.baseline = frame.baseline;
  Layout layout = makeLayout(map, limits, cv::Size(64, 48));
  const Grid grid = makeGrid(&layout, map, frame, wide, size, 0, R, kRadius, 2);
  int checked = 0, seen = 0;
  for (const Band& band : grid.bands) {
    for (int r = 0; r < band.rows; r += 3) {
      for (int n = 0; n < band.runs[r]; ++n) {
        const std::uint8_t mask = grid.mask[(band.origin[r] + band.begin[r]) / 8 + n];
        for (int i = 0; i < 8; i += 3) {
          const double theta = (band.begin[r] + n * 8 + i) * band.step_h;
          const double phi = (r - band.row_offset) * band.step_phi - M_PI;
          const Eigen::Vector3d ray =
              R.transpose() * frame.basis.transpose() *
              Eigen::Vector3d(std::cos(theta), std::sin(theta) * std::cos(phi),
                              std::sin(theta) * std::sin(phi));
          const auto pixel = lens->project(ray);
          const bool inside = pixel && pixel->x() > 0 && pixel->y() > 0 &&
                              pixel->x() < size.width - 1 && pixel->y() < size.height - 1;
          ++checked;
          if (!(mask >> i & 1)) {
            // Off the image, or within half a pixel of its edge.
            EXPECT_TRUE(!inside || theta < 0 || theta > M_PI) << r << " " << n << " " << i;
            continue;
          }
          ++seen;
          ASSERT_TRUE(pixel);
          const double x =
              grid.x[band.node[r] + n] * (1 - i / 8.0) + grid.x[band.node[r] + n + 1] * i / 8.0;
          const double y =
              grid.y[band.node[r] + n] * (1 - i / 8.0) + grid.y[band.node[r] + n + 1] * i / 8.0;
          // Eight cells in a line lie 0.11 pixels beside a curve of 75 pixels radius, and curves
          // tighten towards the epipoles.
          ASSERT_LT(std::hypot(x - pixel->x(), y - pixel->y()), 0.25) << r << " " << n << " " << i;
        }
      }
    }
  }
  EXPECT_GT(checked, 10000);
  EXPECT_GT(seen, 6000);
}

TEST(SweepGeometry, HypothesesAreTheLawOfSines) {
  const double b = 0.3, theta = 1.1, range = 2.3;
  const Eigen::Vector2d point = range * Eigen::Vector2d(std::cos(theta), std::sin(theta));
  const double displaced = std::atan2(point.y(), point.x() - b);
  HypothesisLimits limits;
  limits.baseline = b;
  limits.min_range = range;
  double least, most;
  hypothesisRange(limits, theta, &least, &most);
  EXPECT_DOUBLE_EQ(least, 0);
  EXPECT_NEAR(theta + most, displaced, 1e-12);
}

TEST(SweepGeometry, NoBaselineIsRefused) {
  EXPECT_THROW(makeEpipolarFrame(Eigen::Vector3d::Zero()), Error);
}

cv::Mat floodedSpeckles(cv::Mat h, float step, int least) {
  cv::Mat seen(h.size(), CV_8UC1, cv::Scalar(0));
  cv::Mat out = h.clone();
  for (int y = 0; y < h.rows; ++y) {
    for (int x = 0; x < h.cols; ++x) {
      if (seen.at<uchar>(y, x) || std::isnan(h.at<float>(y, x))) continue;
      std::vector<cv::Point> region;
      std::deque<cv::Point> queue{{x, y}};
      seen.at<uchar>(y, x) = 1;
      while (!queue.empty()) {
        const cv::Point p = queue.front();
        queue.pop_front();
        region.push_back(p);
        for (const cv::Point d :
             {cv::Point(1, 0), cv::Point(-1, 0), cv::Point(0, 1), cv::Point(0, -1)}) {
          const cv::Point q = p + d;
          if (q.x < 0 || q.y < 0 || q.x >= h.cols || q.y >= h.rows || seen.at<uchar>(q)) continue;
          if (!(std::fabs(h.at<float>(p) - h.at<float>(q)) <= step)) continue;
          seen.at<uchar>(q) = 1;
          queue.push_back(q);
        }
      }
      if (static_cast<int>(region.size()) < least)
        for (const cv::Point& p : region) out.at<float>(p) = kNaN;
    }
  }
  return out;
}

TEST(SweepFilters, SpecklesAreThoseOfAFlood) {
  std::mt19937 random(5);
  for (const cv::Size size :
       {cv::Size(150, 130), cv::Size(1, 200), cv::Size(200, 1), cv::Size(64, 48)}) {
    cv::Mat h(size, CV_32FC1);
    for (int y = 0; y < size.height; ++y)
      for (int x = 0; x < size.width; ++x)
        h.at<float>(y, x) =
            random() % 9 == 0 ? kNaN : static_cast<float>((random() % 5) * (random() % 3));
    for (const int least : {2, 7, 40}) {
      const cv::Mat expected = floodedSpeckles(h, 1.5f, least);
      const auto lost = [](const cv::Mat& m) {
        return std::count_if(m.begin<float>(), m.end<float>(),
                             [](float v) { return std::isnan(v); });
      };
      for (const int threads : {1, 4}) {
        cv::Mat filtered = h.clone();
        const std::size_t removed = removeSpeckles(&filtered, 1.5f, least, threads);
        EXPECT_EQ(static_cast<std::ptrdiff_t>(removed), lost(filtered) - lost(h));
        for (int y = 0; y < size.height; ++y) {
          for (int x = 0; x < size.width; ++x) {
            ASSERT_EQ(std::isnan(expected.at<float>(y, x)), std::isnan(filtered.at<float>(y, x)))
                << x << " " << y << " of " << size << ", least " << least;
          }
        }
      }
    }
  }
}

class EverySet : public testing::TestWithParam<const char*> {
 protected:
  void SetUp() override { holdSimd(GetParam()); }
  void TearDown() override { holdSimd("best"); }
};

TEST_P(EverySet, AverageIsThatOfTheMedianAndWhatLiesNearIt) {
  std::mt19937 random(7);
  constexpr int kCount = 77, kReach = kAverageRows / 2;
  constexpr float kNear = 150;
  std::vector<std::vector<float>> rows(kAverageRows, std::vector<float>(kCount + 130));
  const float* pointers[kAverageRows];
  for (int r = 0; r < kAverageRows; ++r) {
    for (float& v : rows[r]) v = random() % 6 == 0 ? kNaN : static_cast<float>(random() % 1000);
    pointers[r] = &rows[r][kReach];
  }
  std::vector<float> out(kCount + 130);
  averageRow(pointers, kCount, kNear, out.data());
  int checked = 0, averaged = 0;
  for (int x = 0; x < kCount; ++x) {
    const auto at = [&](int dx, int dy) { return pointers[kReach + dy][x + dx]; };
    const float middle = at(0, 0);
    if (std::isnan(middle)) {
      EXPECT_TRUE(std::isnan(out[x]));
      continue;
    }
    std::vector<float> nine;
    for (int dy = -1; dy <= 1; ++dy)
      for (int dx = -1; dx <= 1; ++dx) nine.push_back(std::isnan(at(dx, dy)) ? middle : at(dx, dy));
    std::nth_element(nine.begin(), nine.begin() + 4, nine.end());
    double sum = nine[4];
    int number = 1;
    for (int dy = -kReach; dy <= kReach; dy += kReach) {
      for (int dx = -kReach; dx <= kReach; dx += kReach) {
        if ((dx == 0 && dy == 0) || !(std::fabs(at(dx, dy) - nine[4]) <= kNear)) continue;
        sum += at(dx, dy);
        ++number;
      }
    }
    EXPECT_NEAR(out[x], sum / number, 1e-3) << x;
    ++checked;
    averaged += number > 1;
  }
  EXPECT_GT(checked, 50);
  EXPECT_GT(averaged, 40);
}

TEST_P(EverySet, ClaimsAndEdgesRejectWhatTheyShould) {
  std::mt19937 random(13);
  constexpr int kCount = 125, kSpots = 80, kReach = RejectJob::kReach;
  constexpr float kUnits = 4;
  std::vector<float> h[3];
  std::vector<std::uint16_t> cost[3];
  for (int r = 0; r < 3; ++r) {
    h[r].resize(kCount + 130);
    cost[r].resize(kCount + 130);
    for (float& v : h[r])
      v = random() % 7 == 0 ? kNaN : static_cast<float>(random() % 3) * 2.0f + 0.125f;
    for (auto& v : cost[r]) v = static_cast<std::uint16_t>(20 + random() % 300);
  }
  std::vector<std::int32_t> claim(kCount + 64, 7), claims(kSpots + kClaimSlack, INT32_MAX);
  for (int x = 0; x < kCount; ++x)
    claim[x] = std::isnan(h[1][x + 16]) ? -1 : static_cast<int>(random() % kSpots);
  ClaimJob job;
  job.count = kCount;
  job.claim = claim.data();
  job.h = &h[1][16];
  job.cost = &cost[1][16];
  job.units = kUnits;
  job.claims = claims.data();
  job.none = kSpots;
  claimRow(job);
  RejectJob reject;
  reject.claimed = job;
  reject.tolerance = 6;
  reject.jump = 1.5f;
  for (int r = 0; r < 3; ++r) {
    reject.h[r] = &h[r][16];
    reject.cost[r] = &cost[r][16];
  }
  std::vector<float> out(kCount + 64);
  reject.out = out.data();
  // Strict in the first tile alone: beyond it the spots beside count too, and edges stay.
  constexpr int kTile = 80;
  const std::uint8_t strict[] = {1, 0};  // of 80 pixels each
  reject.strict = strict;
  reject.tile_width = kTile;
  rejectRow(&reject);
  std::size_t found = 0, lost = 0, edge = 0;
  for (int x = 0; x < kCount; ++x) {
    const float own = h[1][x + 16];
    if (std::isnan(own)) {
      EXPECT_TRUE(std::isnan(out[x]));
      continue;
    }
    ++found;
    // The winner of a spot: the least cost, then the smaller hypothesis.
    const auto isLost = [&](int spot) {
      int winner = -1;
      for (int i = 0; i < kCount; ++i) {
        if (claim[i] != spot) continue;
        const auto key = [&](int k) { return std::pair(cost[1][k + 16], h[1][k + 16]); };
        if (winner < 0 || key(i) < key(winner)) winner = i;
      }
      return winner < 0 || std::fabs(h[1][winner + 16] - own) * kUnits > 6;
    };
    const bool is_strict = x < kTile;
    const bool is_lost = isLost(claim[x]) &&
                         (is_strict || (isLost(std::max(claim[x] - 1, 0)) && isLost(claim[x] + 1)));
    bool is_edge = false;
    const auto look = [&](int row, int dx) {
      const float outside = h[1 + row][x + 16 + dx], inside = h[1 - row][x + 16 - dx];
      is_edge = is_edge || (is_strict && own - outside > 1.5f && std::fabs(own - inside) < 1.5f &&
                            10 * (cost[1][x + 16] - 40) > 13 * cost[1 - row][x + 16 - dx]);
    };
    look(-1, 0);
    look(1, 0);
    look(0, -kReach);
    look(0, kReach);
    lost += is_lost;
    edge += !is_lost && is_edge;
    EXPECT_EQ(std::isnan(out[x]), is_lost || is_edge) << x;
    if (!is_lost && !is_edge) {
      EXPECT_EQ(out[x], own);
    }
  }
  EXPECT_GT(lost, 5u);
  EXPECT_GT(edge, 2u);
  EXPECT_GT(found, lost + edge + 10);
  EXPECT_EQ(reject.found, found);
  EXPECT_EQ(reject.lost, lost);
  EXPECT_EQ(reject.edge, edge);
}

TEST_P(EverySet, SamplesBetweenPixels) {
  std::mt19937 random(9);
  cv::Mat image(40, 50, CV_8UC1);
  cv::randu(image, 0, 256);
  PaddedImage padded;
  padded.create(image.cols, image.rows);
  for (int y = 0; y < image.rows; ++y)
    std::copy(image.ptr(y), image.ptr(y) + image.cols, padded.row(y));
  fillBorderRows(&padded);
  constexpr int kRuns = 45;  // more than a batch
  std::vector<float> x(kRuns + 1), y(kRuns + 1);
  std::vector<std::uint8_t> mask(kRuns), grey(kRuns * 8 + 64, 77);
  for (int n = 0; n <= kRuns; ++n) {
    x[n] = 1 + static_cast<float>(random() % 4700) / 100;
    y[n] = 1 + static_cast<float>(random() % 3700) / 100;
    if (n < kRuns) mask[n] = n % 5 == 0 ? 0 : n % 7 == 0 ? 0x5A : 0xFF;
  }
  constexpr int kPad = PaddedImage::kPad;
  std::vector<std::uint16_t> pairs(padded.stride * (image.rows + 2 * kPad) + 64);
  pairBlock(padded, -kPad, -kPad, padded.stride, image.rows + 2 * kPad - 1, Pairs::kDown,
            pairs.data(), padded.stride);
  sampleRow(pairs.data(), padded.stride, x.data(), y.data(), mask.data(), kRuns, grey.data());
  for (int n = 0; n < kRuns; ++n) {
    for (int i = 0; i < 8; ++i) {
      if (!(mask[n] >> i & 1)) {
        EXPECT_EQ(grey[n * 8 + i], 0);
        continue;
      }
      const double u = x[n] + (x[n + 1] - x[n]) * i / 8, v = y[n] + (y[n + 1] - y[n]) * i / 8;
      const int p = static_cast<int>(u), q = static_cast<int>(v);
      const auto at = [&](int dx, int dy) { return double(image.at<uchar>(q + dy, p + dx)); };
      const double fu = u - p, fv = v - q;
      const double truth = (at(0, 0) * (1 - fu) + at(1, 0) * fu) * (1 - fv) +
                           (at(0, 1) * (1 - fu) + at(1, 1) * fu) * fv;
      EXPECT_NEAR(grey[n * 8 + i], std::max(truth, 1.0), 3.0) << n << " " << i;
    }
  }
  EXPECT_EQ(grey[kRuns * 8], 77) << "written past the end";
}

/// A piece of an image to match, and where its costs go: a candidate in each of `lanes`, for each
/// pixel with a whole window.
struct Chunk {
  Chunk(int width, int height, int stride, const std::vector<std::int32_t>& base, int all_lanes)
      : columns(width - 2 * kRadius), lanes(all_lanes) {
    const std::size_t size = static_cast<std::size_t>(columns) * (height - 2 * kRadius) * lanes;
    volume.resize(size);
    near.resize(size);
    job.width = width;
    job.height = height;
    job.stride = stride;
    job.base = base.data();
    job.pixel_stride = lanes;
    job.row_stride = static_cast<std::ptrdiff_t>(columns) * lanes;
    job.scratch = &scratch;
  }
  std::size_t at(int x, int y, int lane) const {
    return (static_cast<std::size_t>(y) * columns + x) * lanes + lane;
  }

  const int columns, lanes;
  std::vector<std::uint16_t> volume;
  std::vector<std::uint8_t> near;
  std::vector<std::uint8_t> scratch;
  ChunkJob job;
};

TEST_P(EverySet, CostsAreBoxesOfBits) {
  std::mt19937 random(11);
  constexpr int kWidth = 21, kHeight = 13, kCells = 4000;
  std::vector<std::uint8_t> cells[kPlanes], reference[kPlanes];
  for (auto& plane : cells) {
    plane.resize(kCells + 64);
    for (auto& byte : plane) byte = static_cast<std::uint8_t>(random());
  }
  constexpr int kStride = 32;
  std::vector<std::int32_t> base(kStride * kHeight + 64);
  for (auto& b : base) b = static_cast<std::int32_t>(random() % (kCells - 100)) + 20;
  for (auto& plane : reference) {
    plane.resize(base.size());
    for (auto& byte : plane) byte = static_cast<std::uint8_t>(random());
  }
  // Chunks that join: hypotheses -9 to 6, 7 to 38 and 39 to 54.
  constexpr int kFirst = -9;
  const std::pair<int, int> chunks[] = {{kFirst, 16}, {7, 32}, {39, 16}};
  Chunk chunk(kWidth, kHeight, kStride, base, 64);
  ChunkJob& job = chunk.job;
  for (int p = 0; p < kPlanes; ++p) {
    job.reference[p] = reference[p].data();
    job.cells[p] = cells[p].data();
  }
  for (const auto& [first, lanes] : chunks) {
    job.first = first;
    job.lanes = lanes;
    job.volume = &chunk.volume[first - kFirst];
    job.near = &chunk.near[first - kFirst];
    matchChunk(job);
  }
  for (int y = 0; y < kHeight - 2 * kRadius; ++y) {
    for (int x = 0; x < kWidth - 2 * kRadius; ++x) {
      const auto box = [&](int k, int radius) {
        int sum = 0;
        for (int v = y + kRadius - radius; v <= y + kRadius + radius; ++v)
          for (int u = x + kRadius - radius; u <= x + kRadius + radius; ++u)
            for (int p = 0; p < kPlanes; ++p)
              sum += __builtin_popcount(reference[p][v * kStride + u] ^
                                        cells[p][base[v * kStride + u] + k]);
        return sum;
      };
      for (int lane = 0; lane < 64; ++lane) {
        ASSERT_EQ(chunk.volume[chunk.at(x, y, lane)], box(kFirst + lane, kRadius));
        ASSERT_EQ(chunk.near[chunk.at(x, y, lane)], box(kFirst + lane, 1));
      }
    }
  }
}

TEST_P(EverySet, CorrelationsAreThoseOfTheirFormulas) {
  constexpr int kWidth = 23, kHeight = 19, kStride = 32, kCells = 4096;
  std::mt19937 random(11);
  std::vector<std::uint8_t> reference(kStride * kHeight + 64), cells(kCells + 256);
  for (int y = 0; y < kHeight; ++y)
    for (int x = 0; x < kWidth; ++x)
      reference[y * kStride + x] = static_cast<std::uint8_t>(100 + random() % 60);
  for (auto& cell : cells) cell = static_cast<std::uint8_t>(80 + random() % 90);
  std::vector<std::int32_t> base(kStride * kHeight, 0);
  for (auto& b : base) b = static_cast<std::int32_t>(64 + random() % (kCells - 200));
  // Windows without contrast, here and there.
  for (int y = 0; y < 8; ++y) std::fill_n(&reference[y * kStride], 9, std::uint8_t{77});
  constexpr int kFirst = -9;
  Chunk chunk(kWidth, kHeight, kStride, base, 48);
  ChunkJob& job = chunk.job;
  job.reference[0] = reference.data();
  job.cells[0] = cells.data();
  for (const bool without_mean : {true, false}) {
    for (const auto& [first, lanes] : {std::pair(kFirst, 16), std::pair(7, 32)}) {
      job.first = first;
      job.lanes = lanes;
      job.volume = &chunk.volume[first - kFirst];
      correlateChunk(job, without_mean);
    }
    int plain = 0;
    for (int y = 0; y < kHeight - 2 * kRadius; ++y) {
      for (int x = 0; x < kWidth - 2 * kRadius; ++x) {
        double a = 0, aa = 0;
        for (int v = y; v < y + kWindow; ++v) {
          for (int u = x; u < x + kWindow; ++u) {
            a += reference[v * kStride + u];
            aa += std::pow(reference[v * kStride + u], 2);
          }
        }
        constexpr double kCount = kWindow * kWindow;
        const double variance = aa / kCount - a * a / kCount / kCount;
        const auto costOf = [&](int k) {
          double b = 0, bb = 0, ab = 0;
          for (int v = y; v < y + kWindow; ++v) {
            for (int u = x; u < x + kWindow; ++u) {
              const double grey = cells[base[v * kStride + u] + k];
              b += grey;
              bb += grey * grey;
              ab += grey * reference[v * kStride + u];
            }
          }
          // Half of all bits for windows without relation, in sixteenths.
          const double unrelated = 0.5 * kCount * kBits * 16;
          if (variance < kLeastVariance) return 32767.0;
          const double zncc =
              (kCount * ab - a * b) / std::sqrt((kCount * aa - a * a) * (kCount * bb - b * b));
          const double eq31 = ab / std::sqrt(aa * bb);
          return without_mean ? unrelated * (1 - zncc)
                              : unrelated * (1 - eq31) * (aa / kCount) / variance;
        };
        plain += variance < kLeastVariance;
        for (int lane = 0; lane < 48; ++lane)
          ASSERT_NEAR(chunk.volume[chunk.at(x, y, lane)], std::min(costOf(kFirst + lane), 32767.0),
                      2);
      }
    }
    EXPECT_GT(plain, 0);
  }
}

INSTANTIATE_TEST_SUITE_P(Sweep, EverySet, testing::Values("best", "avx2", "sse4", "scalar"));

}  // namespace
}  // namespace omnister::sweep
