// SPDX-License-Identifier: Apache-2.0
/// @file The presets fast, balanced and accurate beside each other in the rendered room: time,
/// density, errors. One frame of each in turn, so that what else the machine does hits all alike.
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <memory>
#include <string>
#include <vector>

#include "measure.h"
#include "omnister/lens/reduced_lens.h"
#include "omnister/stereo/presets.h"
#include "stereo_pair.h"

namespace omnister::bench {
namespace {

const cv::Size kSize(1280, 960);

struct Contestant {
  std::string name;
  StereoCase images;
  std::unique_ptr<Matcher> matcher;
  std::vector<double> wall, cpu;
  Score score;
};

/// @param travel of the displaced camera to the farthest position [m]; 0: a quarter of the nearest
/// range
Contestant contestant(const MatchingPreset& preset, int positions, double travel,
                      const sim::Scene& scene) {
  Contestant entry;
  entry.name = std::string(preset.name) + ", " + std::to_string(positions + 1) + " images";
  CaseOptions options;
  options.positions = positions;
  options.baseline = travel / positions;
  // Rendered at the reduced size: what means over squares of pixels give, with a truth of its own.
  const LensPtr lens = reducedLens(equidistant180(kSize), preset.reduce);
  entry.images = makeCase("room", scene, lens, kSize / preset.reduce, options);
  MatcherOptions matching;
  matching.refine = preset.refine;
  entry.matcher = makeMatcher("sweep", entry.images.geometry, matching);
  return entry;
}

void run(int runs) {
  const sim::ScenePtr scene = sim::readScene(std::string(OMNISTER_SCENES) + "/room.yaml");
  std::vector<Contestant> contestants;
  for (const MatchingPreset& preset : matchingPresets()) {
    contestants.push_back(contestant(preset, 1, 0.0, *scene));
    if (preset.positions == 1) continue;
    const Pose& farthest = contestants.back().images.geometry.displaced.back().T_ref_disp;
    contestants.push_back(
        contestant(preset, preset.positions, farthest.translation().norm(), *scene));
  }
  for (int i = 0; i <= runs; ++i) {
    for (Contestant& entry : contestants) {
      const Instant start = Instant::now();
      const MatchResult result =
          entry.matcher->match(entry.images.reference, entry.images.displaced);
      const Instant end = Instant::now();
      if (i == 0) {
        // The first warms up.
        entry.score = score(entry.images, result.range);
        continue;
      }
      entry.wall.push_back(1e3 * (end.wall - start.wall));
      entry.cpu.push_back(1e3 * (end.cpu - start.cpu));
    }
  }
  std::printf("%-22s %9s %9s %8s %10s %10s\n", "preset (1280x960)", "wall ms", "cpu ms", "density",
              "median %", "over 1 px");
  for (const Contestant& entry : contestants) {
    std::printf("%-22s %9.1f %9.1f %8.3f %10.3f %10.4f\n", entry.name.c_str(), medianOf(entry.wall),
                medianOf(entry.cpu), entry.score.density, entry.score.median_percent,
                entry.score.over_1px);
  }
}

}  // namespace
}  // namespace omnister::bench

int main(int argc, char** argv) {
  const int runs = argc > 1 ? std::atoi(argv[1]) : 9;
  if (argc > 2 || runs < 1) {
    std::fprintf(stderr, "usage: omnister_bench_presets [RUNS]\n");
    return 2;
  }
  return omnister::bench::report("omnister_bench_presets", [&] {
    omnister::bench::run(runs);
    return 0;
  });
}
