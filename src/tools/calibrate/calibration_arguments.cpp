// SPDX-License-Identifier: Apache-2.0
#include "tools/calibrate/calibration_arguments.h"

#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <map>

#include "omnister/calibration/board_hint.h"
#include "omnister/calibration/detector.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/image_file.h"
#include "omnister/common/numbers.h"

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
  const std::map<std::string, Contradictions> ways = {{"refuse", Contradictions::kRefuse},
                                                      {"leave-out", Contradictions::kLeaveOut},
                                                      {"keep", Contradictions::kKeep}};
  command
      .add_option("--contradictory", arguments.contradictions,
                  "Views that contradict each other (images turned, of two cameras, at another "
                  "focus): refuse, leave-out all but the largest set that agrees, or keep them all")
      ->transform(CLI::CheckedTransformer(ways))
      ->type_name("refuse|leave-out|keep")
      ->default_str("refuse");
}

CalibrationOptions calibrationOptions(const CalibrationArguments& arguments) {
  CalibrationOptions options;
  options.model = arguments.model;
  options.folds = arguments.folds;
  options.board_warp = !arguments.flat_board;
  options.threads = arguments.threads;
  options.contradictions = arguments.contradictions;
  options.progress = consoleProgress();
  return options;
}

namespace {

// Two pictures in one file make it this much wider or higher than one, at least.
constexpr double kTwicePictures = 1.9;

void checkKindOfBoard(const Target& target, const CalibrationArguments& arguments,
                      const std::string& name) {
  const cv::Mat image = readImage(name, ImageColor::kGray);
  const auto hint = boardHint(image, target);
  if (!hint) return;
  if (hint->rfind("shows the board twice", 0) == 0) throw InputError(name, "", *hint);
  const std::string source =
      arguments.target_file.empty() ? std::string("--square-mm") : arguments.target_file;
  throw InputError(source, "", "is not the board in the images: " + name + " " + *hint);
}

// The commonest mistake: squares counted in place of inner corners, or another board than the
// file's. Of coded boards a wrong size leaves a few corners of the first row.
void checkBoard(const Target& target, const CalibrationArguments& arguments,
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
    throw InputError(arguments.target_file, "cols and rows",
                     "are " + std::to_string(target.cols) + " and " + std::to_string(target.rows) +
                         ", but " + doubtful[i] + " shows a board of " +
                         std::to_string(seen->width) + " x " + std::to_string(seen->height) + " " +
                         what);
  }
  for (std::size_t i = 0; i < std::min(kLooks, doubtful.size()); ++i) {
    checkKindOfBoard(target, arguments, doubtful[i]);
  }
  // The other layout of an even number of rows finds most of the board, but not all.
  if (doubtful.empty() && !found.views.empty() && target.type == TargetType::kCharuco &&
      target.rows % 2 == 0) {
    checkKindOfBoard(target, arguments, found.views.front().name);
  }
  // A board that is there may still be there twice.
  const double aspect =
      static_cast<double>(found.image_size.width) / std::max(1, found.image_size.height);
  if (doubtful.empty() && !found.views.empty() &&
      (aspect >= kTwicePictures || aspect <= 1.0 / kTwicePictures)) {
    checkKindOfBoard(target, arguments, found.views.front().name);
  }
}

/// Why a picture has no board, as far as that can be told.
std::string reasonWithoutBoard(const std::string& name, const std::string& doubt,
                               const Target& target, bool look_closer) {
  if (!doubt.empty()) return doubt + ": no board was found in it";
  if (look_closer) {
    if (const auto seen = otherBoardSize(readImage(name, ImageColor::kGray), target)) {
      return "shows another board, of " + std::to_string(seen->width) + " x " +
             std::to_string(seen->height);
    }
  }
  return "no board was found in it: none is there, it is covered in part, or too near the edge";
}

}  // namespace

Detections gatherDetections(const CalibrationArguments& arguments,
                            const std::vector<std::string>& images,
                            const std::string& detections_file, bool keep_missed) {
  if (!detections_file.empty()) {
    return readDetections(detections_file, {arguments.size.width, arguments.size.height});
  }
  const Target target = targetOf(arguments);
  DetectorOptions options;
  options.threads = arguments.threads;
  std::vector<std::string> missed;
  Detections detections = detectInFiles(images, target, options, &missed, consoleProgress());
  for (const std::string& name : missed) say("no board found in " + printable(name));
  checkBoard(target, arguments, missed, detections);
  return keep_missed ? overImages(std::move(detections), images) : detections;
}

Target targetOf(const CalibrationArguments& arguments) {
  return arguments.target ? *arguments.target : readTarget(arguments.target_file);
}

