// SPDX-License-Identifier: Apache-2.0
/// @file Costs of the parts: lenses, renderer, views, and the sweep's frame.
#include <benchmark/benchmark.h>

#include <cmath>
#include <opencv2/imgproc.hpp>
#include <random>
#include <string>
#include <vector>

#include "measure.h"
#include "omnister/lens/lens_models.h"
#include "omnister/sim/renderer.h"
#include "omnister/view/view.h"
#include "stereo_pair.h"

namespace omnister::bench {
namespace {

constexpr double kDegree = 3.14159265358979324 / 180.0;
const cv::Size kSize(1280, 960);

LensPtr lensOf(const std::string& model) {
  LensStructure structure;
  structure.model = model;
  structure.even_terms = 2;
  return makeLens(structure, {639.5, 479.5}, 330.0, (model == "spherical" ? 80.0 : 95.0) * kDegree);
}

sim::ScenePtr room() { return sim::readScene(std::string(OMNISTER_SCENES) + "/room.yaml"); }

void project(benchmark::State& state, const std::string& model) {
  const LensPtr lens = lensOf(model);
  std::mt19937 random(1);
  std::normal_distribution<double> normal;
  std::vector<Eigen::Vector3d> rays(4096);
  for (auto& ray : rays) {
    do {
      ray = Eigen::Vector3d(normal(random), normal(random), std::abs(normal(random))).normalized();
    } while (!lens->project(ray));
  }
  for (auto _ : state) {
    for (const auto& ray : rays) benchmark::DoNotOptimize(lens->project(ray));
  }
  state.SetItemsProcessed(state.iterations() * static_cast<std::int64_t>(rays.size()));
}

void unproject(benchmark::State& state, const std::string& model) {
  const LensPtr lens = lensOf(model);
  std::mt19937 random(1);
  std::uniform_real_distribution<double> uniform(200.0, 800.0);
  std::vector<Eigen::Vector2d> pixels(4096);
  for (auto& pixel : pixels) pixel = {uniform(random), uniform(random)};
  for (auto _ : state) {
    for (const auto& pixel : pixels) benchmark::DoNotOptimize(lens->unproject(pixel));
  }
  state.SetItemsProcessed(state.iterations() * static_cast<std::int64_t>(pixels.size()));
}

void renderRoom(benchmark::State& state) {
  const auto scene = room();
  const sim::Renderer renderer(*equidistant180(kSize), kSize);
  sim::RenderOptions options;
  options.supersampling = static_cast<int>(state.range(0));
  options.adaptive = state.range(1) != 0;
  options.threads = 1;
  for (auto _ : state) {
    benchmark::DoNotOptimize(renderer.render(*scene, Pose::Identity(), options).image.data);
  }
  state.SetItemsProcessed(state.iterations() * kSize.area());
}

/// OpenCV's fixed maps of the same view.
struct FixedMaps {
  cv::Mat xy, fraction;
  FixedMaps(const LensModel& lens, const ViewGeometry& geometry) {
    cv::Mat map(geometry.size, CV_32FC2);
    for (int y = 0; y < map.rows; ++y) {
      for (int x = 0; x < map.cols; ++x) {
        const auto pixel = lens.project(*viewRay(geometry, Eigen::Vector2d(x, y)));
        map.at<cv::Vec2f>(y, x) =
            pixel ? cv::Vec2f(static_cast<float>(pixel->x()), static_cast<float>(pixel->y()))
                  : cv::Vec2f(-16.0f, -16.0f);
      }
    }
    cv::convertMaps(map, cv::noArray(), xy, fraction, CV_16SC2);
  }
};

/// A view beside cv::remap with the same fixed maps, frame about: `ratio` is remap's median time
/// over the view's, so 1 or more where the view is as fast.
void viewBesideRemap(benchmark::State& state, int type, double pan, bool anti_alias) {
  const LensPtr lens = equidistant180(kSize);
  const ViewGeometry geometry = makeViewGeometry(Projection::kPinhole, {640, 480}, 80 * kDegree,
                                                 viewRotation(pan * kDegree, 0.2, 0.1));
  const View view(*lens, kSize, geometry, anti_alias);
  const FixedMaps maps(*lens, geometry);
  cv::Mat image(kSize, type), ours, theirs;
  cv::randu(image, 0, 255);
  const int threads = cv::getNumThreads();
  cv::setNumThreads(1);
  std::vector<double> view_seconds, remap_seconds;
  const auto timed = [](std::vector<double>& seconds, const auto& work) {
    const double start = Instant::now().cpu;
    work();
    seconds.push_back(Instant::now().cpu - start);
  };
  const auto renderView = [&] { view.render(image, ours); };
  const auto remap = [&] { cv::remap(image, theirs, maps.xy, maps.fraction, cv::INTER_LINEAR); };
  bool ours_first = true;
  for (auto _ : state) {
    // The second finds the image in the cache: each is first as often.
    if (ours_first) {
      timed(view_seconds, renderView);
      timed(remap_seconds, remap);
    } else {
      timed(remap_seconds, remap);
      timed(view_seconds, renderView);
    }
    ours_first = !ours_first;
  }
  cv::setNumThreads(threads);
  state.counters["view_ms"] = 1e3 * medianOf(view_seconds);
  state.counters["remap_ms"] = 1e3 * medianOf(remap_seconds);
  state.counters["ratio"] = medianOf(remap_seconds) / medianOf(view_seconds);
}

void sweepFrame(benchmark::State& state) {
  const auto scene = room();
  const StereoCase pair = makeCase("room", *scene, equidistant180(kSize), kSize);
  MatcherOptions options;
  options.threads = static_cast<int>(state.range(0));
  const auto matcher = makeMatcher("sweep", pair.geometry, options);
  std::map<std::string, double> stages;
  for (auto _ : state) {
    const MatchResult result = matcher->match(pair.reference, pair.displaced);
    for (const auto& [stage, seconds] : result.statistics.seconds) stages[stage] += 1e3 * seconds;
  }
  for (const auto& [stage, ms] : stages) {
    state.counters[stage + "_ms"] = benchmark::Counter(ms, benchmark::Counter::kAvgIterations);
  }
  state.SetItemsProcessed(state.iterations() * kSize.area());
}

void sweepSetUp(benchmark::State& state) {
  const auto scene = room();
  const StereoCase pair = makeCase("room", *scene, equidistant180(kSize), kSize);
  MatcherOptions options;
  options.threads = 1;
  for (auto _ : state) benchmark::DoNotOptimize(makeMatcher("sweep", pair.geometry, options));
}

BENCHMARK_CAPTURE(project, spherical, "spherical");
BENCHMARK_CAPTURE(project, quadric, "quadric");
BENCHMARK_CAPTURE(project, conic, "conic");
BENCHMARK_CAPTURE(project, asphere, "asphere");
BENCHMARK_CAPTURE(project, spline, "spline");
BENCHMARK_CAPTURE(unproject, spherical, "spherical");
BENCHMARK_CAPTURE(unproject, quadric, "quadric");
BENCHMARK_CAPTURE(unproject, conic, "conic");
BENCHMARK_CAPTURE(unproject, asphere, "asphere");
BENCHMARK_CAPTURE(unproject, spline, "spline");
BENCHMARK(renderRoom)
    ->ArgNames({"samples", "adaptive"})
    ->Args({1, 0})
    ->Args({3, 0})
    ->Args({3, 1})
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(viewBesideRemap, mono8, CV_8UC1, 28.0, true)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(viewBesideRemap, bgr8, CV_8UC3, 28.0, true)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(viewBesideRemap, bgr8_half_outside, CV_8UC3, 80.0, false)
    ->Unit(benchmark::kMillisecond);
// Smoothing, which remap leaves out, comes on top.
BENCHMARK_CAPTURE(viewBesideRemap, bgr8_half_outside_smoothed, CV_8UC3, 80.0, true)
    ->Unit(benchmark::kMillisecond);
BENCHMARK(sweepFrame)
    ->ArgName("threads")
    ->Arg(1)
    ->Arg(0)
    ->Unit(benchmark::kMillisecond)
    ->UseRealTime();
BENCHMARK(sweepSetUp)->Unit(benchmark::kMillisecond);

}  // namespace
}  // namespace omnister::bench

BENCHMARK_MAIN();
