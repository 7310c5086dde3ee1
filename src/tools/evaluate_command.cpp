// SPDX-License-Identifier: Apache-2.0
#include <cmath>
#include <filesystem>
#include <memory>
#include <opencv2/core.hpp>
#include <string>

#include "commands.h"
#include "evaluate_rig.h"
#include "evaluate_thesis.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"
#include "omnister/stereo/cloud.h"
#include "omnister/stereo/plane_fit.h"

namespace omnister::tools {
namespace {

struct PlaneArguments {
  std::string cloud;
  std::string roi;
  double truth_height = 0.0;
  PlaneFitOptions options;
};

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
  constexpr double kDegrees = 180.0 / M_PI;
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
  nlohmann::ordered_json result;
  result["normal"] = {fit.normal.x(), fit.normal.y(), fit.normal.z()};
  result["distance_m"] = fit.distance;
  if (with_truth) {
    result["distance_error_m"] = fit.distance - arguments.truth_height;
    result["distance_error"] = fit.distance / arguments.truth_height - 1.0;
  }
  result["points"] = fit.all.points;
  result["density"] = static_cast<double>(fit.all.points) / roi.area();
  result["inliers"] = fit.all.inliers;
  result["rms_m"] = fit.all.rms;
  result["median_residual_m"] = fit.all.median_residual;
  result["median_range_error"] = fit.all.median_range_error;
  result["bands"] = nlohmann::ordered_json::array();
  for (const PlaneFitBand& band : fit.bands) result["bands"].push_back(describeBand(band));
  printResult(json, result);
}

void addPlane(CLI::App& evaluate) {
  CLI::App* command = evaluate.add_subcommand("plane", "Fit a plane to a cloud of something flat");
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
  bool& json = addJsonFlag(*command);
  command->footer(
      "distance_m: of the camera's centre from the plane. rms_m: of the inliers. median_residual_m "
      "and "
      "median_range_error (a share of the range): of all points. Bands are of the off-axis angle.");
  command->callback([arguments, truth, &json] { runPlane(*arguments, truth->count() > 0, json); });
}

void addThesis(CLI::App& evaluate) {
  CLI::App* command = evaluate.add_subcommand(
      "thesis", "The measurements of Johnson 1997 again, on simulated boards");
  struct Arguments {
    std::string out;
    ThesisEvaluationOptions options;
  };
  auto arguments = std::make_shared<Arguments>();
  command->add_option("--out", arguments->out, "Folder for index.html and thesis.json")
      ->required()
      ->type_name("DIR");
  command
      ->add_option("--scale", arguments->options.scale,
                   "Size of the images beside the thesis' 3060x2036; less is quicker")
      ->check(CLI::Range(0.1, 2.0))
      ->capture_default_str();
  command
      ->add_option("--grid", arguments->options.grid,
                   "Spacing of the pixels whose depth is measured, at full size [px]")
      ->check(CLI::Range(8, 400))
      ->capture_default_str();
  command->add_option("--threads", arguments->options.threads, "Threads; 0: every core")
      ->check(CLI::Range(0, 1024));
  bool& json = addJsonFlag(*command);
  command->callback([arguments, &json] {
    arguments->options.progress = consoleProgress();
    std::error_code error;
    std::filesystem::create_directories(arguments->out, error);
    if (error) throw IoError("create", arguments->out, error.value());
    const ThesisEvaluation evaluation = evaluateThesis(arguments->options);
    const std::filesystem::path folder(arguments->out);
    writeFileAtomically(folder / "thesis.json", evaluation.json.dump(2) + "\n");
    writeFileAtomically(folder / "index.html", evaluation.html);
    if (json) {
      printResult(true, evaluation.json);
      return;
    }
    nlohmann::ordered_json result;
    for (const auto& claim : evaluation.json.at("claims")) {
      result[claim.at("claim").get<std::string>()] =
          claim.at("holds").get<bool>() ? "holds" : "does not hold";
    }
    result["report"] = (folder / "index.html").string();
    printResult(false, result);
  });
}

}  // namespace

void addEvaluate(CLI::App& app) {
  CLI::App* command = app.add_subcommand("evaluate", "How good a result is");
  command->require_subcommand(1);
  addThesis(*command);
  addPlane(*command);
  addBoard(*command);
  addPair(*command);
}

}  // namespace omnister::tools