void chooseTarget(const std::vector<std::string>& images, CalibrationArguments& arguments) {
  constexpr std::size_t kLooks = 6;
  const std::string asked = "--target TARGET.yaml (with images)";
  if (arguments.square_mm < 0.0) return;
  std::string shown;
  // Spread over the folder.
  const std::size_t stride = std::max<std::size_t>(1, images.size() / kLooks);
  for (std::size_t i = 0; i < images.size(); i += stride) {
    std::optional<Target> seen;
    try {
      seen = boardSeen(readImage(images[i], ImageColor::kGray));
    } catch (const Error&) {
      continue;
    }
    if (!seen) continue;
    std::string line = formatTarget(*seen);
    line.pop_back();
    const bool plain =
        seen->type == TargetType::kCheckerboard || seen->type == TargetType::kCircles;
    if (plain && arguments.square_mm > 0.0) {
      seen->square_m = 1e-3 * arguments.square_mm;
      checkTarget(*seen, "--square-mm");
      say("the target is " + formatTarget(*seen).substr(0, formatTarget(*seen).size() - 1) +
          ", as seen in " + printable(images[i]) + "; check that it is");
      arguments.target = *seen;
      return;
    }
    const auto size = line.find("square_m: 1");
    if (size != std::string::npos) line.replace(size, 11, "square_m: SIDE");
    shown = ": " + printable(images[i]) + " seems to show " + line +
            " with SIDE measured in metres; write that to a file";
    if (seen->type == TargetType::kCharuco) shown += " (marker_m too)";
    if (seen->type == TargetType::kAprilGrid)
      shown += " (and spacing, the gap as a share of a tag)";
    if (plain) shown += ", or give --square-mm";
    break;
  }
  throw CLI::RequiredError(asked + shown);
}

Gathered gatherPictures(const CalibrationArguments& arguments,
                        const std::vector<std::string>& images) {
  constexpr std::size_t kCloserLooks = 12;
  const Target target = targetOf(arguments);
  Gathered gathered;
  PictureSurvey survey = surveyPictures(images, arguments.threads);
  gathered.left_out = std::move(survey.left_out);
  DetectorOptions options;
  options.threads = arguments.threads;
  std::vector<std::string> missed;
  gathered.detections = detectInFiles(survey.images, target, options, &missed, consoleProgress());
  checkBoard(target, arguments, missed, gathered.detections);
  std::size_t looked = 0;
  for (std::size_t i = 0; i < survey.images.size(); ++i) {
    if (std::find(missed.begin(), missed.end(), survey.images[i]) == missed.end()) continue;
    const bool closer = survey.doubts[i].empty() && looked++ < kCloserLooks;
    gathered.left_out.push_back(
        {survey.images[i], reasonWithoutBoard(survey.images[i], survey.doubts[i], target, closer)});
  }
  for (LeftOut& poor : leaveOutPoorViews(target, arguments.threads, gathered.detections)) {
    gathered.left_out.push_back(std::move(poor));
  }
  // A second pass may yet find a board where the first found none, but not in a poor picture.
  for (const std::string& image : survey.images) {
    const auto out = std::find_if(gathered.left_out.begin(), gathered.left_out.end(),
                                  [&](const LeftOut& one) { return one.image == image; });
    const bool no_board = std::find(missed.begin(), missed.end(), image) != missed.end();
    if (out == gathered.left_out.end() || no_board) gathered.images.push_back(image);
  }
  return gathered;
}

std::vector<std::string> lengthRemarks(const Detections& detections, double baseline_m) {
  constexpr double kLargestBoard = 5.0;     // [m]
  constexpr double kLargestBaseline = 5.0;  // [m]
  double largest = 0.0;
  double smallest_step = HUGE_VAL;
  for (const ViewDetections& view : detections.views) {
    for (std::size_t i = 0; i < view.points.size(); ++i) {
      largest = std::max(largest, (view.points[i] - view.points[0]).norm());
      if (i > 0)
        smallest_step = std::min(smallest_step, (view.points[i] - view.points[i - 1]).norm());
    }
  }
  std::vector<std::string> remarks;
  if (largest > kLargestBoard || baseline_m > kLargestBaseline) {
    std::string text = "the board is " + formatNumber(std::round(10.0 * largest) / 10.0) +
                       " m from corner to corner";
    if (baseline_m > 0.0) {
      text += " and the baseline " + formatNumber(std::round(100.0 * baseline_m) / 100.0) + " m";
    }
    remarks.push_back(text + ": were its squares given in millimetres? Lengths are metres (" +
                      formatNumber(smallest_step) + " would be " +
                      formatNumber(1e-3 * smallest_step) + ")");
  }
  return remarks;
}

std::string contradictionHelp() {
  return "; sort the images, or choose: --contradictory leave-out takes the largest set alone, "
         "--contradictory keep all of them as if they agreed";
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
  return detectGuided(images, targetOf(arguments), lens, first, options, consoleProgress());
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
