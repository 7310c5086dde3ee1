// SPDX-License-Identifier: Apache-2.0
/// @file What `calibrate` and `calibrate-stereo` have in common.
#pragma once

#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <vector>

#include "omnister/calibration/calibrate.h"
#include "omnister/calibration/guided_pass.h"
#include "omnister/calibration/picture_survey.h"
#include "omnister/calibration/target.h"
#include "tools/cli/commands.h"

namespace omnister::tools {

struct CalibrationArguments {
  std::string target_file;
  Size size;
  std::string model = "auto";
  int folds = 0;
  std::string report_folder;
  int threads = 0;
  bool flat_board = false;
  bool one_pass = false;
  Contradictions contradictions = Contradictions::kRefuse;
  double square_mm = 0.0;        ///< with images and no target file: size of the board that is seen
  std::optional<Target> target;  ///< set where there is no file
};

/// `--target`, `--size`, `--model`, `--folds`, `--report`, `--threads`, `--flat-board`,
/// `--one-pass`, `--contradictory`, `--square-mm`.
void addCalibrationArguments(CLI::App& command, CalibrationArguments& arguments);

CalibrationOptions calibrationOptions(const CalibrationArguments& arguments);

/// Corners from a CSV file, or from images with the target. Images without the target are named on
/// standard error; with `keep_missed` they stay as empty views, so that pairs keep their places.
Detections gatherDetections(const CalibrationArguments& arguments,
                            const std::vector<std::string>& images,
                            const std::string& detections_file, bool keep_missed);

/// The board: that of the file, or the one that was seen and given a size.
Target targetOf(const CalibrationArguments& arguments);

/// Where no target file is given: looks which board the pictures show. With `--square-mm` it
/// becomes the target. @throws CLI::RequiredError that says what to write into a target file
void chooseTarget(const std::vector<std::string>& images, CalibrationArguments& arguments);

/// Corners from a folder as it is: pictures that cannot serve are left out by name.
struct Gathered {
  Detections detections;
  std::vector<std::string> images;  ///< those to look at again in a second pass
  std::vector<LeftOut> left_out;
};
Gathered gatherPictures(const CalibrationArguments& arguments,
                        const std::vector<std::string>& images);

/// Remarks on lengths that no board or rig has: squares given in millimetres.
/// @param baseline_m 0 without a rig
std::vector<std::string> lengthRemarks(const Detections& detections, double baseline_m);

/// What to do about views that contradict each other, as the end of a message.
std::string contradictionHelp();

/// One view an image, empty where nothing was found.
Detections overImages(Detections found, const std::vector<std::string>& images);

/// Detection once more in all images, guided by a fitted lens; images that it adds are named on
/// standard error.
GuidedPass guidedPass(const CalibrationArguments& arguments, const std::vector<std::string>& images,
                      const LensModel& lens, const Detections& first);

/// `kept`, `views_added`, `corners_before`, `corners_after`.
nlohmann::ordered_json secondPassFigures(const GuidedPass& pass, bool kept);

/// To be called before any work: a report must not fail after it. Empty means no report.
/// @throws InputError
void checkReportFolder(const std::string& folder);

/// Writes one file of a report, making the folder where it is missing. @throws IoError
void writeReport(const std::string& folder, const std::string& name, const std::string& html);

/// Sums of both kinds of calibration under the contract's keys.
void addFigures(nlohmann::ordered_json& json, const std::vector<const CalibrationResult*>& cameras);

}  // namespace omnister::tools
