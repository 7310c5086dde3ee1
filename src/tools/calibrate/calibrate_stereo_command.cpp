// SPDX-License-Identifier: Apache-2.0
// `calibrate-stereo`: two rigidly joined cameras from pairs of images of a board.
#include <chrono>
#include <cmath>
#include <filesystem>
#include <map>
#include <memory>

#include "omnister/calibration/rig_file.h"
#include "omnister/common/error.h"
#include "omnister/common/image_file.h"
#include "tools/calibrate/calibration_arguments.h"
#include "tools/calibrate/calibration_report.h"

namespace omnister::tools {
namespace {

struct Arguments {
  CalibrationArguments common;
  std::vector<std::string> left_images, right_images;
  std::string left_detections, right_detections;
  std::string out_left, out_right, out_rig;
  bool* json = nullptr;
};

/// Brings views of one name to one index; a view that only one camera has stays empty in the other.
void pairByName(Detections& left, Detections& right) {
  std::map<std::string, std::size_t> place;
  Detections joined;
  joined.image_size = right.image_size;
  for (const ViewDetections& view : left.views) {
    place[view.name] = joined.views.size();
    joined.views.emplace_back().name = view.name;
  }
  bool any = false;
  for (ViewDetections& view : right.views) {
    const auto found = place.find(view.name);
    if (found != place.end()) {
      joined.views[found->second] = std::move(view);
      any = true;
    } else {
      left.views.emplace_back().name = view.name;
      joined.views.push_back(std::move(view));
    }
  }
  if (!any) throw Error("the left and right detections have no view of the same name");
  right = std::move(joined);
}

/// The corners of one camera again, guided by its lens.
GuidedPass secondPass(const Arguments& arguments, const std::vector<std::string>& images,
                      const LensModel& lens, const Detections& all) {
  Detections first;
  first.image_size = all.image_size;
  for (const ViewDetections& view : all.views) {
    if (!view.pixels.empty()) first.views.push_back(view);
  }
  return guidedPass(arguments.common, images, lens, first);
}

void run(const Arguments& arguments) {
  const auto begin = std::chrono::steady_clock::now();
  // A rig file names lens files: without an own place they stand beside it.
  std::string out_left = arguments.out_left;
  std::string out_right = arguments.out_right;
  if (!arguments.out_rig.empty()) {
    const std::filesystem::path rig(arguments.out_rig);
    const auto beside = [&](const char* side) {
      return (rig.parent_path() / (rig.stem().string() + "_" + side + ".yaml")).string();
    };
    if (out_left.empty()) out_left = beside("left");
    if (out_right.empty()) out_right = beside("right");
  }
  std::vector<std::string> inputs = arguments.left_images;
  inputs.insert(inputs.end(), arguments.right_images.begin(), arguments.right_images.end());
  inputs.insert(inputs.end(), {arguments.left_detections, arguments.right_detections,
                               arguments.common.target_file});
  checkOutputs(inputs, {out_left, out_right, arguments.out_rig});
  checkReportFolder(arguments.common.report_folder);
  Detections left =
      gatherDetections(arguments.common, arguments.left_images, arguments.left_detections, true);
  Detections right =
      gatherDetections(arguments.common, arguments.right_images, arguments.right_detections, true);
  if (!arguments.left_detections.empty()) pairByName(left, right);
  StereoCalibrationResult result;
  try {
    result = calibrateStereo(left, right, calibrationOptions(arguments.common));
  } catch (const ContradictionError& error) {
    throw ContradictionError(error.what() + contradictionHelp());
  }
  nlohmann::ordered_json second_pass;
  if (!arguments.left_images.empty() && !arguments.common.one_pass) {
    const GuidedPass on_left =
        secondPass(arguments, arguments.left_images, *result.left.file.lens, left);
    const GuidedPass on_right =
        secondPass(arguments, arguments.right_images, *result.right.file.lens, right);
    Detections left_again = overImages(on_left.detections, arguments.left_images);
    Detections right_again = overImages(on_right.detections, arguments.right_images);
    bool kept = false;
    try {
      StereoCalibrationResult again =
          calibrateStereo(left_again, right_again, calibrationOptions(arguments.common));
      kept = servesBetter(result, again);
      if (kept) {
        left = std::move(left_again);
        right = std::move(right_again);
        result = std::move(again);
      }
    } catch (const Error&) {
      // The first fit stands.
    }
    second_pass = {{"left", secondPassFigures(on_left, kept)},
                   {"right", secondPassFigures(on_right, kept)}};
    for (auto [camera, side] : {std::pair{&result.left, "left"}, {&result.right, "right"}}) {
      camera->file.calibration.notes["second_pass"] = second_pass[side].dump();
    }
  }
  for (const std::string& remark : lengthRemarks(left, result.T_left_right.translation().norm())) {
    result.warnings.push_back(remark);
  }
  for (const std::string& warning : result.warnings) say("warning: " + printable(warning, 1000));

  nlohmann::ordered_json json;
  json["model"] = result.left.file.lens->model();
  json["model_right"] = result.right.file.lens->model();
  json["rms_px"] = result.rms_px;
  json["rms_left_px"] = result.left.rms_px;
  json["rms_right_px"] = result.right.rms_px;
  json["holdout_rms_px"] = nullptr;
  if (result.left.holdout_rms_px && result.right.holdout_rms_px) {
    const double l = *result.left.holdout_rms_px;
    const double r = *result.right.holdout_rms_px;
    const double points = result.left.points + result.right.points;
    json["holdout_rms_px"] =
        std::sqrt((l * l * result.left.points + r * r * result.right.points) / points);
  }
  json["joint_holdout_rms_px"] = nullptr;
  if (result.holdout_rms_px) json["joint_holdout_rms_px"] = *result.holdout_rms_px;
  addFigures(json, {&result.left, &result.right});
  if (!second_pass.is_null()) json["second_pass"] = second_pass;
  json["max_theta_rad"] =
      std::max(result.left.file.lens->maxTheta(), result.right.file.lens->maxTheta());
  json["baseline_m"] = result.T_left_right.translation().norm();
  json["pose"] = formatPose(result.T_left_right);
  json["warnings"] = result.warnings;

  if (!arguments.common.report_folder.empty()) {
    const std::string& folder = arguments.common.report_folder;
    ReportPictures pages;
    if (!arguments.left_images.empty()) {
      pages.read = [](const std::string& name) { return readImage(name, ImageColor::kGray); };
    }
    const std::string html_left = calibrationReport("Left camera", left, result.left, pages);
    const std::string html_right = calibrationReport("Right camera", right, result.right, pages);
    writeReport(folder, "report_left.html", html_left);
    writeReport(folder, "report_right.html", html_right);
  }
  if (!out_left.empty()) writeLensFile(out_left, result.left.file);
  if (!out_right.empty()) writeLensFile(out_right, result.right.file);
  if (!arguments.out_rig.empty()) {
    RigFile rig;
    rig.reference = out_left;
    rig.displaced = out_right;
    rig.T_ref_disp = result.T_left_right;
    rig.rms_px = result.rms_px;
    rig.date = result.left.file.calibration.date;
    writeRigFile(arguments.out_rig, rig);
  }
  json["seconds"] = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  printResult(*arguments.json, json);
}

}  // namespace

void addCalibrateStereo(CLI::App& app) {
  CLI::App* command = app.add_subcommand(
      "calibrate-stereo",
      "Fit two rigidly joined cameras and the pose between them to pairs of images");
  const auto arguments = std::make_shared<Arguments>();
  addCalibrationArguments(*command, arguments->common);
  command->add_option("--left", arguments->left_images,
                      "Images of the left (reference) camera, or a folder of them");
  command->add_option("--right", arguments->right_images,
                      "Images of the right camera, in the same order, or a folder of them");
  command->add_option("--left-detections", arguments->left_detections,
                      "Corners of the left camera (CSV)");
  command->add_option("--right-detections", arguments->right_detections,
                      "Corners of the right camera (CSV); views pair by their names");
  command->add_option("--out-left", arguments->out_left, "Lens file of the left camera to write");
  command->add_option("--out-right", arguments->out_right,
                      "Lens file of the right camera to write");
  command->add_option("--out-rig", arguments->out_rig,
                      "Rig file to write: both lens files and T_ref_disp (reference = left)");
  arguments->json = &addJsonFlag(*command);
  command->callback([arguments, command] {
    arguments->left_images = picturesIn(arguments->left_images);
    arguments->right_images = picturesIn(arguments->right_images);
    const bool from_files =
        !arguments->left_detections.empty() || !arguments->right_detections.empty();
    const bool from_images = !arguments->left_images.empty() || !arguments->right_images.empty();
    if (from_files == from_images) {
      throw CLI::ValidationError("calibrate-stereo",
                                 "needs either --left and --right images with --target, or "
                                 "--left-detections and --right-detections with --size");
    }
    if (from_files) {
      if (arguments->left_detections.empty()) throw CLI::RequiredError("--left-detections");
      if (arguments->right_detections.empty()) throw CLI::RequiredError("--right-detections");
      if (command->count("--size") == 0) throw CLI::RequiredError("--size WxH (with detections)");
    } else {
      if (arguments->left_images.empty()) throw CLI::RequiredError("--left");
      if (arguments->right_images.empty()) throw CLI::RequiredError("--right");
      if (arguments->common.target_file.empty()) throw CLI::RequiredError("--target TARGET.yaml");
      if (arguments->left_images.size() != arguments->right_images.size()) {
        throw Error("--left names " + std::to_string(arguments->left_images.size()) +
                    " images, --right " + std::to_string(arguments->right_images.size()) +
                    "; expected pairs");
      }
    }
    run(*arguments);
  });
}

}  // namespace omnister::tools
