// SPDX-License-Identifier: Apache-2.0
// `omnister calibrate-scan`: lens and stage axis from an ordinary scene, no target.
#include <algorithm>
#include <cmath>
#include <memory>
#include <opencv2/core.hpp>
#include <string>
#include <vector>

#include "omnister/calibration/target_free.h"
#include "omnister/common/error.h"
#include "omnister/common/image_file.h"
#include "omnister/common/numbers.h"
#include "omnister/device/replay_camera.h"
#include "tools/cli/commands.h"

namespace omnister::tools {
namespace {

struct Arguments {
  std::vector<std::string> scans;
  std::string model = "auto";
  int even_terms = 2;
  std::string known_angle;
  std::string board_detections;
  int features = 2000;
  bool accept_free_scale = false;
  std::string out;
  int threads = 0;
};

StageScan readScan(const std::string& path) {
  const device::Recording recording = device::readRecording(path);
  StageScan scan;
  for (const auto& frame : recording.frames) {
    if (!frame.stage_position_m) {
      throw InputError(path, frame.image.filename().string(),
                       "has no stage_position_m, expected one for every frame of a scan");
    }
    cv::Mat image = readImage(frame.image, ImageColor::kGray);
    // Features need no more than 8 bits, but all that the image has of them.
    if (image.depth() != CV_8U) cv::normalize(image, image, 0, 255, cv::NORM_MINMAX, CV_8U);
    scan.images.push_back(image);
    scan.positions_m.push_back(*frame.stage_position_m);
  }
  return scan;
}

KnownAngle parseKnownAngle(const std::string& text) {
  const auto numbers = parseNumbers(text);
  if (!numbers || numbers->size() != 5 || !((*numbers)[4] > 0.0 && (*numbers)[4] < 180.0)) {
    throw InputError("--known-angle", "",
                     "\"" + printable(text) +
                         "\" is not \"u1 v1 u2 v2 degrees\" with an angle between 0 and 180");
  }
  const auto& n = *numbers;
  return {{n[0], n[1]}, {n[2], n[3]}, n[4] * M_PI / 180.0};
}

const char* nameOf(SurfaceScale scale) {
  switch (scale) {
    case SurfaceScale::kRotatedScans:
      return "rotated scans";
    case SurfaceScale::kBoard:
      return "board";
    case SurfaceScale::kKnownAngle:
      return "known angle";
    case SurfaceScale::kFree:
      break;
  }
  return "free";
}

void run(const Arguments& arguments, bool json) {
  checkOutputs({arguments.board_detections}, {arguments.out});
  TargetFreeOptions options;
  options.grow = arguments.model == "auto";
  options.structure.model = options.grow ? "asphere" : arguments.model;
  options.structure.even_terms = arguments.model == "conic" ? 0 : arguments.even_terms;
  options.threads = arguments.threads;
  options.progress = consoleProgress();
  if (!arguments.known_angle.empty()) options.known_angle = parseKnownAngle(arguments.known_angle);
  std::vector<StageScan> scans;
  for (const std::string& path : arguments.scans) scans.push_back(readScan(path));
  if (!arguments.board_detections.empty()) {
    options.boards = readDetections(arguments.board_detections, scans[0].images[0].size());
  }
  TrackingOptions tracking;
  tracking.features_per_scan = arguments.features;
  tracking.threads = arguments.threads;
  TargetFreeResult result = calibrateTargetFree(scans, tracking, options);
  for (const std::string& warning : result.warnings) say("omnister: " + warning);
  if (result.scale == SurfaceScale::kFree && !arguments.accept_free_scale) {
    throw Error(
        "one scale of the surface is not observable, so no lens file is written (scan again with "
        "the rig turned by 15 degrees or more, add a tilted board with --board-detections or an "
        "angle with --known-angle, or accept a lens that is not metric with "
        "--accept-free-scale)");
  }
  result.file.calibration.notes["method"] = "target-free stage scans";
  result.file.calibration.notes["surface_scale"] = nameOf(result.scale);
  if (!arguments.out.empty()) writeLensFile(arguments.out, result.file);

  const Eigen::Vector3d& axis = *result.file.stage_axis;
  nlohmann::ordered_json output;
  output["model"] = result.file.lens->model();
  output["rms_px"] = result.rms_px;
  output["scans"] = scans.size();
  output["scans_joined"] = std::count(result.joined.begin(), result.joined.end(), true);
  output["points"] = result.points;
  output["observations"] = result.observations;
  output["max_theta_rad"] = result.file.lens->maxTheta();
  output["stage_axis"] = {axis.x(), axis.y(), axis.z()};
  output["scale_observable"] = result.scale != SurfaceScale::kFree;
  output["scale_from"] = nameOf(result.scale);
  output["scale_sigma"] = result.scale_sigma;
  output["warnings"] = result.warnings;
  printResult(json, output);
}

}  // namespace

void addCalibrateScan(CLI::App& app) {
  CLI::App* command = app.add_subcommand("calibrate-scan",
                                         "Fit a lens surface and the stage axis from images of an "
                                         "ordinary scene at known stage positions");
  const auto arguments = std::make_shared<Arguments>();
  const bool& json = addJsonFlag(*command);
  command
      ->add_option(
          "scans", arguments->scans,
          "Folders with a replay.yaml that gives every image its stage_position_m; the rig may "
          "be turned between folders, not within one")
      ->required();
  command
      ->add_option("--model", arguments->model,
                   "Radial lens model; auto: an asphere, or more where the images ask for it")
      ->check(CLI::IsMember({"auto", "conic", "asphere"}))
      ->capture_default_str();
  command
      ->add_option("--even-terms", arguments->even_terms,
                   "Asphere: even terms beyond the conic to start from")
      ->check(CLI::Range(0, 3))
      ->capture_default_str();
  command->add_option("--known-angle", arguments->known_angle,
                      "\"u1 v1 u2 v2 degrees\": a measured angle between two pixels");
  command->add_option(
      "--board-detections", arguments->board_detections,
      "CSV of corners of a board seen by the same camera, tilted by 20 degrees or more");
  command->add_option("--features", arguments->features, "Features followed a scan")
      ->check(CLI::Range(100, 20000))
      ->capture_default_str();
  command->add_flag("--accept-free-scale", arguments->accept_free_scale,
                    "Write the lens even where one scale of its surface is not observable");
  command->add_option("--threads", arguments->threads, "Threads; 0: every core")
      ->check(CLI::Range(0, 1024));
  command->add_option("--out", arguments->out, "Lens file to write");
  command->callback([arguments, &json] { run(*arguments, json); });
}

}  // namespace omnister::tools
