// SPDX-License-Identifier: Apache-2.0
// `calibrate`: one camera's lens from images of a board or from corners found elsewhere.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <memory>
#include <optional>

#include "omnister/calibration/stage_positions.h"
#include "omnister/common/error.h"
#include "omnister/common/image_circle.h"
#include "omnister/common/image_file.h"
#include "omnister/common/numbers.h"
#include "omnister/common/text.h"
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

/// Views that the lens of the others does not explain: no more than a third of all.
std::vector<LeftOut> leaveOutMisfits(const CalibrationResult& result, Detections& detections) {
  constexpr double kMisfit = 2.5;
  std::vector<double> rms;
  for (const ViewResult& view : result.views) {
    if (view.used) rms.push_back(view.rms_px);
  }
  if (rms.size() < 6) return {};
  std::nth_element(rms.begin(), rms.begin() + static_cast<std::ptrdiff_t>(rms.size() / 2),
                   rms.end());
  const double typical = rms[rms.size() / 2];
  std::vector<LeftOut> left_out;
  std::vector<ViewDetections> kept;
  for (std::size_t i = 0; i < detections.views.size(); ++i) {
    const ViewResult& view = result.views[i];
    if (!view.used) {
      left_out.push_back({view.name, view.reason});
    } else if (view.rms_px > kMisfit * typical + 0.02) {
      left_out.push_back({view.name, "fits badly: " + formatFixed(view.rms_px, 2) + " px where " +
                                         formatFixed(typical, 2) +
                                         " px is typical (blurred, moved, covered in part, or "
                                         "another board or camera)"});
    } else {
      kept.push_back(detections.views[i]);
    }
  }
  if (left_out.empty() || 3 * left_out.size() > detections.views.size()) return {};
  detections.views = std::move(kept);
  return left_out;
}

CalibrationResult calibrated(const Detections& detections, const CalibrationOptions& options) {
  try {
    return calibrate(detections, options);
  } catch (const ContradictionError& error) {
    throw ContradictionError(error.what() + contradictionHelp());
  }
}

/// The same again without the views that fit badly, which are named.
void dropMisfits(const CalibrationOptions& options, CalibrationResult& result,
                 Detections& detections, std::vector<LeftOut>& left_out) {
  for (int round = 0; round < 2; ++round) {
    Detections fewer = detections;
    std::vector<LeftOut> misfits = leaveOutMisfits(result, fewer);
    if (misfits.empty()) return;
    try {
      CalibrationResult again = calibrate(fewer, options);
      result = std::move(again);
    } catch (const Error&) {
      return;  // without them the others do not carry a calibration
    }
    detections = std::move(fewer);
    left_out.insert(left_out.end(), misfits.begin(), misfits.end());
  }
}

/// The disc that the lens leaves on the sensor, by the brightest of all pictures.
std::optional<ImageCircle> circleOf(const std::vector<std::string>& images) {
  constexpr std::size_t kMost = 12;
  std::vector<cv::Mat> pictures;
  const std::size_t stride = std::max<std::size_t>(1, images.size() / kMost);
  for (std::size_t i = 0; i < images.size(); i += stride) {
    pictures.push_back(readImage(images[i], ImageColor::kGray));
  }
  return findImageCircle(pictures);
}

nlohmann::ordered_json leftOutRows(const std::vector<LeftOut>& left_out) {
  auto rows = nlohmann::ordered_json::array();
  for (const LeftOut& one : left_out)
    rows.push_back({{"image", one.image}, {"reason", one.reason}});
  return rows;
}

/// Images to look at again: not those left out since the first `told`.
std::vector<std::string> withoutMisfits(const std::vector<std::string>& images,
                                        const std::vector<LeftOut>& left_out, std::size_t told) {
  std::vector<std::string> kept;
  for (const std::string& image : images) {
    const bool out =
        std::any_of(left_out.begin() + static_cast<std::ptrdiff_t>(told), left_out.end(),
                    [&](const LeftOut& one) { return one.image == image; });
    if (!out) kept.push_back(image);
  }
  return kept;
}

/// A board that only the second pass found is a board.
void dropFound(const Detections& detections, std::vector<LeftOut>& left_out) {
  const auto found = [&](const LeftOut& one) {
    return std::any_of(detections.views.begin(), detections.views.end(),
                       [&](const ViewDetections& view) { return view.name == one.image; });
  };
  left_out.erase(std::remove_if(left_out.begin(), left_out.end(), found), left_out.end());
}

