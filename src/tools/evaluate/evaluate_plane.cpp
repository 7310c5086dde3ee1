// SPDX-License-Identifier: Apache-2.0
// `evaluate plane`.
#include "tools/evaluate/evaluate_plane.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <opencv2/core.hpp>
#include <string>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/stereo/cloud.h"
#include "omnister/stereo/plane_fit.h"
#include "tools/calibrate/calibration_arguments.h"
#include "tools/cli/commands.h"
#include "tools/report/html_plot.h"

namespace omnister::tools {
namespace {

constexpr double kDegrees = 180.0 / M_PI;

struct PlaneArguments {
  std::string cloud;
  std::string roi;
  std::string report;
  double truth_height = 0.0;
  double limit = 0.01;
  PlaneFitOptions options;
};

/// A part of the image, and how far its points lie beyond the plane, as a share of their range.
struct Cell {
  cv::Rect pixels;
  std::size_t points = 0;
  double error = 0.0;  ///< median; above 0 is too far
};

/// Cells of about a 24th of the width. Those with less than a fifth of their points are left out:
/// what they hold is the plane's edge, or chance.
std::vector<Cell> errorsOverField(const cv::Mat& xyz, const PlaneFit& fit) {
  const int side = std::max(4, (xyz.cols + 23) / 24);
  std::vector<Cell> cells;
  std::vector<double> errors;
  for (int top = 0; top < xyz.rows; top += side) {
    for (int left = 0; left < xyz.cols; left += side) {
      Cell cell;
      cell.pixels = cv::Rect(left, top, side, side) & cv::Rect(cv::Point(), xyz.size());
      errors.clear();
      for (int v = top; v < cell.pixels.br().y; ++v) {
        for (int u = left; u < cell.pixels.br().x; ++u) {
          const auto& p = xyz.at<cv::Vec3f>(v, u);
          if (std::isnan(p[0])) continue;
          const double height = -fit.normal.dot(Eigen::Vector3d(p[0], p[1], p[2]));
          errors.push_back(height / fit.distance - 1.0);
        }
      }
      cell.points = errors.size();
      if (5 * cell.points < static_cast<std::size_t>(cell.pixels.area())) continue;
      const auto middle = errors.begin() + static_cast<std::ptrdiff_t>(errors.size() / 2);
      std::nth_element(errors.begin(), middle, errors.end());
      cell.error = *middle;
      cells.push_back(cell);
    }
  }
  return cells;
}

std::string errorMap(const std::vector<Cell>& cells, cv::Size size, double full_colour) {
  Plot plot(520, 480.0 * size.height / size.width + 50.0, 0, size.width, size.height, 0);
  for (const Cell& cell : cells)
    plot.errorCell(cell.pixels.x, cell.pixels.y, cell.pixels.br().x, cell.pixels.br().y,
                   cell.error / full_colour);
  return asImage(plot.finish("u [px]", "v [px]"));
}

std::string errorByAngle(const PlaneFit& fit) {
  Range percent;
  percent.add(0.0);
  for (const PlaneFitBand& band : fit.bands) percent.add(100.0 * band.median_range_error);
  percent.widen();
  Plot plot(520, 300, 0, std::max(10.0, fit.bands.back().to_theta * kDegrees), 0, percent.high);
  plot.color(0.1, 0.3, 0.8);
  for (const PlaneFitBand& band : fit.bands)
    plot.dot(0.5 * kDegrees * (band.from_theta + band.to_theta), 100.0 * band.median_range_error,
             3);
  return asImage(plot.finish("angle off the axis [degrees]", "median range error [%]"));
}

std::string reportOf(const PlaneArguments& arguments, const std::string& verdict,
                     const PlaneFit& fit, const std::vector<Cell>& cells, double systematic,
                     cv::Size size) {
  std::string html = pageHead("Cloud against a plane: " + verdict) + "<table>\n";
  html += row({"distance of the camera from the plane", fixed(fit.distance, 4) + " m"}) +
          row({"points near the plane",
               std::to_string(fit.all.inliers) + " of " + std::to_string(fit.all.points)}) +
          row({"median distance from the plane", fixed(1e3 * fit.all.median_residual, 2) + " mm"}) +
          row({"median range error", fixed(100.0 * fit.all.median_range_error, 3) + " %"}) +
          row({"systematic range error", fixed(100.0 * systematic, 3) + " % (limit " +
                                             fixed(100.0 * arguments.limit, 2) + " %)"}) +
          "</table>\n";
  html +=
      figure(errorMap(cells, size, 2.0 * arguments.limit),
             "Range error over the image, medians; red is too far, blue too near, full colour " +
                 fixed(200.0 * arguments.limit, 1) + " %; no dot: no points");
  html += figure(errorByAngle(fit), "Median range error against the angle off the axis");
  html += "<table>\n" + row({"off axis [deg]", "points", "near the plane", "RMS of these [mm]",
                             "median distance [mm]", "median range error [%]"},
                            "th");
  for (const PlaneFitBand& band : fit.bands) {
    html +=
        row({fixed(band.from_theta * kDegrees, 0) + " to " + fixed(band.to_theta * kDegrees, 0),
             std::to_string(band.points), std::to_string(band.inliers), fixed(1e3 * band.rms, 2),
             fixed(1e3 * band.median_residual, 2), fixed(100.0 * band.median_range_error, 3)});
  }
  return html + "</table>\n</body></html>\n";
}

cv::Rect parseRoi(const std::string& text, cv::Size size) {
  const auto numbers = parseNumbers(text);
  bool good = numbers && numbers->size() == 4;
  for (std::size_t i = 0; good && i < 4; ++i) {
    const double value = (*numbers)[i];
    good = value >= (i < 2 ? 0.0 : 1.0) && value <= 65535.0 && value == std::floor(value);
  }
  cv::Rect roi;
  if (good) {
    roi = {static_cast<int>((*numbers)[0]), static_cast<int>((*numbers)[1]),
           static_cast<int>((*numbers)[2]), static_cast<int>((*numbers)[3])};
    good = roi.x + roi.width <= size.width && roi.y + roi.height <= size.height;
  }
  if (!good) {
    throw InputError("--roi", "",
                     "is '" + printable(text, 60) +
                         "', expected x,y,width,height in whole pixels inside the " +
                         std::to_string(size.width) + "x" + std::to_string(size.height) + " cloud");
  }
  return roi;
}

nlohmann::ordered_json describeBand(const PlaneFitBand& band) {
  nlohmann::ordered_json result;
  result["from_deg"] = std::round(band.from_theta * kDegrees);
  result["to_deg"] = std::round(band.to_theta * kDegrees);
  result["points"] = band.points;
  result["inliers"] = band.inliers;
  result["rms_m"] = band.rms;
  result["median_residual_m"] = band.median_residual;
  result["median_range_error"] = band.median_range_error;
  return result;
}

void runPlane(const PlaneArguments& arguments, bool with_truth, bool json) {
  if (with_truth && !(std::isfinite(arguments.truth_height) && arguments.truth_height > 0.0)) {
    throw Error("--truth-height is " + formatNumber(arguments.truth_height) +
                ", expected a positive number");
  }
  const Cloud cloud = readCloud(arguments.cloud);
  cv::Rect roi(cv::Point(), cloud.xyz.size());
  if (!arguments.roi.empty()) roi = parseRoi(arguments.roi, cloud.xyz.size());
  const PlaneFit fit = fitPlane(cloud.xyz(roi), arguments.options);
  const std::vector<Cell> cells = errorsOverField(cloud.xyz(roi), fit);
  std::vector<double> sizes;
  for (const Cell& cell : cells) sizes.push_back(std::abs(cell.error));
  std::sort(sizes.begin(), sizes.end());
  const double systematic = sizes.empty() ? NAN : sizes[(sizes.size() - 1) * 9 / 10];
  const double off = with_truth ? fit.distance / arguments.truth_height - 1.0 : 0.0;
  const std::string verdict =
      2 * fit.all.inliers < fit.all.points || !(systematic <= 3.0 * arguments.options.tolerance)
          ? "not flat: is it a plane that the cloud shows, and do the matches hold?"
      : systematic > arguments.limit ? "bent: calibrate lens and pose again"
      : std::abs(off) > arguments.limit
          ? "flat, but at another distance: is the baseline's length true?"
          : "good";

  nlohmann::ordered_json result;
  result["verdict"] = verdict;
  result["good"] = verdict == "good";
  result["systematic_range_error"] = systematic;
  result["normal"] = {fit.normal.x(), fit.normal.y(), fit.normal.z()};
  result["distance_m"] = fit.distance;
  if (with_truth) {
    result["distance_error_m"] = fit.distance - arguments.truth_height;
    result["distance_error"] = off;
  }
  result["points"] = fit.all.points;
  result["density"] = static_cast<double>(fit.all.points) / roi.area();
  result["inliers"] = fit.all.inliers;
  result["rms_m"] = fit.all.rms;
  result["median_residual_m"] = fit.all.median_residual;
  result["median_range_error"] = fit.all.median_range_error;
  result["bands"] = nlohmann::ordered_json::array();
  for (const PlaneFitBand& band : fit.bands) result["bands"].push_back(describeBand(band));
  if (!arguments.report.empty())
    writeReport(arguments.report, "report.html",
                reportOf(arguments, verdict, fit, cells, systematic, roi.size()));
  printResult(json, result);
}

}  // namespace

void addPlane(CLI::App& evaluate) {
  CLI::App* command = evaluate.add_subcommand(
      "plane", "Is depth true over the field? A cloud of something flat against a plane");
  auto arguments = std::make_shared<PlaneArguments>();
  command->add_option("--cloud", arguments->cloud, "Organized cloud, as `stereo` writes it")
      ->required()
      ->type_name("CLOUD.ply");
  command
      ->add_option("--roi", arguments->roi,
                   "Part of the image to look at, as x,y,width,height [px]")
      ->type_name("X,Y,W,H");
  CLI::Option* truth =
      command->add_option("--truth-height", arguments->truth_height,
                          "True distance of the camera from the plane, to compare with [m]");
  command
      ->add_option("--tolerance", arguments->options.tolerance,
                   "A point belongs to the plane within this share of its range")
      ->capture_default_str();
  command->add_option("--seed", arguments->options.seed, "Seed of the random search")
      ->capture_default_str();
  command
      ->add_option("--limit", arguments->limit,
                   "Largest systematic range error that is still good, as a share of the range")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command->add_option("--report", arguments->report, "Folder for an HTML report");
  bool& json = addJsonFlag(*command);
  command->footer(
      "systematic_range_error: nine tenths of the image's parts have medians within it (a share of "
      "the range). distance_m: of the camera's centre from the plane. rms_m: of the inliers. "
      "median_residual_m and median_range_error: of all points. Bands are of the off-axis angle.");
  command->callback([arguments, truth, &json] { runPlane(*arguments, truth->count() > 0, json); });
}

}  // namespace omnister::tools
