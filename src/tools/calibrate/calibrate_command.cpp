// SPDX-License-Identifier: Apache-2.0
// `calibrate`: one camera's lens from images of a board or from corners found elsewhere.
#include <chrono>
#include <cmath>
#include <memory>

#include "omnister/calibration/stage_positions.h"
#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "tools/calibrate/calibration_arguments.h"
#include "tools/calibrate/calibration_report.h"
#include "tools/calibrate/procedure_command.h"

namespace omnister::tools {
namespace {

struct Arguments {
  CalibrationArguments common;
  ProcedureArguments procedure;
  std::vector<std::string> images;
  std::string detections_file;
  std::string positions_file;
  std::string out;
  bool* json = nullptr;
};

void run(const Arguments& arguments) {
  const auto begin = std::chrono::steady_clock::now();
  std::vector<std::string> inputs = arguments.images;
  inputs.push_back(arguments.detections_file);
  inputs.push_back(arguments.common.target_file);
  inputs.push_back(arguments.positions_file);
  checkOutputs(inputs, {arguments.out});
  checkReportFolder(arguments.common.report_folder);
  std::vector<StageView> positions;
  if (!arguments.positions_file.empty()) positions = readStagePositions(arguments.positions_file);
  const auto place = [&](Detections& detections) {
    if (positions.empty()) return std::vector<std::string>();
    return applyStagePositions(positions, arguments.positions_file, detections);
  };
  Detections detections =
      gatherDetections(arguments.common, arguments.images, arguments.detections_file, false);
  std::vector<std::string> remarks = place(detections);
  const CalibrationOptions options = calibrationOptions(arguments.common);
  CalibrationResult result = calibrate(detections, options);
  nlohmann::ordered_json second_pass;
  if (!arguments.images.empty() && !arguments.common.one_pass) {
    GuidedPass pass = guidedPass(arguments.common, arguments.images, *result.file.lens, detections);
    for (ViewDetections& view : pass.detections.views) view.stage.reset();
    std::vector<std::string> pass_remarks = place(pass.detections);
    bool kept = false;
    try {
      CalibrationResult again = calibrate(pass.detections, options);
      kept = servesBetter(result, again);
      if (kept) {
        result = std::move(again);
        detections = std::move(pass.detections);
        remarks = std::move(pass_remarks);
      }
    } catch (const Error&) {
      // The first fit stands.
    }
    second_pass = secondPassFigures(pass, kept);
    result.file.calibration.notes["second_pass"] = second_pass.dump();
  }
  for (const std::string& remark : remarks) say("warning: " + printable(remark, 1000));
  for (const std::string& warning : result.warnings) say("warning: " + printable(warning, 1000));

  nlohmann::ordered_json json;
  json["model"] = result.file.lens->model();
  json["structure"] = result.file.calibration.notes.at("structure");
  json["rms_px"] = result.rms_px;
  json["holdout_rms_px"] = nullptr;
  if (result.holdout_rms_px) json["holdout_rms_px"] = *result.holdout_rms_px;
  addFigures(json, {&result});
  // Images without a board are views too.
  if (!arguments.images.empty()) json["views"] = arguments.images.size();
  if (!second_pass.is_null()) json["second_pass"] = second_pass;
  json["max_theta_rad"] = result.file.lens->maxTheta();
  json["height_px"] = result.height_px;
  json["height_sigma_px"] = nullptr;
  if (std::isfinite(result.height_sigma_px)) json["height_sigma_px"] = result.height_sigma_px;
  json["uncertainty_rms_px"] = result.uncertainty_rms_px;
  json["uncertainty_max_px"] = result.uncertainty_max_px;
  auto& depths = json["uncertainty_at_depth"] = nlohmann::ordered_json::array();
  for (const DepthUncertainty& depth : result.depth_uncertainty) {
    nlohmann::ordered_json row;
    row["distance_m"] = nullptr;  // infinity
    if (std::isfinite(depth.distance)) row["distance_m"] = depth.distance;
    row["rms_px"] = depth.rms_px;
    row["max_px"] = depth.max_px;
    depths.push_back(row);
  }
  json["bias_rms_px"] = nullptr;
  if (result.bias_rms_px) json["bias_rms_px"] = *result.bias_rms_px;
  json["bias_against"] = result.bias_against;
  if (result.stage) {
    const StageResult& stage = *result.stage;
    json["stage_axis"] = {stage.axis.x(), stage.axis.y(), stage.axis.z()};
    json["stage_axis_sigma_rad"] = stage.axis_sigma_rad;
    json["stage_scale"] = stage.scale;
    json["stage_scale_sigma"] = stage.scale_sigma;
    json["stage_boards"] = stage.boards;
    json["stage_views"] = stage.views;
  }
  json["warnings"] = result.warnings;
  if (!arguments.common.report_folder.empty()) {
    const std::string html = calibrationReport("Lens calibration", detections, result);
    writeReport(arguments.common.report_folder, "report.html", html);
  }
  if (!arguments.out.empty()) writeLensFile(arguments.out, result.file);
  json["seconds"] = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  printResult(*arguments.json, json);
}

}  // namespace

void addCalibrate(CLI::App& app) {
  CLI::App* command = app.add_subcommand(
      "calibrate", "Fit a lens to images of a board, or to corners found in them");
  const auto arguments = std::make_shared<Arguments>();
  addCalibrationArguments(*command, arguments->common);
  addProcedureArguments(*command, arguments->procedure);
  command->add_option("images", arguments->images, "Images of the board (with --target)");
  command->add_option(
      "--detections", arguments->detections_file,
      "Corners as CSV: view,u_px,v_px,x_m,y_m,z_m (with --size, instead of images)");
  command->add_option("--positions", arguments->positions_file,
                      "Stage positions as CSV: view,position_m[,board]. Views of one board share "
                      "its pose, the steps are lengths, and the stage's axis is found");
  command->add_option("--out", arguments->out, "Lens file to write");
  arguments->json = &addJsonFlag(*command);
  command->callback([arguments, command] {
    const bool from_file = !arguments->detections_file.empty();
    if (from_file == !arguments->images.empty()) {
      throw CLI::ValidationError("calibrate", from_file ? "takes images or --detections, not both"
                                                        : "needs images or --detections FILE.csv");
    }
    if (from_file && command->count("--size") == 0) {
      throw CLI::RequiredError("--size WxH (with --detections)");
    }
    const ProcedureArguments& procedure = arguments->procedure;
    if (!from_file && procedure.name != "lines" && arguments->common.target_file.empty()) {
      throw CLI::RequiredError("--target TARGET.yaml (with images)");
    }
    if (procedure.name.empty()) {
      for (const char* option : {"--center", "--sweep", "--roi"}) {
        if (command->count(option) > 0) throw CLI::RequiresError(option, "--procedure");
      }
      return run(*arguments);
    }
    if (!arguments->positions_file.empty()) {
      throw CLI::ExcludesError("--positions", "--procedure");
    }
    runProcedure(procedure, arguments->common, arguments->images, arguments->detections_file,
                 arguments->out, *arguments->json);
  });
}

}  // namespace omnister::tools
