// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <map>

#include "omnister/lens/lens_models.h"
#include "tools/report/html_plot.h"
#include "tools/thesis/thesis_report.h"

namespace omnister::tools::thesis {

void chapter3(double scale, int threads, Report& report) {
  report.say("chapter 3: the 3 mm lens");
  // Equisolid, its focal length and the stretch of x chosen so that x is served best by R = 470
  // and y by R = 451, as the thesis found.
  const cv::Size size(static_cast<int>(std::lround(768 * scale)),
                      static_cast<int>(std::lround(576 * scale)));
  const Vector2d center(0.5 * (size.width - 1), 0.5 * (size.height - 1));
  const double wanted = 470.0 * scale;
  double f = wanted;
  double stretch = 1.0;
  Shape shape;
  ViewDetections board;
  std::mt19937 random(3);
  for (int i = 0; i < 15; ++i) {
    shape = {"3 mm lens", "r = 2 f sin(theta/2), x stretched by " + fixed(stretch, 3),
             lensOf([=](double t) { return 2.0 * f * std::sin(0.5 * t); }, center, 75.0 * kDegree,
                    stretch),
             size};
    random.seed(3);
    // The field of the thesis' stereo test: 93 x 79 degrees.
    board = squareBoard(shape, 46.5 * kDegree, 0.15, random);
    ProcedureOptions procedure;
    procedure.center = center;
    const DotRadius found = calibrateByDots(board, size, procedure);
    const double x = found.best_x.radius / wanted;
    const double y = found.best_y.radius / (wanted * 451.0 / 470.0);
    if (std::abs(x - 1.0) < 2e-3 && std::abs(y - 1.0) < 2e-3) break;
    // Slowly: the errors of x and y both follow either number.
    f /= std::sqrt(y);
    stretch *= std::pow(y / x, 0.4);
  }
  ProcedureOptions procedure;
  procedure.center = center;
  procedure.min_radius = 420.0 * scale;
  procedure.max_radius = 500.0 * scale;
  const DotRadius dots = calibrateByDots(board, size, procedure);
  report.heading("Chapter 3: one radius for an asymmetric 3 mm lens");
  report.paragraph("A simulated lens, " + shape.formula + ", " + std::to_string(size.width) + "x" +
                   std::to_string(size.height) + ", " + std::to_string(board.pixels.size()) +
                   " dots seen with " + fixed(kNoisePx, 1) + " px of noise.");
  Range r, e;
  for (const SweepStep& step : dots.sweep) {
    r.add(step.radius);
    e.add(step.error_x);
    e.add(step.error_y);
  }
  e.add(0.0);
  e.widen();
  Plot plot(520, 320, r.low, r.high, e.low, e.high);
  for (std::size_t i = 1; i < dots.sweep.size(); ++i) {
    const SweepStep& a = dots.sweep[i - 1];
    const SweepStep& b = dots.sweep[i];
    plot.color(0.8, 0.1, 0.1);
    plot.line(a.radius, a.error_x, b.radius, b.error_x);
    plot.color(0.1, 0.3, 0.8);
    plot.line(a.radius, a.error_y, b.radius, b.error_y);
    plot.color(0.0, 0.0, 0.0);
    plot.line(a.radius, a.combined, b.radius, b.combined);
  }
  report.body += figure(
      asImage(plot.finish("dewarp factor R [px]", "mean error [px]")),
      "Fig. 3.3: mean error along x (red), y (blue) and of both (black) against R. "
      "Best for x " +
          fixed(dots.best_x.radius, 0) + " (thesis 470), for y " + fixed(dots.best_y.radius, 0) +
          " (thesis 451), for both " + fixed(dots.best.radius, 0) + " (thesis 470)");
  const auto sphere = [&](double radius) {
    std::map<std::string, std::vector<double>> named{{"R", {radius}}};
    return makeLens("spherical", center, named, 80.0 * kDegree, "fig. 3.2");
  };
  for (const double radius : {dots.best_y.radius, dots.best_x.radius}) {
    report.body += figure(
        dewarpPlot(dewarpStatistics(shape, *sphere(radius), board)),
        "Fig. 3.2: dewarped dots (red) and their true places (black), R = " + fixed(radius, 0));
  }
  const double distance = 7.9 * kInch;
  const int step = std::max(4, static_cast<int>(16 * scale));
  const StereoPair pair = renderPair(shape, distance, kBaseline, step, 50.0 * kDegree, threads);
  const LensPtr lens = sphere(dots.best.radius);
  const DepthStatistics depth =
      depthStatistics(shape, *lens, lens, pair, distance, ThesisMask::kDistortedPixels, threads);
  report.body +=
      figure(depthMap(depth, size, step),
             "Fig. 3.5: the random-pattern board at 7.9 in, baseline 2 in, by the spherical "
             "lens of fig. 3.3; red is too far, blue too near, full colour 10 %");
  report.body += figure(depthProfile(depth), "Fig. 3.5 from below: depth over x");
  report.body +=
      "<table>\n" + row({"sec. 3.2.1", "average error", "largest error"}, "th") +
      row({"thesis", "2.9 %", "8.0 %"}) +
      row({"here", fixed(depth.mean_percent, 2) + " %", fixed(depth.max_percent, 2) + " %"}) +
      "</table>\n";
  report.json["chapter_3"] = {{"best_R_x", dots.best_x.radius},
                              {"best_R_y", dots.best_y.radius},
                              {"best_R", dots.best.radius},
                              {"depth_mean_percent", depth.mean_percent},
                              {"depth_max_percent", depth.max_percent},
                              {"thesis",
                               {{"best_R_x", 470},
                                {"best_R_y", 451},
                                {"best_R", 470},
                                {"depth_mean_percent", 2.9},
                                {"depth_max_percent", 8.0}}}};
  const double apart = dots.best_x.radius / dots.best_y.radius - 1.0;
  report.claims.push_back(
      {"No single R serves both axes of an asymmetric lens (fig. 3.3).", apart > 0.01,
       "x wants " + fixed(dots.best_x.radius, 0) + ", y " + fixed(dots.best_y.radius, 0)});
}

}  // namespace omnister::tools::thesis
