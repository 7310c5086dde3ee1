// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <optional>

#include "omnister/view/view.h"
#include "tools/report/html_plot.h"
#include "tools/thesis/thesis_report.h"

namespace omnister::tools::thesis {
namespace {

/// Table 4.1.
std::vector<DewarpStatistics> dewarping(LensRun& run, Report& report) {
  const Shape& shape = run.shape;
  const Found& found = run.found;
  std::vector<DewarpStatistics> dewarped(found.models.size());
  report.body += "<h3>Table 4.1: dewarping</h3>\n<table>\n" +
                 row({"surface", "avg [px]", "max [px]", "min [px]", "avg [%]", "R0 [px]",
                      "R0 error", "rays, RMS [deg]", "rays, max [deg]"},
                     "th") +
                 row({"thesis: spherical", "18.5", "29.9", "3.74", "1.35", "-", "-", "-", "-"}) +
                 row({"thesis: quadric", "4.1", "11.7", "0.76", "0.253", "2405", "-", "-", "-"});
  for (std::size_t m = 0; m < found.models.size(); ++m) {
    const Model& model = found.models[m];
    Json entry;
    if (!model.lens) {
      report.body +=
          row({escaped(model.name), "failed: " + escaped(model.why), "", "", "", "", "", "", ""});
      entry["failed"] = model.why;
    } else {
      dewarped[m] = dewarpStatistics(shape, *model.lens, run.board);
      const DewarpStatistics& d = dewarped[m];
      report.body +=
          row({escaped(model.name), fixed(d.mean_px, 3), fixed(d.max_px, 3), fixed(d.min_px, 4),
               fixed(d.mean_percent, 4), fixed(d.R0, 1), percent(d.R0_error, 2),
               fixed(d.ray_rms_deg, 3), fixed(d.ray_max_deg, 3)});
      entry = {{"mean_px", d.mean_px},
               {"max_px", d.max_px},
               {"min_px", d.min_px},
               {"mean_percent", d.mean_percent},
               {"R0_px", d.R0},
               {"R0_error", d.R0_error},
               {"ray_rms_deg", d.ray_rms_deg},
               {"ray_max_deg", d.ray_max_deg}};
    }
    run.json["table_4_1"][model.name] = entry;
  }
  report.body += "</table>\n";
  report.stage += 1.0;
  const DewarpStatistics& sphere = dewarped[0];
  const DewarpStatistics& quadric = dewarped[1];
  const bool both = found.models[0].lens && found.models[1].lens;
  report.quadric_dewarps_better.require(both && quadric.mean_px < sphere.mean_px);
  report.quadric_dewarps_better.evidence +=
      shape.name + " " + fixed(sphere.mean_px, 1) + " and " + fixed(quadric.mean_px, 1) + " px; ";
  if (found.models[1].lens) {
    report.r0_wrong.require(std::abs(quadric.R0_error) > 0.02);
    report.r0_wrong.evidence += shape.name + " " + percent(quadric.R0_error, 1) + "; ";
  }
  if (found.models[3].lens && found.models[4].lens && found.models[2].lens) {
    report.better_surfaces.require(dewarped[4].ray_rms_deg < 0.2 * dewarped[2].ray_rms_deg &&
                                   dewarped[3].ray_rms_deg < dewarped[2].ray_rms_deg);
    report.better_surfaces.evidence += shape.name + " " + fixed(dewarped[2].ray_rms_deg, 3) + ", " +
                                       fixed(dewarped[3].ray_rms_deg, 3) + ", " +
                                       fixed(dewarped[4].ray_rms_deg, 4) + " degrees; ";
  }
  return dewarped;
}

/// Figs 4.9, 4.10, 4.11 and 4.13.
void surfaceFits(LensRun& run, Report& report) {
  const Shape& shape = run.shape;
  const Found& found = run.found;
  if (found.quadric) {
    const QuadricProcedure& q = *found.quadric;
    Plot plot(520, 300, 0, slopeOf(*shape.lens) * std::tan(kDewarpLimit), 0.5 * q.R0, 1.2 * q.R0);
    Plot heights(520, 300, -0.5 * shape.size.width, 0.5 * shape.size.width,
                 q.R0 - 0.5 * q.inverse_a2 * shape.size.width * shape.size.width * 0.5,
                 1.05 * q.R0);
    Range used;
    for (std::size_t i = 0; i < run.board.pixels.size(); ++i) {
      const Vector2d b = run.board.points[i].head<2>() - q.center.board_point;
      const bool on_row = std::abs(b.y()) < 1e-3 && std::abs(b.x()) > 1e-3;
      const bool on_column = std::abs(b.x()) < 1e-3 && std::abs(b.y()) > 1e-3;
      if (!on_row && !on_column) continue;
      const double u = q.pixels_per_unit * (on_row ? b.x() : b.y());
      const double x = on_row ? run.board.pixels[i].x() - q.center.center.x()
                              : run.board.pixels[i].y() - q.center.center.y();
      const double R = x * std::sqrt(u * u + q.R0 * q.R0) / u;  // eq. 4.22
      used.add(std::abs(u));
      plot.color(on_row ? 0.8 : 0.1, 0.2, on_row ? 0.1 : 0.8);
      plot.dot(std::abs(u), R, 2.0);
      const double beta = std::atan2(u, q.R0);  // eqs 4.24 and 4.25
      heights.color(on_row ? 0.8 : 0.1, 0.2, on_row ? 0.1 : 0.8);
      heights.dot(R * std::sin(beta), R * std::cos(beta), 2.0);
    }
    plot.color(0, 0, 0);
    plot.line(0, q.R0, used.high, q.R0 + q.slope_u * used.high);
    heights.color(0, 0, 0);
    for (int i = -50; i < 50; ++i) {
      const double a = 0.01 * i * shape.size.width;
      const double b = 0.01 * (i + 1) * shape.size.width;
      heights.line(a, q.R0 - q.inverse_a2 * a * a, b, q.R0 - q.inverse_a2 * b * b);
    }
    report.body +=
        figure(asImage(plot.finish("u, v [px]", "R(u), R(v) [px]")),
               "Fig. 4.9: radius of the surface along u (red) and v (blue) with the line of "
               "the fit, R0 = " +
                   fixed(q.R0, 0));
    report.body += figure(
        asImage(heights.finish("x, y [px]", "h [px]")),
        "Fig. 4.10: height along x (red) and y (blue); 1/a^2 = " + fixed(1e4 * q.inverse_a2, 4) +
            "e-4 (thesis 3.2215e-4), R^2 = " + fixed(q.r_squared_x, 4) +
            " (0.972); 1/b^2 = " + fixed(1e4 * q.inverse_b2, 4) +
            "e-4 (3.3610e-4), R^2 = " + fixed(q.r_squared_y, 4) + " (0.942)");
    run.json["fig_4_10"] = {{"R0", q.R0},
                            {"inverse_a2", q.inverse_a2},
                            {"inverse_b2", q.inverse_b2},
                            {"r_squared_x", q.r_squared_x},
                            {"r_squared_y", q.r_squared_y}};
    report.linear_fits.require(q.r_squared_x > 0.94 && q.r_squared_y > 0.94);
    report.linear_fits.evidence +=
        shape.name + " R^2 = " + fixed(q.r_squared_x, 3) + " and " + fixed(q.r_squared_y, 3) + "; ";
    // Fig. 4.13: the surface over the undistorted plane, spherical beside it.
    if (found.models[0].lens && found.models[1].lens) {
      const double reach = slopeOf(*shape.lens) * std::tan(kDewarpLimit);
      Plot surface(520, 300, -reach, reach, 0, 1.05 * q.R0);
      for (int m = 0; m < 2; ++m) {
        const LensModel& lens = *found.models[m].lens;
        surface.color(m == 0 ? 0.1 : 0.8, 0.2, m == 0 ? 0.8 : 0.1);
        std::optional<Vector2d> last;
        for (int i = -100; i <= 100; ++i) {
          const double u = reach * i / 100.0;
          const auto pixel = lens.project(Vector3d(u, 0, slopeOf(lens)));
          std::optional<Vector2d> now;
          if (pixel) {
            const Vector2d offset = *pixel - lens.center();
            if (const auto h = lens.surfaceHeight(offset.x(), offset.y())) now = Vector2d(u, *h);
          }
          if (now && last) surface.line(last->x(), last->y(), now->x(), now->y());
          last = now;
        }
      }
      report.body +=
          figure(asImage(surface.finish("u [px]", "h [px]")),
                 "Figs 4.11 and 4.13: height of the quadric (red) and the spherical surface "
                 "(blue) over the undistorted plane");
    }
  }
}

/// Fig. 4.15.
void dewarpedDots(const LensRun& run, const std::vector<DewarpStatistics>& dewarped,
                  Report& report) {
  const Found& found = run.found;
  for (int m = 0; m < kFiguredModels; ++m) {
    if (!found.models[m].lens) continue;
    report.body += figure(dewarpPlot(dewarped[m]),
                          "Fig. 4.15: dewarped dots (red) and true places "
                          "(black), " +
                              escaped(found.models[m].name));
  }
}

/// Figs 4.2, 4.5, 4.12 and 4.14.
void mappings(LensRun& run, int threads, Report& report) {
  const Shape& shape = run.shape;
  const Found& found = run.found;
  report.say(shape.name + ": pictures");
  const cv::Mat picture = boardPicture(shape, threads);
  report.body += figure(asImage(shrunk(picture, 520), 520), "The simulated dot board (fig. 4.8)");
  const char* forward_names[] = {"Fig. 4.2", "Fig. 4.12"};
  const char* backward_names[] = {"Fig. 4.5", "Fig. 4.14"};
  for (int m = 0; m < 2; ++m) {
    if (!found.models[m].lens) continue;
    const LensModel& lens = *found.models[m].lens;
    const Forward forward = forwardMap(lens, picture, kDewarpLimit);
    report.body += figure(asImage(forward.picture, 400),
                          std::string(forward_names[m]) + ": forward mapping, " +
                              escaped(found.models[m].name) + ", a part at full size; " +
                              percent(forward.gaps) + " of the dewarped pixels get nothing, " +
                              percent(forward.gaps_rim) + " beyond 45 degrees");
    run.json["forward_mapping"][found.models[m].name] = {{"gaps", forward.gaps},
                                                         {"gaps_beyond_45_deg", forward.gaps_rim}};
    ViewGeometry geometry = makeViewGeometry(Projection::kPinhole, {900, 620}, 2.0 * kDewarpLimit,
                                             Eigen::Matrix3d::Identity());
    // The same scale of the middle for every model, so that R0 does not change the picture.
    geometry.focal_px *= slopeOf(lens) / slopeOf(*shape.lens);
    const View view(lens, shape.size, geometry, true, threads);
    report.body += figure(
        asImage(shrunk(view.render(picture), 520), 520),
        std::string(backward_names[m]) + ": backward mapping, " + escaped(found.models[m].name));
  }
}

/// Fig. 5.1 and memory.
void memory(LensRun& run, Report& report) {
  const Shape& shape = run.shape;
  const Found& found = run.found;
  if (found.models[1].lens) {
    const ManyToOne many = manyToOne(*found.models[1].lens, shape.size);
    const double distorted = 2.0 * shape.size.area();
    const double full = 2.0 * many.dewarped_pixels;
    Plot plot(
        520, 260, 0, 1, 0,
        1.1 * std::max_element(many.by_radius.begin(), many.by_radius.end(),
                               [](const auto& a, const auto& b) { return a.second < b.second; })
                  ->second);
    plot.color(0.1, 0.3, 0.8);
    Json radii = Json::array();
    for (std::size_t i = 0; i < many.by_radius.size(); ++i) {
      plot.dot(many.by_radius[i].first, many.by_radius[i].second, 3.0);
      radii.push_back({many.by_radius[i].first, many.by_radius[i].second});
    }
    report.body +=
        figure(asImage(many.picture, 520),
               "Fig. 5.1: dewarped pixels that show one distorted pixel, quadric; white is " +
                   std::to_string(many.most) + " (thesis: up to 8)");
    report.body += figure(asImage(plot.finish("radius / half diagonal", "mean count")),
                          "Fig. 5.1: mean count against radius");
    report.body += "<table>\n" + row({"memory, two 8-bit images", "distorted", "dewarped"}, "th") +
                   row({"thesis", "12.5 MB", "42 MB"}) +
                   row({"here", fixed(distorted / 1e6, 1) + " MB",
                        fixed(full / 1e6, 1) + " MB (" + std::to_string(many.width) + "x" +
                            std::to_string(many.height) + " each)"}) +
                   "</table>\n";
    run.json["fig_5_1"] = {{"most", many.most}, {"mean_by_radius", radii}};
    run.json["memory_mb"] = {{"distorted", distorted / 1e6}, {"dewarped", full / 1e6}};
    double densest = 0.0;
    for (const auto& [radius, count] : many.by_radius) densest = std::max(densest, count);
    report.many_to_one.require(many.most >= 4 && full > 1.5 * distorted &&
                               densest > 1.5 * many.by_radius.front().second);
    report.many_to_one.evidence += shape.name + " up to " + std::to_string(many.most) + ", " +
                                   fixed(full / distorted, 1) + " times the memory; ";
  }
}

}  // namespace

void chapter4(LensRun& run, int threads, Report& report) {
  const std::vector<DewarpStatistics> dewarped = dewarping(run, report);
  surfaceFits(run, report);
  dewarpedDots(run, dewarped, report);
  mappings(run, threads, report);
  memory(run, report);
  report.stage += 1.0;
}

}  // namespace omnister::tools::thesis
