// SPDX-License-Identifier: Apache-2.0
#include "tools/calibrate/calibration_arguments.h"

#include <unistd.h>

#include <algorithm>
#include <filesystem>

#include "omnister/calibration/detector.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/image_file.h"

namespace omnister::tools {

void addCalibrationArguments(CLI::App& command, CalibrationArguments& arguments) {
  command.add_option("--target", arguments.target_file, "TARGET.yaml of the board in the images");
  command.add_option("--size", arguments.size, "Image size WxH [px], needed with detections")
      ->type_name("WxH");
  std::vector<std::string> models = {"auto"};
  for (const std::string& name : lensModelNames()) models.push_back(name);
  command
      .add_option("--model", arguments.model,
                  "Lens model; auto chooses by held-out error among structures of all kinds")
      ->check(CLI::IsMember(models))
      ->capture_default_str();
  command
      .add_option(
          "--folds", arguments.folds,
          "Interleaved folds for the held-out error, at least 2 (0: only if a choice needs them)")
      ->check([](const std::string& text) {
        return text == "1" ? std::string("1 fold leaves nothing to fit; expected 0 or at least 2")
                           : std::string();
      })
      ->check(CLI::Range(0, 10000));
  command.add_option("--report", arguments.report_folder,
                     "Folder for an HTML report with residuals, coverage and uncertainty");
  command.add_option("--threads", arguments.threads, "Threads to use (0: every core)")
      ->check(CLI::Range(0, 1024));
  command.add_flag("--flat-board", arguments.flat_board,
                   "Take the board as perfectly flat instead of fitting its bend");
  command.add_flag("--one-pass", arguments.one_pass,
                   "With images: no second detection guided by the first lens");
}

CalibrationOptions calibrationOptions(const CalibrationArguments& arguments) {
  CalibrationOptions options;
  options.model = arguments.model;
  options.folds = arguments.folds;
  options.board_warp = !arguments.flat_board;
  options.threads = arguments.threads;
  options.progress = consoleProgress();
  return options;
}

namespace {

// The commonest mistake: squares counted in place of inner corners, or another board than the
// file's. Of coded boards a wrong size leaves a few corners of the first row.
void checkBoardSize(const Target& target, const std::string& target_file,
                    const std::vector<std::string>& missed, const Detections& found) {
  constexpr std::size_t kLooks = 3;
  const bool coded = target.type == TargetType::kCharuco || target.type == TargetType::kAprilGrid;
  std::vector<std::string> doubtful;
  if (coded || found.views.empty()) doubtful = missed;
  const std::size_t points = targetPoints(target).size();
  for (const ViewDetections& view : found.views) {
    if (coded && 2 * view.pixels.size() < points) doubtful.push_back(view.name);
  }
  const char* what = "";
  switch (target.type) {
    case TargetType::kCheckerboard:
      what = "inner corners";
      break;
    case TargetType::kCircles:
      what = "dots";
      break;
    case TargetType::kCharuco:
      what = "squares";
      break;
    case TargetType::kAprilGrid:
      what = "tags";
      break;
  }
  for (std::size_t i = 0; i < std::min(kLooks, doubtful.size()); ++i) {
    const auto seen = otherBoardSize(readImage(doubtful[i], ImageColor::kGray), target);
    if (!seen) continue;
    throw InputError(target_file, "cols and rows",
                     "are " + std::to_string(target.cols) + " and " + std::to_string(target.rows) +
                         ", but " + doubtful[i] + " shows a board of " +
                         std::to_string(seen->width) + " x " + std::to_string(seen->height) + " " +
                         what);
  }
}

}  // namespace

Detections gatherDetections(const CalibrationArguments& arguments,
                            const std::vector<std::string>& images,
                            const std::string& detections_file, bool keep_missed) {
  if (!detections_file.empty()) {
    return readDetections(detections_file, {arguments.size.width, arguments.size.height});
  }
  const Target target = readTarget(arguments.target_file);
  DetectorOptions options;
  options.threads = arguments.threads;
  std::vector<std::string> missed;
  Detections detections = detectInFiles(images, target, options, &missed, consoleProgress());
  for (const std::string& name : missed) say("no board found in " + printable(name));
  checkBoardSize(target, arguments.target_file, missed, detections);
  return keep_missed ? overImages(std::move(detections), images) : detections;
}

Detections overImages(Detections found, const std::vector<std::string>& images) {
  Detections all;
  all.image_size = found.image_size;
  std::size_t next = 0;
  for (const std::string& image : images) {
    if (next < found.views.size() && found.views[next].name == image) {
      all.views.push_back(std::move(found.views[next++]));
    } else {
      all.views.emplace_back().name = image;
    }
  }
  if (next != found.views.size()) throw Error("the detected views are not those of the images");
  return all;
}

GuidedPass guidedPass(const CalibrationArguments& arguments, const std::vector<std::string>& images,
                      const LensModel& lens, const Detections& first) {
  DetectorOptions options;
  options.threads = arguments.threads;
  return detectGuided(images, readTarget(arguments.target_file), lens, first, options,
                      consoleProgress());
}

nlohmann::ordered_json secondPassFigures(const GuidedPass& pass, bool kept) {
  return {{"kept", kept},
          {"views_added", pass.views_added},
          {"corners_before", pass.corners_before},
          {"corners_after", pass.corners_after}};
}

void checkReportFolder(const std::string& folder) {
  if (folder.empty()) return;
  namespace fs = std::filesystem;
  // The nearest folder that is there already must take what is made in it.
  fs::path path = fs::absolute(folder).lexically_normal();
  std::error_code ignored;
  while (!fs::exists(path, ignored) && path != path.root_path()) path = path.parent_path();
  if (!fs::is_directory(path, ignored)) {
    throw InputError(folder, "",
                     "cannot be a report's folder: " + printable(path.string()) + " is no folder");
  }
  if (::access(path.c_str(), W_OK | X_OK) != 0) {
    throw InputError(
        folder, "",
        "cannot be a report's folder: " + printable(path.string()) + " may not be written to");
  }
}

void writeReport(const std::string& folder, const std::string& name, const std::string& html) {
  std::error_code error;
  std::filesystem::create_directories(folder, error);
  if (error) throw IoError("create", folder, error.value());
  writeFileAtomically(std::filesystem::path(folder) / name, html);
}

void addFigures(nlohmann::ordered_json& json,
                const std::vector<const CalibrationResult*>& cameras) {
  std::size_t views = 0;
  std::size_t used = 0;
  int points = 0;
  for (const CalibrationResult* camera : cameras) {
    views = std::max(views, camera->views.size());
    const auto count = std::count_if(camera->views.begin(), camera->views.end(),
                                     [](const ViewResult& view) { return view.used; });
    used = std::max(used, static_cast<std::size_t>(count));
    points += camera->points;
  }
  json["views"] = views;
  json["views_used"] = used;
  json["points"] = points;
}

}  // namespace omnister::tools
