// SPDX-License-Identifier: Apache-2.0
#include "ros/stereo/stereo_parameters.h"

#include <ros/console.h>

#include <algorithm>
#include <tuple>
#include <utility>

#include "omnister/common/error.h"
#include "omnister/common/image_file.h"
#include "omnister/stereo/input_region.h"
#include "omnister/stereo/presets.h"
#include "omnister/view/epipolar_overlay.h"

namespace omnister {
namespace {

/// Frames that may be needed to find `positions` places.
std::size_t historyFor(int positions) { return static_cast<std::size_t>(positions) + 7; }

/// `visit(live, kept)` for every value that is the same in both.
template <typename Config, typename Kept, typename Visit>
void eachLiveValue(Config& config, Kept& parameters, const Visit& visit) {
  visit(config.preset, parameters.preset);
  visit(config.min_baseline, parameters.pairing.min_baseline);
  visit(config.max_baseline, parameters.pairing.max_baseline);
  visit(config.positions, parameters.pairing.positions);
  visit(config.min_range, parameters.matching.min_range);
  visit(config.max_range, parameters.matching.max_range);
  visit(config.hypotheses, parameters.matching.hypotheses);
  visit(config.matcher, parameters.matcher);
  visit(config.cost, parameters.cost);
  visit(config.window, parameters.window);
  visit(config.refine, parameters.matching.refine);
  visit(config.mask, parameters.mask);
  visit(config.roi, parameters.region);
  visit(config.reduce, parameters.reduce);
  visit(config.use_prior, parameters.use_prior);
  visit(config.stream, parameters.stream);
  visit(config.epipolar_pixels, parameters.epipolar_pixels);
}

/// A rate's period and a period's rate; 0: no limit.
double inverse(double value) { return value > 0.0 ? 1.0 / value : 0.0; }

}  // namespace

cv::Mat loadMask(const std::string& path) {
  if (path.empty()) return {};
  return readImage(path, ImageColor::kGray);
}

std::vector<std::string> presetNames() {
  std::vector<std::string> names = {"custom"};
  for (const MatchingPreset& preset : matchingPresets()) names.push_back(preset.name);
  return names;
}

void applyPreset(StereoConfig& config) {
  if (config.preset == "custom") return;
  const MatchingPreset& preset = matchingPreset(config.preset);
  config.matcher = "sweep";
  config.hypotheses = 0;
  config.positions = preset.positions;
  config.reduce = preset.reduce;
  config.refine = preset.refine;
}

void settlePreset(StereoConfig& config, const StereoConfig& before) {
  const std::vector<std::string> names = presetNames();
  if (std::find(names.begin(), names.end(), config.preset) == names.end())
    config.preset = before.preset;
  StereoConfig preset = config;
  applyPreset(preset);
  const auto values = [](const StereoConfig& c) {
    return std::tie(c.matcher, c.hypotheses, c.positions, c.reduce, c.refine);
  };
  if (config.preset != before.preset)
    config = preset;
  else if (values(config) != values(preset))
    config.preset = "custom";
}

StereoConfig toConfig(const StereoParameters& parameters) {
  StereoConfig config = StereoConfig::__getDefault__();
  eachLiveValue(config, parameters, [](auto& live, const auto& kept) { live = kept; });
  config.max_rate = inverse(parameters.min_period);
  return config;
}

void take(const StereoConfig& config, StereoParameters& parameters) {
  eachLiveValue(config, parameters, [](const auto& live, auto& kept) { kept = live; });
  parameters.min_period = inverse(config.max_rate);
  parameters.pairing.history = historyFor(config.positions);
  parameters.matching.cost = parseMatchCost(config.cost);
  parameters.matching.window = parseMatchWindow(config.window);
}

WorkerSettings settingsOf(const StereoParameters& parameters) {
  WorkerSettings settings;
  settings.matcher = parameters.matcher;
  settings.matching = parameters.matching;
  settings.region = parameters.region;
  settings.reduce = parameters.reduce;
  settings.use_prior = parameters.use_prior;
  settings.stream = parameters.stream;
  settings.min_baseline = parameters.pairing.min_baseline;
  settings.max_baseline = parameters.pairing.max_baseline;
  settings.max_rotation = parameters.pairing.max_rotation;
  return settings;
}

StereoParameters loadStereoParameters(Parameters& parameters) {
  StereoParameters result;
  result.rig = parameters.choice("mode", "stage", {"stage", "rig"}) == "rig";
  result.lens = parameters.text("lens", "");
  result.lens_displaced = parameters.text("lens_displaced", "");
  result.rig_file = parameters.text("rig", "");
  result.fixed_frame = parameters.frame("fixed_frame", result.fixed_frame);
  result.mask = parameters.text("mask", "");
  result.matching.mask = parameters.file("mask", result.mask, loadMask);

  PairingOptions& pairing = result.pairing;
  pairing.min_baseline = parameters.number("min_baseline", 0.01, 1e-6, 1e3, "m");
  pairing.max_baseline = parameters.number("max_baseline", 1.0, 1e-6, 1e3, "m");
  pairing.max_rotation = parameters.number("max_rotation", 0.5, 0.0, 3.2, "rad");
  pairing.positions = parameters.integer("positions", 1, 1, 16);
  pairing.settle_time = parameters.number("settle_time", 0.04, 0.0, 10.0, "s");
  pairing.settle_distance = parameters.number("settle_distance", 2e-4, 0.0, 1.0, "m");
  pairing.max_wait = parameters.number("max_wait", 1.0, 0.0, 60.0, "s");
  pairing.max_age = parameters.number("max_age", 0.0, 0.0, 1e6, "s");

  result.max_skew = parameters.number("max_skew", 0.02, 0.0, 1.0, "s");
  // rviz and others fail on huge coordinates, so a cloud always ends somewhere.
  result.matching.min_range = parameters.number("min_range", 0.0, 0.0, 1e4, "m");
  result.matching.max_range = parameters.number("max_range", 50.0, 1e-3, 1e4, "m");
  result.matching.hypotheses = parameters.integer("hypotheses", 0, 0, 4096);
  result.matching.threads = parameters.integer("threads", 0, 0, 256);
  result.matching.refine = parameters.flag("refine", false);
  result.cost = parameters.choice("cost", "census", {"census", "zncc", "eq3.1"});
  result.window = parameters.choice("window", "surface", {"surface", "ray", "fronto", "best"});
  result.region = parameters.text("roi", "");
  parseRegion(result.region, kAnySize, "~roi");
  result.reduce = parameters.integer("reduce", 1, 1, 16);
  result.use_prior = parameters.flag("use_prior", false);
  result.stream = parameters.flag("stream", false);
  if (result.stream && result.rig)
    throw InputError("~stream", "", "is for one camera that moves, not for mode rig");
  result.min_period =
      inverse(parameters.number("max_rate", 0.0, 0.0, 1000.0, "Hz (0: as fast as it goes)"));
  result.matcher = parameters.choice("matcher", "sweep", {"sweep", "thesis"});
  result.preset = parameters.choice("preset", "custom", presetNames());
  result.drift = loadDriftParameters(parameters);
  result.epipolar_pixels = parameters.text("epipolar_pixels", "");
  parsePixels(result.epipolar_pixels, "~epipolar_pixels");
  StereoConfig config = toConfig(result);
  applyPreset(config);
  take(config, result);
  if (result.matching.max_range <= result.matching.min_range)
    throw InputError("~max_range", "", "is not larger than ~min_range");
  for (const auto& [key, value] :
       {std::pair("rig", &result.rig_file), std::pair("lens_displaced", &result.lens_displaced)}) {
    if (!result.rig && !value->empty())
      ROS_WARN("parameter ~%s is for mode rig and changes nothing", key);
  }
  parameters.warnUnknown();
  return result;
}

}  // namespace omnister
