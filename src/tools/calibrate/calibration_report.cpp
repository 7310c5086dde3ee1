// SPDX-License-Identifier: Apache-2.0
#include "tools/calibrate/calibration_report.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <functional>
#include <memory>

#include "omnister/calibration/uncertainty.h"
#include "omnister/common/error.h"
#include "tools/report/html_plot.h"

namespace omnister::tools {
namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr int kSectors = 12;
constexpr int kRings = 6;

struct Point {
  Eigen::Vector2d pixel, residual;
};

std::string structureText(const LensStructure& structure) {
  std::string text = structure.model;
  if (structure.model == "asphere" && structure.even_terms > 0) {
    text += " r^" + std::to_string(2 + 2 * structure.even_terms);
  }
  if (structure.grid > 0) {
    const std::string side = std::to_string(structure.grid);
    text += ": asphere";
    if (structure.even_terms > 0) text += " r^" + std::to_string(2 + 2 * structure.even_terms);
    text += " + " + side + "x" + side + " grid";
  } else if (structure.model == "spline")
    text += ", " + std::to_string(structure.knots) + " knots";
  if (structure.affinity) text += " + affinity";
  if (structure.decentring) text += " + decentring";
  return text;
}

}  // namespace

std::string calibrationReport(const std::string& title, const Detections& detections,
                              const CalibrationResult& result, const ReportPictures& pictures) {
  const LensModel& lens = *result.file.lens;
  const cv::Size size = result.file.image_size;
  const Eigen::Vector2d center = lens.center();
  std::vector<Point> points;
  double largest = 0.0;
  double radius = 1.0;
  for (std::size_t v = 0; v < result.views.size() && v < detections.views.size(); ++v) {
    if (!result.views[v].used) continue;
    const auto& pixels = detections.views[v].pixels;
    for (std::size_t i = 0; i < pixels.size() && i < result.views[v].residuals.size(); ++i) {
      points.push_back({pixels[i], result.views[v].residuals[i]});
      radius = std::max(radius, (pixels[i] - center).norm());
      largest = std::max(largest, points.back().residual.norm());
    }
  }
  std::vector<double> lengths;
  for (const Point& point : points) lengths.push_back(point.residual.norm());
  std::sort(lengths.begin(), lengths.end());
  // The plots show all but the last hundredth; what lies beyond stands on their upper edge.
  const double top =
      lengths.empty() ? 1.0 : std::max(1e-6, 1.3 * lengths[lengths.size() * 99 / 100]);

  std::string html =
      pageHead(title) + verdictSection(result, pictures) + "<h2>Figures</h2>\n<table>\n";
  html += row({"lens", escaped(result.file.calibration.notes.count("structure")
                                   ? result.file.calibration.notes.at("structure")
                                   : std::string(lens.model()))});
  html += row({"RMS over all corners", fixed(result.rms_px, 4) + " px"});
  html += row({"RMS over unseen views",
               result.holdout_rms_px ? fixed(*result.holdout_rms_px, 4) + " px" : "not computed"});
  html += row({"corners", std::to_string(result.points)});
  html += row({"half field of view", fixed(lens.maxTheta() * 180 / kPi, 1) + " degrees"});
  html += row({"board warp", fixed(result.board_warp[0], 6) + ", " +
                                 fixed(result.board_warp[1], 6) + " board units"});
  html +=
      row({"height of the surface over its centre (R0)",
           fixed(result.height_px, 4) + " &plusmn; " + fixed(result.height_sigma_px, 4) + " px"});
  for (const DepthUncertainty& depth : result.depth_uncertainty) {
    html += row({"projection uncertainty at " + (std::isfinite(depth.distance)
                                                     ? fixed(depth.distance, 3) + " board units"
                                                     : std::string("infinity")),
                 fixed(depth.rms_px, 4) + " px RMS, at most " + fixed(depth.max_px, 4) + " px"});
  }
  if (result.bias_rms_px) {
    html += row({"difference from " + escaped(result.bias_against),
                 fixed(*result.bias_rms_px, 4) + " px RMS"});
  }
  if (result.stage) {
    const Eigen::Vector3d& axis = result.stage->axis;
    html += row({"axis of the stage", fixed(axis.x(), 6) + ", " + fixed(axis.y(), 6) + ", " +
                                          fixed(axis.z(), 6) + " &plusmn; " +
                                          fixed(result.stage->axis_sigma_rad, 6) + " rad"});
    html += row({"the stage's unit by the board's", fixed(result.stage->scale, 6) + " &plusmn; " +
                                                        fixed(result.stage->scale_sigma, 6)});
  }
  const auto names = lens.parameterNames();
  const Eigen::VectorXd values = lens.parameters();
  for (std::size_t i = 0; i < names.size(); ++i) {
    if (names[i].rfind("bend", 0) == 0) continue;  // a grid has hundreds
    const auto k = static_cast<Eigen::Index>(i);
    std::string value = fixed(values[k], 6);
    if (result.file.covariance)
      value += " &plusmn; " + fixed(std::sqrt((*result.file.covariance)(k, k)), 6);
    html += row({escaped(names[i]), value});
  }
  html += "</table>\n";
  if (!result.warnings.empty()) {
    html += "<h2>Warnings</h2><ul>\n";
    for (const std::string& warning : result.warnings)
      html += "<li>" + escaped(warning) + "</li>\n";
    html += "</ul>\n";
  }

  const auto figure = [&](const std::string& svg, const std::string& caption) {
    html += "<figure>" + asImage(svg) + "<figcaption>" + caption + "</figcaption></figure>\n";
  };
  html += "<h2>Residuals</h2>\n";
  const double height = 480.0 * size.height / size.width + 20.0;
  {
    Plot plot(520, height, 0, size.width, size.height, 0);
    const double gain = 0.03 * size.width / top;
    plot.color(0.1, 0.3, 0.8);
    for (const Point& point : points) {
      const Eigen::Vector2d tip = point.pixel + gain * point.residual;
      plot.line(point.pixel.x(), point.pixel.y(), tip.x(), tip.y());
    }
    figure(plot.finish("u [px]", "v [px]"),
           "Residual vectors, " + fixed(gain, 0) + " times their size");
  }
  {
    Plot plot(520, 300, 0, radius, 0, top);
    plot.color(0.1, 0.3, 0.8);
    for (const Point& point : points) {
      plot.dot((point.pixel - center).norm(), std::min(top, point.residual.norm()));
    }
    figure(plot.finish("radius [px]", "residual [px]"), "Residual against radius");
  }
  {
    Plot plot(520, 300, -180, 180, 0, top);
    plot.color(0.1, 0.3, 0.8);
    for (const Point& point : points) {
      const Eigen::Vector2d offset = point.pixel - center;
      plot.dot(std::atan2(offset.y(), offset.x()) * 180 / kPi,
               std::min(top, point.residual.norm()));
    }
    figure(plot.finish("azimuth [degrees]", "residual [px]"), "Residual against azimuth");
  }

  html += "<h2>Coverage and uncertainty</h2>\n";
  {
    std::array<std::array<int, kSectors>, kRings> counts{};
    int most = 1;
    for (const Point& point : points) {
      const Eigen::Vector2d offset = point.pixel - center;
      const int ring = std::min(kRings - 1, static_cast<int>(offset.norm() / radius * kRings));
      const double turn = std::atan2(offset.y(), offset.x()) / (2 * kPi) + 1.0;
      int& count = counts[ring][static_cast<int>(turn * kSectors) % kSectors];
      most = std::max(most, ++count);
    }
    Plot plot(520, 300, 0, kSectors, 0, kRings);
    for (int ring = 0; ring < kRings; ++ring) {
      for (int sector = 0; sector < kSectors; ++sector) {
        const double full = std::sqrt(counts[ring][sector] / static_cast<double>(most));
        plot.color(1 - 0.8 * full, 1 - 0.4 * full, 1 - 0.8 * full);
        plot.box(sector, ring, sector + 1, ring + 1);
        plot.color(0, 0, 0);
        plot.text(plot.x(sector + 0.3), plot.y(ring + 0.4), std::to_string(counts[ring][sector]));
      }
    }
    figure(plot.finish("sector of 30 degrees, from right over down", "ring of radius"),
           "Corners by radius and sector");
  }
  if (result.file.covariance) {
    const ProjectionField field = projectionUncertainty(lens, *result.file.covariance, size, 48);
    html += mapOverPicture(
        field, detections, pictures,
        "Projection uncertainty: RMS " + fixed(field.rms_px, 3) + " px, at most " +
            fixed(field.max_px, 3) + " px; no colour beyond the calibrated field" +
            (pictures.next.empty() ? "" : ". Outlined: where to hold the board next"));
  }
  {
    Plot plot(520, 300, 0, lens.maxTheta() * 180 / kPi, 0, radius * 1.1);
    plot.color(0.8, 0.2, 0.1);
    double last_theta = 0.0;
    double last_radius = 0.0;
    for (int i = 1; i <= 200; ++i) {
      const double theta = 0.9999 * lens.maxTheta() * i / 200.0;
      const auto pixel = lens.project({std::sin(theta), 0.0, std::cos(theta)});
      if (!pixel) break;
      const double r = (*pixel - center).norm();
      plot.line(last_theta, last_radius, theta * 180 / kPi, r);
      last_theta = theta * 180 / kPi;
      last_radius = r;
    }
    figure(plot.finish("angle off the axis [degrees]", "radius [px]"), "Lens profile along +x");
  }
  {
    // The surface stands over the pixels: each ray leaves through the point that lies at the height
    // h = r cot(theta) over its pixel (Johnson 1997, ch. 4).
    std::array<std::vector<Eigen::Vector2d>, 2> sections;
    double least = 0.0;
    double most = 0.0;
    for (int axis = 0; axis < 2; ++axis) {
      for (int i = -100; i <= 100; ++i) {
        const double r = radius * (i + 0.5) / 100.0;
        const auto ray = lens.unproject(center + r * Eigen::Vector2d::Unit(axis));
        if (!ray) continue;
        const double h = std::abs(r) * ray->z() / ray->head<2>().norm();
        sections[axis].emplace_back(r, h);
        least = std::min(least, h);
        most = std::max(most, h);
      }
    }
    Plot plot(520, 300, -radius, radius, 1.1 * least, 1.1 * most);
    for (int axis = 0; axis < 2; ++axis) {
      plot.color(axis == 0 ? 0.8 : 0.1, 0.2, axis == 0 ? 0.1 : 0.8);
      for (std::size_t i = 1; i < sections[axis].size(); ++i) {
        const Eigen::Vector2d& from = sections[axis][i - 1];
        const Eigen::Vector2d& to = sections[axis][i];
        plot.line(from.x(), from.y(), to.x(), to.y());
      }
    }
    figure(plot.finish("pixels from the centre of distortion", "height [px]"),
           "Lens surface, cut along x (red) and y (blue)");
  }

  html += "<h2>Models tried</h2>\n<table>\n" +
          row({"structure", "RMS [px]", "held-out RMS [px]"}, "th");
  for (const CandidateResult& candidate : result.candidates) {
    std::string line = row({escaped(structureText(candidate.structure)), fixed(candidate.rms_px, 4),
                            candidate.holdout_rms_px ? fixed(*candidate.holdout_rms_px, 4) : "-"});
    if (candidate.chosen) line.replace(0, 4, "<tr class=\"chosen\">");
    html += line;
  }
  html += "</table>\n<h2>Views</h2>\n<table>\n" +
          row({"view", "corners", "RMS [px]", "used", "why not"}, "th");
  for (const ViewResult& view : result.views) {
    html += row({escaped(view.name), std::to_string(view.residuals.size()),
                 view.used ? fixed(view.rms_px, 4) : "-", view.used ? "yes" : "no",
                 escaped(view.reason)});
  }
  return html + "</table>\n" + thumbnails(detections, result, pictures) + "</body></html>\n";
}

}  // namespace omnister::tools
