// SPDX-License-Identifier: Apache-2.0
#include "tools/calibrate/procedure_command.h"

#include <chrono>
#include <cmath>

#include "omnister/calibration/thesis_procedures.h"
#include "omnister/common/error.h"
#include "omnister/common/image_file.h"
#include "omnister/common/numbers.h"

namespace omnister::tools {
namespace {

using nlohmann::ordered_json;

/// "x y" or "x,y,width,height".
std::vector<double> numbersOf(const std::string& text, std::size_t count, const std::string& option,
                              const std::string& expected) {
  const auto numbers = parseNumbers(text);
  bool good = numbers && numbers->size() == count;
  for (std::size_t i = 0; good && i < count; ++i) good = std::abs((*numbers)[i]) <= 1e6;
  if (!good) {
    throw CLI::ValidationError(option, "is '" + printable(text, 60) + "', expected " + expected);
  }
  return *numbers;
}

ProcedureOptions procedureOptions(const ProcedureArguments& arguments) {
  ProcedureOptions options;
  if (!arguments.center.empty()) {
    const auto numbers = numbersOf(arguments.center, 2, "--center", "\"x y\" in pixels");
    options.center = Eigen::Vector2d(numbers[0], numbers[1]);
  }
  if (!arguments.sweep.empty()) {
    const auto numbers = numbersOf(arguments.sweep, 2, "--sweep", "\"MIN MAX\" in pixels");
    if (!(numbers[0] > 0.0) || !(numbers[1] > numbers[0])) {
      throw CLI::ValidationError("--sweep", "is '" + printable(arguments.sweep, 60) +
                                                "', expected 0 < MIN < MAX in pixels");
    }
    options.min_radius = numbers[0];
    options.max_radius = numbers[1];
  }
  return options;
}

cv::Rect roiOf(const std::string& text) {
  const auto n = numbersOf(text, 4, "--roi", "x,y,width,height in whole pixels");
  for (std::size_t i = 0; i < 4; ++i) {
    if (n[i] != std::floor(n[i]) || n[i] < (i < 2 ? 0 : 1)) {
      throw CLI::ValidationError(
          "--roi", "is '" + printable(text, 60) + "', expected x,y,width,height in whole pixels");
    }
  }
  return {static_cast<int>(n[0]), static_cast<int>(n[1]), static_cast<int>(n[2]),
          static_cast<int>(n[3])};
}

/// Every region of every image is one line.
Detections edgesOf(const std::vector<std::string>& images, const std::vector<std::string>& rois) {
  std::vector<cv::Rect> regions;
  for (const std::string& roi : rois) regions.push_back(roiOf(roi));
  if (regions.empty()) regions.emplace_back();
  Detections lines;
  for (const std::string& path : images) {
    const cv::Mat image = readImage(path);
    if (lines.image_size.empty()) lines.image_size = image.size();
    if (image.size() != lines.image_size) {
      throw InputError(path, "",
                       "is " + std::to_string(image.cols) + "x" + std::to_string(image.rows) +
                           " pixels, expected " + std::to_string(lines.image_size.width) + "x" +
                           std::to_string(lines.image_size.height) + " as the images before");
    }
    for (std::size_t i = 0; i < regions.size(); ++i) {
      ViewDetections& line = lines.views.emplace_back();
      line.name = path;
      if (!rois.empty()) line.name += " " + rois[i];
      try {
        line.pixels = findEdgePixels(image, regions[i]);
      } catch (const Error& error) {
        throw InputError(path, rois.empty() ? "" : "--roi " + rois[i], error.what());
      }
    }
  }
  return lines;
}

ordered_json pair(const Eigen::Vector2d& value) {
  return ordered_json::array({value.x(), value.y()});
}

void addCenter(ordered_json& json, const CenterOfDistortion& center, bool given) {
  json["center"] = pair(center.center);
  json["center_method"] = given ? "given" : "azimuth invariability (after Basu and Licardie 1995)";
  json["center_sigma_px"] = pair(center.sigma);
  json["azimuth_rms_px"] = center.rms_px;
}

void addDewarpError(ordered_json& json, const DewarpError& error) {
  json["dewarp_error_px"] = {{"mean", error.mean_px}, {"min", error.min_px}, {"max", error.max_px}};
}

/// The figures that every calibration reports, and the file.
void finish(ordered_json& json, const LensFile& file, std::size_t views, std::size_t used,
            const std::vector<std::string>& warnings, const std::string& out) {
  json["views"] = views;
  json["views_used"] = used;
  json["points"] = *file.calibration.points;
  json["max_theta_rad"] = file.lens->maxTheta();
  json["r0_observable"] = false;
  json["r0_remark"] = file.calibration.notes.at("r0_remark");
  json["warnings"] = warnings;
  for (const std::string& warning : warnings) say("warning: " + printable(warning, 1000));
  if (!out.empty()) writeLensFile(out, file);
}

ordered_json begin(const std::string& procedure, const std::string& model) {
  return {
      {"procedure", procedure}, {"model", model}, {"rms_px", nullptr}, {"holdout_rms_px", nullptr}};
}

ordered_json runLines(const Detections& lines, const ProcedureOptions& options,
                      const std::string& out) {
  const LineRadius result = calibrateByLines(lines, options);
  ordered_json json = begin("lines", "spherical");
  json["center"] = pair(result.file.lens->center());
  json["center_method"] = options.center ? "given" : "middle of the image";
  json["radius_px"] = result.radius;
  json["radius_spread_px"] = result.spread;
  std::size_t used = 0;
  for (const LineRadius::Line& line : result.lines) {
    ordered_json entry{{"name", line.name}, {"points", line.points}, {"radius_px", nullptr}};
    if (line.radius) {
      entry["radius_px"] = *line.radius;
      entry["mean_absolute_deviation_px"] = line.deviation_px;
      ++used;
    } else {
      entry["reason"] = line.reason;
    }
    json["lines"].push_back(std::move(entry));
  }
  finish(json, result.file, result.lines.size(), used, result.warnings, out);
  return json;
}

ordered_json runDots(const ViewDetections& view, cv::Size size, const ProcedureOptions& options,
                     const std::string& out) {
  const DotRadius result = calibrateByDots(view, size, options);
  ordered_json json = begin("dots", "spherical");
  json["rms_px"] = result.rms_px;
  addCenter(json, result.center, options.center.has_value());
  json["radius_px"] = result.best.radius;
  json["radius_x_px"] = result.best_x.radius;
  json["radius_y_px"] = result.best_y.radius;
  json["error_x_px"] = result.best_x.error_x;
  json["error_y_px"] = result.best_y.error_y;
  json["error_combined_px"] = result.best.combined;
  addDewarpError(json, result.error);
  for (const SweepStep& step : result.sweep) {
    json["sweep"].push_back({step.radius, step.error_x, step.error_y, step.combined});
  }
  finish(json, result.file, 1, 1, result.warnings, out);
  return json;
}

ordered_json runQuadric(const ViewDetections& view, cv::Size size, const ProcedureOptions& options,
                        const std::string& out) {
  const QuadricProcedure result = calibrateQuadric(view, size, options);
  ordered_json json = begin("quadric", "quadric");
  json["rms_px"] = result.rms_px;
  addCenter(json, result.center, options.center.has_value());
  json["pixels_per_unit"] = result.pixels_per_unit;
  json["R0_px"] = result.R0;
  json["slope_u"] = result.slope_u;
  json["slope_v"] = result.slope_v;
  json["inverse_a2"] = result.inverse_a2;
  json["inverse_b2"] = result.inverse_b2;
  json["r_squared_x"] = result.r_squared_x;
  json["r_squared_y"] = result.r_squared_y;
  json["row_points"] = result.row_points;
  json["column_points"] = result.column_points;
  addDewarpError(json, result.error);
  finish(json, result.file, 1, 1, result.warnings, out);
  return json;
}

}  // namespace

void addProcedureArguments(CLI::App& command, ProcedureArguments& arguments) {
  command
      .add_option("--procedure", arguments.name,
                  "A procedure of Johnson 1997 in place of the fit, to compare with: lines (radius "
                  "from straight edges), dots (radius from one board square to the axis), quadric "
                  "(paraboloid from such a board). R0 is not observable with any of them")
      ->check(CLI::IsMember({"lines", "dots", "quadric"}));
  command.add_option(
      "--center", arguments.center,
      "With --procedure: centre of distortion \"x y\" [px] (lines: default the middle "
      "of the image; else found)");
  command.add_option("--sweep", arguments.sweep,
                     "With --procedure lines or dots: least and largest radius \"MIN MAX\" [px]");
  command
      .add_option("--roi", arguments.rois,
                  "With --procedure lines: region x,y,width,height that holds one edge; "
                  "repeatable")
      ->expected(1)
      ->take_all();
}

void runProcedure(const ProcedureArguments& arguments, const CalibrationArguments& common,
                  const std::vector<std::string>& images, const std::string& detections_file,
                  const std::string& out, bool json) {
  const auto start = std::chrono::steady_clock::now();
  const bool lines = arguments.name == "lines";
  if (!lines && !arguments.rois.empty()) {
    throw CLI::ValidationError("--roi", "goes with --procedure lines only");
  }
  if (common.model != "auto" || common.folds != 0 || !common.report_folder.empty()) {
    throw CLI::ValidationError("--procedure",
                               "takes no --model, --folds or --report: it is a fit of its own");
  }
  const ProcedureOptions options = procedureOptions(arguments);
  ordered_json result;
  if (lines) {
    // From a file, each view is a line; its board columns are not used.
    result = runLines(images.empty() ? gatherDetections(common, images, detections_file, false)
                                     : edgesOf(images, arguments.rois),
                      options, out);
  } else {
    const Detections detections = gatherDetections(common, images, detections_file, false);
    if (detections.views.size() != 1) {
      throw Error("--procedure " + arguments.name +
                  " takes one view of a board square to the "
                  "optical axis, found " +
                  std::to_string(detections.views.size()));
    }
    const ViewDetections& view = detections.views.front();
    result = arguments.name == "dots" ? runDots(view, detections.image_size, options, out)
                                      : runQuadric(view, detections.image_size, options, out);
  }
  result["seconds"] =
      std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  printResult(json, result);
}

}  // namespace omnister::tools