void sayLeftOut(const std::vector<LeftOut>& left_out, std::size_t from) {
  for (std::size_t i = from; i < left_out.size(); ++i) {
    say("left out: " + printable(left_out[i].image) + " " + printable(left_out[i].reason, 300));
  }
}

nlohmann::ordered_json circleFigures(const std::vector<std::string>& images) {
  const auto circle = circleOf(images);
  if (!circle) return nullptr;
  return {{"x", circle->center.x()}, {"y", circle->center.y()}, {"radius_px", circle->radius}};
}

void addLensFigures(const CalibrationResult& result, nlohmann::ordered_json& json) {
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
}

void run(Arguments arguments) {
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
  Detections detections;
  std::vector<LeftOut> left_out;
  const std::size_t pictures = arguments.images.size();
  if (arguments.images.empty()) {
    detections = gatherDetections(arguments.common, {}, arguments.detections_file, false);
  } else {
    Gathered gathered = gatherPictures(arguments.common, arguments.images);
    detections = std::move(gathered.detections);
    left_out = std::move(gathered.left_out);
    arguments.images = std::move(gathered.images);
    sayLeftOut(left_out, 0);
  }
  std::vector<std::string> remarks = place(detections);
  for (const std::string& remark : lengthRemarks(detections, 0.0)) remarks.push_back(remark);
  const CalibrationOptions options = calibrationOptions(arguments.common);
  CalibrationResult result = calibrated(detections, options);
  const std::size_t told = left_out.size();
  // Positions hold views together: there a misfit is the stage's, and named as such.
  const bool pick = !arguments.images.empty() && positions.empty();
  if (pick) dropMisfits(options, result, detections, left_out);
  nlohmann::ordered_json second_pass;
  if (!arguments.images.empty() && !arguments.common.one_pass) {
    GuidedPass pass = guidedPass(arguments.common, withoutMisfits(arguments.images, left_out, told),
                                 *result.file.lens, detections);
    for (ViewDetections& view : pass.detections.views) view.stage.reset();
    std::vector<std::string> pass_remarks = place(pass.detections);
    std::vector<LeftOut> pass_left_out = left_out;
    bool kept = false;
    try {
      CalibrationResult again = calibrate(pass.detections, options);
      if (pick) dropMisfits(options, again, pass.detections, pass_left_out);
      kept = servesBetter(result, again);
      if (kept) {
        result = std::move(again);
        detections = std::move(pass.detections);
        remarks = std::move(pass_remarks);
        for (const std::string& remark : lengthRemarks(detections, 0.0)) remarks.push_back(remark);
        left_out = std::move(pass_left_out);
        dropFound(detections, left_out);
      }
    } catch (const Error&) {
      // The first fit stands.
    }
    second_pass = secondPassFigures(pass, kept);
    result.file.calibration.notes["second_pass"] = second_pass.dump();
  }
  sayLeftOut(left_out, told);
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
  if (pictures > 0) {
    json["views"] = pictures;
    json["left_out"] = leftOutRows(left_out);
    json["image_circle"] = circleFigures(arguments.images);
  }
  if (!second_pass.is_null()) json["second_pass"] = second_pass;
  addLensFigures(result, json);
  json["warnings"] = result.warnings;
  ReportPictures pages;
  pages.left_out = left_out;
  if (pictures > 0) {
    pages.read = [](const std::string& name) { return readImage(name, ImageColor::kGray); };
    pages.next = nextViews(result, targetPoints(targetOf(arguments.common)), 3);
    const Verdict verdict = verdictOn(result, pages);
    json["verdict"] = verdict.word;
    json["advice"] = verdict.advice;
    say("this calibration is " + verdict.word);
    for (const std::string& line : verdict.advice) say("  to do: " + printable(line, 400));
  }
  if (!arguments.common.report_folder.empty()) {
    const std::string html = calibrationReport("Lens calibration", detections, result, pages);
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
  command->add_option("images", arguments->images,
                      "Images of the board, or folders of them (with --target)");
  command
      ->add_option("--square-mm", arguments->common.square_mm,
                   "With images and no --target: side of a square, or spacing of dots [mm], of the "
                   "board that the images are seen to show")
      ->check(CLI::PositiveNumber);
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
    if (command->count("--square-mm") > 0 && !arguments->common.target_file.empty()) {
      throw CLI::ExcludesError("--square-mm", "--target");
    }
    const ProcedureArguments& procedure = arguments->procedure;
    arguments->images = picturesIn(arguments->images);
    if (!from_file && procedure.name != "lines" && arguments->common.target_file.empty()) {
      chooseTarget(arguments->images, arguments->common);
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
