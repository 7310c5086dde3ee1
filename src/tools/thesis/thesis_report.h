// SPDX-License-Identifier: Apache-2.0
/// @file The page that `evaluate thesis` writes, and the chapters that add to it.
#pragma once

#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "omnister/common/progress.h"
#include "tools/thesis/thesis_depth.h"
#include "tools/thesis/thesis_dewarping.h"
#include "tools/thesis/thesis_setting.h"

namespace omnister::tools::thesis {

using Json = nlohmann::ordered_json;

/// "12.3 %" of 0.123.
std::string percent(double share, int digits = 1);

struct Claim {
  std::string text;
  bool holds = false;
  std::string evidence;
};

/// Of one claim, gathered lens by lens.
struct Verdict {
  bool holds = true;  ///< for every lens so far
  std::string evidence;

  void require(bool condition) { holds = holds && condition; }
};

struct Report {
  Progress progress;
  double stages = 1.0;  ///< of all the work
  double stage = 0.0;   ///< done of them
  std::string body;     ///< HTML
  Json json;
  std::vector<Claim> claims;
  Verdict quadric_dewarps_better, quadric_depth_better, corners_better, r0_wrong, linear_fits,
      better_surfaces, many_to_one;

  void heading(const std::string& text) { body += "<h2>" + text + "</h2>\n"; }
  void paragraph(const std::string& text) { body += "<p>" + text + "</p>\n"; }
  void say(const std::string& what) const {
    if (progress) progress(stage / stages, what);
  }
};

/// One lens shape, the boards that it saw, and the lenses found from them.
struct LensRun {
  const Shape& shape;
  ViewDetections board;  ///< square to the axis
  Detections boards;     ///< tilted
  Found found;
  Json json;
};

/// The asymmetric 3 mm lens: figs 3.2, 3.3 and 3.5.
void chapter3(double scale, int threads, Report& report);
/// Dewarping: table 4.1, figs 4.2, 4.5, 4.9 to 4.15, and fig. 5.1 with the memory of sec. 5.1.
void chapter4(LensRun& run, int threads, Report& report);
/// Stereo: table 5.1, figs 5.3 to 5.8. @param step between measured pixels [px]
void chapter5(LensRun& run, int step, int threads, Report& report);

}  // namespace omnister::tools::thesis
