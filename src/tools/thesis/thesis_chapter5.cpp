// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "tools/report/html_plot.h"
#include "tools/thesis/thesis_report.h"

namespace omnister::tools::thesis {
namespace {

/// Figs 5.6 to 5.8.
void depthFigures(const Shape& shape, const Found& found,
                  const std::vector<DepthStatistics>& depths, int step, Report& report) {
  // The thesis shows the first two.
  const char* maps[] = {"Fig. 5.6", "Fig. 5.7", "As fig. 5.7"};
  const char* errors[] = {"Fig. 5.8a", "Fig. 5.8b", "As fig. 5.8"};
  for (int m = 0; m < kFiguredModels; ++m) {
    if (depths[m].points.empty()) continue;
    const std::string name = escaped(found.models[m].name);
    const std::string map = maps[std::min(m, 2)];
    report.body += figure(
        depthMap(depths[m], shape.size, step),
        map + ": " + name + "; red is too far, blue too near, full colour 10 %; white: no match");
    report.body += figure(depthProfile(depths[m]), map + " from below, " + name);
    report.body +=
        figure(axisErrorPlot(depths[m], shape.lens->center().y(), step),
               std::string(errors[std::min(m, 2)]) + ": depth error along the x axis, " + name);
  }
}

/// Table 5.1, figs 5.6 to 5.8.
void depthTable(LensRun& run, const StereoPair& pair, int step, int threads, Report& report) {
  const Shape& shape = run.shape;
  const Found& found = run.found;
  std::vector<DepthStatistics> depths(found.models.size());
  report.body +=
      "<h3>Table 5.1: depth of the random-pattern board</h3>\n<table>\n" +
      row({"surface", "avg [mm]", "max [mm]", "avg [%]", "max [%]", "matched", "beyond 45 deg",
           "distance [mm]"},
          "th") +
      row({"thesis: spherical", "3.635", "16.38", "2.10", "9.48", "corners lost", "", ""}) +
      row({"thesis: quadric", "2.340", "5.545", "1.35", "3.184", "to the corners", "", ""});
  const auto depthRow = [&](const std::string& name, const DepthStatistics& d) {
    report.body += row({escaped(name), fixed(d.mean_mm, 3), fixed(d.max_mm, 2),
                        fixed(d.mean_percent, 3), fixed(d.max_percent, 2), percent(d.matched),
                        percent(d.corners_matched), fixed(1e3 * d.distance_m, 1)});
    run.json["table_5_1"][name] = {{"mean_mm", d.mean_mm},
                                   {"max_mm", d.max_mm},
                                   {"mean_percent", d.mean_percent},
                                   {"max_percent", d.max_percent},
                                   {"matched", d.matched},
                                   {"matched_beyond_45_deg", d.corners_matched},
                                   {"distance_mm", 1e3 * d.distance_m}};
  };
  for (std::size_t m = 0; m < found.models.size(); ++m) {
    report.say(shape.name + ": depth by " + found.models[m].name);
    if (found.models[m].lens) {
      depths[m] = depthStatistics(shape, *found.models[m].lens, found.models[m].lens, pair,
                                  kBoardDistance, ThesisMask::kDistortedPixels, threads);
      depthRow(found.models[m].name, depths[m]);
    }
    report.stage += 0.8;
  }
  report.body += "</table>\n";
  report.paragraph(
      "Residuals along the axis from a plane fitted to the matches, those within 12 % of it; "
      "the true distance is " +
      fixed(1e3 * kBoardDistance, 0) +
      " mm. A lens whose R0 is wrong finds a plane at the "
      "wrong distance.");
  depthFigures(shape, found, depths, step, report);
  if (!depths[0].points.empty() && !depths[1].points.empty()) {
    report.quadric_depth_better.require(depths[1].mean_percent < depths[0].mean_percent);
    report.corners_better.require(depths[1].corners_matched > depths[0].corners_matched + 0.05);
    report.quadric_depth_better.evidence += shape.name + " " + fixed(depths[0].mean_percent, 2) +
                                            " and " + fixed(depths[1].mean_percent, 2) + " %; ";
    report.corners_better.evidence += shape.name + " " + percent(depths[0].corners_matched, 0) +
                                      " and " + percent(depths[1].corners_matched, 0) + "; ";
  }
}

/// Fig. 5.4 against fig. 5.5, by the lens itself, so that nothing but the mask differs.
void masks(LensRun& run, const StereoPair& pair, int threads, Report& report) {
  const Shape& shape = run.shape;
  report.say(shape.name + ": masks");
  const DepthStatistics square = depthStatistics(
      shape, *shape.lens, shape.lens, pair, kBoardDistance, ThesisMask::kDewarpedSquare, threads);
  const DepthStatistics warped = depthStatistics(
      shape, *shape.lens, shape.lens, pair, kBoardDistance, ThesisMask::kDistortedPixels, threads);
  const Vector2d rim(0.06 * shape.size.width, 0.5 * shape.size.height);
  const Vector2d corner(0.04 * shape.size.width, 0.04 * shape.size.height);
  const double at_rim = distinctShare(*shape.lens, rim, 11);
  const double at_corner = distinctShare(*shape.lens, corner, 11);
  report.body +=
      "<h3>Fig. 5.4 against fig. 5.5</h3>\n<table>\n" +
      row({"mask", "avg [mm]", "matched", "beyond 45 deg", "distinct pixels at the left rim",
           "in the corner", "seconds"},
          "th") +
      row({"fig. 5.4: square when dewarped", fixed(square.mean_mm, 3), percent(square.matched),
           percent(square.corners_matched), percent(at_rim, 0), percent(at_corner, 0),
           fixed(square.seconds, 1)}) +
      row({"fig. 5.5: distinct pixels", fixed(warped.mean_mm, 3), percent(warped.matched),
           percent(warped.corners_matched), "100 %", "100 %", fixed(warped.seconds, 1)}) +
      "</table>\n";
  run.json["masks"] = {{"fig_5_4",
                        {{"mean_mm", square.mean_mm},
                         {"matched", square.matched},
                         {"matched_beyond_45_deg", square.corners_matched},
                         {"distinct_at_rim", at_rim},
                         {"distinct_in_corner", at_corner}}},
                       {"fig_5_5",
                        {{"mean_mm", warped.mean_mm},
                         {"matched", warped.matched},
                         {"matched_beyond_45_deg", warped.corners_matched}}}};
}

}  // namespace

void chapter5(LensRun& run, int step, int threads, Report& report) {
  const StereoPair pair =
      renderPair(run.shape, kBoardDistance, kBaseline, step, kDewarpLimit, threads);
  report.body +=
      figure(windowPlot(run.shape, kBoardDistance, kBaseline),
             "Fig. 5.3: square windows of the right image (grey) and what they become in the "
             "left one (red), board at " +
                 fixed(1e3 * kBoardDistance, 0) + " mm, baseline 2 in");
  depthTable(run, pair, step, threads, report);
  masks(run, pair, threads, report);
}

}  // namespace omnister::tools::thesis
