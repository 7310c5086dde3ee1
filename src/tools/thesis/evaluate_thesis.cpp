// SPDX-License-Identifier: Apache-2.0
#include "tools/thesis/evaluate_thesis.h"

#include <algorithm>
#include <cmath>
#include <random>
#include <utility>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "tools/report/html_plot.h"
#include "tools/thesis/thesis_report.h"

namespace omnister::tools {
namespace thesis {

std::string percent(double share, int digits) { return fixed(100.0 * share, digits) + " %"; }

}  // namespace thesis

namespace {

using thesis::LensRun;
using thesis::Report;

LensRun findLenses(const thesis::Shape& shape, int threads, Report& report) {
  report.say(shape.name + ": boards");
  std::mt19937 random(5);
  LensRun run{shape,
              thesis::squareBoard(shape, thesis::kDewarpLimit, 0.12, random),
              thesis::tiltedBoards(shape, random),
              {},
              {}};
  run.found = thesis::findModels(shape, run.board, run.boards, thesis::straightEdges(shape, random),
                                 threads);
  run.json["formula"] = shape.formula;
  report.heading("Chapters 4 and 5 on the " + escaped(shape.name) + " shape");
  report.paragraph(
      escaped(shape.formula) + "; " + std::to_string(shape.size.width) + "x" +
      std::to_string(shape.size.height) + "; " + std::to_string(run.board.pixels.size()) +
      " dots of a board square to the axis to " + fixed(thesis::kDewarpLimit / thesis::kDegree, 0) +
      " degrees for the thesis' procedures, " + std::to_string(run.boards.views.size()) +
      " tilted boards for our fits, " + fixed(thesis::kNoisePx, 1) + " px of noise.");
  return run;
}

/// The claims of the thesis that the lenses together decide.
void judge(Report& report) {
  report.claims.push_back(
      {"The quadric dewarps better than the sphere (table 4.1: 4.1 against 18.5 px).",
       report.quadric_dewarps_better.holds,
       "averages, sphere and quadric: " + report.quadric_dewarps_better.evidence});
  report.claims.push_back(
      {"Surface heights along the axes follow a second-order curve (fig. 4.10: R^2 of "
       "0.972 and 0.942).",
       report.linear_fits.holds, report.linear_fits.evidence});
  report.claims.push_back(
      {"R0 of the procedure is the lens' focal length in pixels, so that the surface "
       "gives viewing rays.",
       !report.r0_wrong.holds,
       "its error: " + report.r0_wrong.evidence +
           "boards square to the axis do not determine it; tilted boards do"});
  report.claims.push_back(
      {"Dewarping maps several pixels to one, more with radius, and takes several times "
       "the memory (fig. 5.1, sec. 5.1).",
       report.many_to_one.holds, report.many_to_one.evidence});
  report.claims.push_back(
      {"Depth of a plane is flatter with the quadric than with the sphere (table 5.1: "
       "1.35 against 2.10 %).",
       report.quadric_depth_better.holds,
       "averages, sphere and quadric: " + report.quadric_depth_better.evidence});
  report.claims.push_back(
      {"With the sphere the corners cannot be matched, with the quadric they can (figs "
       "5.6 and 5.7).",
       report.corners_better.holds,
       "matched beyond 45 degrees, sphere and quadric: " + report.corners_better.evidence});
  report.claims.push_back({"Better surfaces than the paraboloid exist (chapter 6, future work).",
                           report.better_surfaces.holds,
                           "RMS of the rays by our fits of quadric, conic, asphere: " +
                               report.better_surfaces.evidence});
}

}  // namespace

ThesisEvaluation evaluateThesis(const ThesisEvaluationOptions& options) {
  if (!(options.scale >= 0.1 && options.scale <= 2.0)) {
    throw Error("--scale is " + fixed(options.scale, 3) + ", expected 0.1 to 2");
  }
  if (options.grid < 8 || options.grid > 400) {
    throw Error("--grid is " + std::to_string(options.grid) + ", expected 8 to 400");
  }
  const int threads = threadCount(options.threads);
  const std::vector<thesis::Shape> shapes = thesis::lensShapes(options.scale);
  const int step = std::max(4, static_cast<int>(options.grid * options.scale));
  Report report;
  report.progress = options.progress;
  report.stages = static_cast<double>(shapes.size()) * 7.0 + 1.0;
  thesis::chapter3(options.scale, threads, report);
  report.stage = 1.0;
  for (const thesis::Shape& shape : shapes) {
    LensRun run = findLenses(shape, threads, report);
    thesis::chapter4(run, threads, report);
    thesis::chapter5(run, step, threads, report);
    report.stage = std::ceil(report.stage - 1e-9);
    report.json["lenses"][shape.name] = run.json;
  }
  judge(report);
  ThesisEvaluation out;
  out.html = pageHead("Johnson 1997, measured again on simulated boards");
  out.html +=
      "<p>Numbers called \"thesis\" are those that K. B. Johnson measured with real cameras in "
      "1997; everything else was computed by this command. Errors of dewarping are in pixels of "
      "the dewarped plane with the scale of the image's middle.</p>\n<h2>Claims</h2>\n<table>\n" +
      row({"claim", "holds here", "by"}, "th");
  report.json["claims"] = thesis::Json::array();
  for (const thesis::Claim& claim : report.claims) {
    std::string evidence = claim.evidence;
    while (!evidence.empty() && (evidence.back() == ' ' || evidence.back() == ';')) {
      evidence.pop_back();
    }
    out.html += row({escaped(claim.text), claim.holds ? "yes" : "no", escaped(evidence)});
    report.json["claims"].push_back(
        {{"claim", claim.text}, {"holds", claim.holds}, {"by", evidence}});
  }
  out.html += "</table>\n" + report.body + "</body></html>\n";
  report.json["scale"] = options.scale;
  report.json["grid_px"] = options.grid;
  report.stage = report.stages;
  report.say("done");
  out.json = std::move(report.json);
  return out;
}

}  // namespace omnister::tools
