// SPDX-License-Identifier: Apache-2.0
// `evaluate board` and `evaluate pair`.
#include "tools/evaluate/evaluate_rig.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <opencv2/core.hpp>
#include <string>
#include <vector>

#include "omnister/calibration/lens_check.h"
#include "omnister/common/error.h"
#include "omnister/common/image_file.h"
#include "omnister/lens/lens_file.h"
#include "tools/calibrate/calibration_arguments.h"
#include "tools/cli/commands.h"
#include "tools/report/html_plot.h"

namespace omnister::tools {
namespace {

constexpr double kDegrees = 180.0 / M_PI;
/// A correction counts from this many standard deviations, and where it matters.
constexpr double kSignificant = 5.0;

struct BoardArguments {
  CalibrationArguments common;
  std::string lens;
  std::vector<std::string> images;
  std::string detections;
  double limit_px = 1.0;
};

/// Arrows of errors over the image.
std::string arrows(cv::Size size, const std::vector<Eigen::Vector2d>& pixels,
                   const std::vector<Eigen::Vector2d>& errors, double& gain) {
  std::vector<double> lengths;
  for (const auto& error : errors) lengths.push_back(error.norm());
  std::sort(lengths.begin(), lengths.end());
  const double top = lengths.empty() ? 1.0 : std::max(1e-6, lengths[lengths.size() * 95 / 100]);
  gain = 0.03 * size.width / top;
  Plot plot(520, 480.0 * size.height / size.width + 20.0, 0, size.width, size.height, 0);
  plot.color(0.1, 0.3, 0.8);
  for (std::size_t i = 0; i < pixels.size(); ++i) {
    const Eigen::Vector2d tip = pixels[i] + gain * errors[i];
    plot.line(pixels[i].x(), pixels[i].y(), tip.x(), tip.y());
    plot.dot(pixels[i].x(), pixels[i].y(), 1.0);
  }
  return asImage(plot.finish("u [px]", "v [px]"));
}

std::string againstRadius(const Eigen::Vector2d& center, const std::vector<Eigen::Vector2d>& pixels,
                          const std::vector<double>& errors, const std::string& name) {
  double radius = 1.0, top = 1e-6;
  for (std::size_t i = 0; i < pixels.size(); ++i) {
    radius = std::max(radius, (pixels[i] - center).norm());
    top = std::max(top, std::abs(errors[i]));
  }
  Plot plot(520, 300, 0, radius, *std::min_element(errors.begin(), errors.end()) < 0 ? -top : 0,
            top);
  plot.color(0.1, 0.3, 0.8);
  for (std::size_t i = 0; i < pixels.size(); ++i) {
    plot.dot((pixels[i] - center).norm(), errors[i]);
  }
  return asImage(plot.finish("radius [px]", name));
}

void runBoard(const BoardArguments& arguments, bool json) {
  const LensFile file = readLensFile(arguments.lens);
  CalibrationArguments common = arguments.common;
  common.size.width = file.image_size.width;
  common.size.height = file.image_size.height;
  const Detections boards = gatherDetections(common, arguments.images, arguments.detections, true);
  if (boards.image_size != file.image_size) {
    throw InputError(arguments.lens, "image_width",
                     "the lens is for images of " + std::to_string(file.image_size.width) + "x" +
                         std::to_string(file.image_size.height) + ", these have " +
                         std::to_string(boards.image_size.width) + "x" +
                         std::to_string(boards.image_size.height));
  }
  const BoardCheck check = checkBoards(*file.lens, boards);
  const double gain = check.rms_px > 0.0 ? 1.0 - check.corrected_rms_px / check.rms_px : 0.0;
  const bool scale_off = std::abs(std::log(check.scale)) > kSignificant * check.scale_sigma;
  const bool center_off =
      std::abs(check.center_shift.x()) > kSignificant * check.center_sigma.x() ||
      std::abs(check.center_shift.y()) > kSignificant * check.center_sigma.y();
  // A significant correction that lowers nothing to speak of is no drift.
  const bool drifted = gain > 0.02 && (scale_off || center_off);
  const std::string verdict =
      check.rms_px <= arguments.limit_px && !drifted ? "good"
      : drifted                                      ? "drifted: calibrate again"
                : "does not fit: is this the lens, the target file and the focus of these images?";

  nlohmann::ordered_json result;
  result["verdict"] = verdict;
  result["good"] = verdict == "good";
  result["rms_px"] = check.rms_px;
  result["median_px"] = check.median_px;
  if (file.calibration.rms_px) result["calibration_rms_px"] = *file.calibration.rms_px;
  result["corners"] = check.corners;
  result["scale"] = check.scale;
  result["scale_sigma"] = check.scale_sigma;
  result["center_shift_px"] = {check.center_shift.x(), check.center_shift.y()};
  result["center_sigma_px"] = {check.center_sigma.x(), check.center_sigma.y()};
  result["corrected_rms_px"] = check.corrected_rms_px;
  result["views"] = nlohmann::ordered_json::array();
  for (const BoardCheck::View& view : check.views) {
    nlohmann::ordered_json entry;
    entry["name"] = view.name;
    entry["corners"] = view.residuals.size();
    if (!view.residuals.empty()) entry["rms_px"] = view.rms_px;
    if (!view.reason.empty()) entry["not_used"] = view.reason;
    result["views"].push_back(entry);
  }
  if (!common.report_folder.empty()) {
    std::vector<Eigen::Vector2d> pixels, errors;
    std::vector<double> sizes;
    for (std::size_t v = 0; v < check.views.size(); ++v) {
      for (std::size_t i = 0; i < check.views[v].residuals.size(); ++i) {
        pixels.push_back(boards.views[v].pixels[i]);
        errors.push_back(check.views[v].residuals[i]);
        sizes.push_back(errors.back().norm());
      }
    }
    double times = 1.0;
    const std::string vectors = arrows(file.image_size, pixels, errors, times);
    std::string html = pageHead("Lens against boards: " + verdict) + "<table>\n";
    html += row({"RMS", fixed(check.rms_px, 3) + " px"}) +
            row({"median", fixed(check.median_px, 3) + " px"}) +
            row({"when it was calibrated", file.calibration.rms_px
                                               ? fixed(*file.calibration.rms_px, 3) + " px"
                                               : std::string("-")}) +
            row({"surface scale that fits best",
                 fixed(check.scale, 5) + " &plusmn; " + fixed(check.scale_sigma, 5)}) +
            row({"shift of the centre that fits best",
                 fixed(check.center_shift.x(), 2) + ", " + fixed(check.center_shift.y(), 2) +
                     " px &plusmn; " + fixed(check.center_sigma.x(), 2) + ", " +
                     fixed(check.center_sigma.y(), 2)}) +
            row({"RMS with both", fixed(check.corrected_rms_px, 3) + " px"}) + "</table>\n";
    html += figure(vectors, "Residuals, " + fixed(times, 0) + " times their size");
    html += figure(againstRadius(file.lens->center(), pixels, sizes, "residual [px]"),
                   "Residual against radius");
    html += "<table>\n" + row({"view", "corners", "RMS [px]", "not used"}, "th");
    for (const BoardCheck::View& view : check.views) {
      html += row({escaped(view.name), std::to_string(view.residuals.size()),
                   view.residuals.empty() ? "-" : fixed(view.rms_px, 3), escaped(view.reason)});
    }
    writeReport(common.report_folder, "report.html", html + "</table>\n</body></html>\n");
  }
  printResult(json, result);
}

struct PairArguments {
  std::string lens, lens_displaced, reference, displaced, pose, report;
  double limit_px = 1.0;
};

void runPair(const PairArguments& arguments, bool json) {
  const LensFile reference_lens = readLensFile(arguments.lens);
  const LensFile displaced_lens =
      arguments.lens_displaced.empty() ? reference_lens : readLensFile(arguments.lens_displaced);
  const Pose pose = parsePose(arguments.pose, "--pose");
  const auto load = [](const std::string& path, const LensFile& lens,
                       const std::string& lens_path) {
    cv::Mat image = readImage(path, ImageColor::kGray);
    if (image.size() != lens.image_size) {
      throw InputError(path, "",
                       "has " + std::to_string(image.cols) + "x" + std::to_string(image.rows) +
                           " pixels, the lens " + printable(lens_path) + " is for " +
                           std::to_string(lens.image_size.width) + "x" +
                           std::to_string(lens.image_size.height));
    }
    if (image.depth() != CV_8U) cv::normalize(image, image, 0, 255, cv::NORM_MINMAX, CV_8U);
    return image;
  };
  const cv::Mat reference = load(arguments.reference, reference_lens, arguments.lens);
  const cv::Mat displaced =
      load(arguments.displaced, displaced_lens,
           arguments.lens_displaced.empty() ? arguments.lens : arguments.lens_displaced);
  const PairCheck check =
      checkPair(*reference_lens.lens, reference, *displaced_lens.lens, displaced, pose);
  bool turned = false;
  for (int k = 0; k < 3; ++k) {
    turned = turned || std::abs(check.turn[k]) > kSignificant * check.turn_sigma[k];
  }
  const bool drifted = turned && check.corrected_median_px < 0.8 * check.median_px &&
                       check.median_px > 0.25 * arguments.limit_px;
  const double share = static_cast<double>(check.inliers) / check.matches.size();
  const std::string verdict =
      drifted ? "the pose has drifted: calibrate the pair again"
      : check.median_px <= arguments.limit_px && share > 0.5
          ? "good"
          : "does not fit: are these the lenses and the pose of the images?";

  nlohmann::ordered_json result;
  result["verdict"] = verdict;
  result["good"] = verdict == "good";
  result["matches"] = check.matches.size();
  result["inliers"] = check.inliers;
  result["median_px"] = check.median_px;
  result["rms_px"] = check.rms_px;
  result["turn_deg"] = {check.turn.x() * kDegrees, check.turn.y() * kDegrees,
                        check.turn.z() * kDegrees};
  result["turn_sigma_deg"] = {check.turn_sigma.x() * kDegrees, check.turn_sigma.y() * kDegrees,
                              check.turn_sigma.z() * kDegrees};
  result["corrected_median_px"] = check.corrected_median_px;
  // Over the field: medians by ring of the reference image.
  std::vector<Eigen::Vector2d> pixels, errors;
  std::vector<double> signed_errors;
  std::vector<std::vector<double>> rings(18);
  for (const PairCheck::Match& match : check.matches) {
    if (!match.inlier) continue;
    pixels.push_back(match.reference);
    errors.emplace_back(0.0, match.residual_px);
    signed_errors.push_back(match.residual_px);
    const auto ray = reference_lens.lens->unproject(match.reference);
    if (!ray) continue;
    const double theta = std::atan2(ray->head<2>().norm(), ray->z()) * kDegrees;
    rings[std::min<std::size_t>(17, static_cast<std::size_t>(theta / 10.0))].push_back(
        std::abs(match.residual_px));
  }
  result["bands"] = nlohmann::ordered_json::array();
  std::string bands = "<table>\n" + row({"off axis [deg]", "matches", "median [px]"}, "th");
  for (std::size_t i = 0; i < rings.size(); ++i) {
    if (rings[i].empty()) continue;
    std::nth_element(rings[i].begin(),
                     rings[i].begin() + static_cast<std::ptrdiff_t>(rings[i].size() / 2),
                     rings[i].end());
    const double middle = rings[i][rings[i].size() / 2];
    nlohmann::ordered_json band;
    band["from_deg"] = 10 * i;
    band["to_deg"] = 10 * (i + 1);
    band["matches"] = rings[i].size();
    band["median_px"] = middle;
    result["bands"].push_back(band);
    bands += row({std::to_string(10 * i) + " to " + std::to_string(10 * (i + 1)),
                  std::to_string(rings[i].size()), fixed(middle, 3)});
  }
  if (!arguments.report.empty()) {
    double times = 1.0;
    const std::string vectors = arrows(reference_lens.image_size, pixels, errors, times);
    std::string html = pageHead("Pair against lenses and pose: " + verdict) + "<table>\n";
    html += row({"matches near their epipolar curves",
                 std::to_string(check.inliers) + " of " + std::to_string(check.matches.size())}) +
            row({"median distance from the curve", fixed(check.median_px, 3) + " px"}) +
            row({"turn of the displaced camera that fits best [deg]",
                 fixed(check.turn.x() * kDegrees, 3) + ", " + fixed(check.turn.y() * kDegrees, 3) +
                     ", " + fixed(check.turn.z() * kDegrees, 3) + " &plusmn; " +
                     fixed(check.turn_sigma.x() * kDegrees, 3) + ", " +
                     fixed(check.turn_sigma.y() * kDegrees, 3) + ", " +
                     fixed(check.turn_sigma.z() * kDegrees, 3)}) +
            row({"median with that turn", fixed(check.corrected_median_px, 3) + " px"}) +
            "</table>\n";
    html += figure(vectors, "Distance from the epipolar curve, drawn upright, " + fixed(times, 0) +
                                " times its size");
    html +=
        figure(againstRadius(reference_lens.lens->center(), pixels, signed_errors, "distance [px]"),
               "Distance against radius in the reference image");
    writeReport(arguments.report, "report.html", html + bands + "</table>\n</body></html>\n");
  }
  printResult(json, result);
}

}  // namespace

void addBoard(CLI::App& evaluate) {
  CLI::App* command =
      evaluate.add_subcommand("board", "Is a lens still true? Images of a board against it");
  const auto arguments = std::make_shared<BoardArguments>();
  command->add_option("--lens", arguments->lens, "Lens file to check")->required();
  command->add_option("--target", arguments->common.target_file, "TARGET.yaml of the board");
  command->add_option("images", arguments->images, "Images of the board (with --target)");
  command->add_option("--detections", arguments->detections,
                      "Corners as CSV: view,u_px,v_px,x_m,y_m,z_m, instead of images");
  command->add_option("--limit", arguments->limit_px, "Largest RMS that is still good [px]")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command->add_option("--report", arguments->common.report_folder, "Folder for an HTML report");
  command->add_option("--threads", arguments->common.threads, "Threads; 0: every core")
      ->check(CLI::Range(0, 1024));
  bool& json = addJsonFlag(*command);
  command->footer(
      "Only the boards' poses are fitted. scale and center_shift_px are the correction of the lens "
      "that the corners would like best (rays (x, y, scale h)); drift is a correction beyond five "
      "standard deviations that lowers the RMS by 2 % or more.");
  command->callback([arguments, &json] {
    const bool from_file = !arguments->detections.empty();
    if (from_file == !arguments->images.empty()) {
      throw CLI::ValidationError("board", from_file ? "takes images or --detections, not both"
                                                    : "needs images or --detections FILE.csv");
    }
    if (!from_file && arguments->common.target_file.empty()) {
      throw CLI::ValidationError("--target", "is needed with images");
    }
    runBoard(*arguments, json);
  });
}

void addPair(CLI::App& evaluate) {
  CLI::App* command = evaluate.add_subcommand(
      "pair",
      "Are lenses and pose of two cameras or positions still true? Two images against them");
  const auto arguments = std::make_shared<PairArguments>();
  command->add_option("--lens", arguments->lens, "Lens file of the reference image")->required();
  command->add_option("--lens-displaced", arguments->lens_displaced,
                      "Lens file of the displaced image; the same where not given");
  command->add_option("--reference", arguments->reference, "Reference image")->required();
  command->add_option("--displaced", arguments->displaced, "Displaced image")->required();
  command->add_option("--pose", arguments->pose, "T_ref_disp as \"tx ty tz qx qy qz qw\" [m]")
      ->required();
  command->add_option("--limit", arguments->limit_px, "Largest median that is still good [px]")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  command->add_option("--report", arguments->report, "Folder for an HTML report");
  bool& json = addJsonFlag(*command);
  command->footer(
      "Features are matched between the distorted images; their distances from the epipolar curves "
      "tell, over the field, whether lenses and pose are still true.");
  command->callback([arguments, &json] { runPair(*arguments, json); });
}

}  // namespace omnister::tools
