// SPDX-License-Identifier: Apache-2.0
// `import`: somebody else's calibration becomes a lens file.
#include <cmath>
#include <memory>

#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"
#include "omnister/common/text.h"
#include "omnister/lens/lens_file.h"
#include "omnister/lens/lens_import.h"
#include "tools/cli/commands.h"

namespace omnister::tools {
namespace {

constexpr std::size_t kMaxBytes = 64u << 20;  // mrcal keeps its packed inputs in the file
constexpr double kDegrees = 180.0 / 3.14159265358979323846;

struct Options {
  std::string file;
  std::string format = "auto";
  std::string camera;
  std::string model = "spline";
  std::string out;
  double max_residual_px = 0.5;
  int knots = 24;
  int even_terms = 3;
  bool model_given = false;
};

/// A lens file needs no import: it goes through as it is, never refitted.
bool isLensFile(const std::string& text) {
  std::size_t at = 0;
  while ((at = text.find("lens_surface:", at)) != std::string::npos) {
    if (at == 0 || text[at - 1] == '\n') return true;
    ++at;
  }
  return false;
}

void passThrough(const Options& options, bool json) {
  const LensFile file = readLensFile(options.file);
  if (options.model_given && options.model != file.lens->model()) {
    throw InputError(options.file, "lens_surface.model",
                     "is a lens file already, with the model " + std::string(file.lens->model()) +
                         ": --model " + options.model +
                         " would refit it; leave --model out, or give --format camera_info to "
                         "import its standard part alone");
  }
  writeLensFile(options.out, file);
  say("a lens file already: passed through unchanged");
  nlohmann::ordered_json result;
  result["residual_rms_px"] = 0.0;
  result["residual_max_px"] = 0.0;
  result["model"] = file.lens->model();
  result["format"] = "lens_surface";
  result["camera"] = file.camera_name;
  result["max_theta_rad"] = file.lens->maxTheta();
  result["out"] = options.out;
  printResult(json, result);
}

void run(const Options& options, bool json) {
  checkOutputs({options.file}, {options.out});
  const std::string text = readFile(options.file, kMaxBytes);
  if (options.format == "auto" && isLensFile(text)) {
    passThrough(options, json);
    return;
  }
  const ForeignCamera camera =
      readForeignCamera(text, options.file, options.format, options.camera);
  for (const std::string& remark : camera.remarks) say(remark);
  const ForeignFit fit = namingSource(options.file, [&] {
    return fitForeignCamera(camera, options.model, options.even_terms, options.knots);
  });
  const double max_theta = fit.fit.lens->maxTheta();
  if (fit.field.image >= fit.field.one_to_one - 1e-9) {
    say("the source is one-to-one only up to " + formatFixed(max_theta * kDegrees, 1) +
        " degrees off the axis, which the image reaches: pixels beyond have no ray");
  }
  const bool within = std::isfinite(fit.fit.rms_px) && fit.fit.rms_px <= options.max_residual_px;
  if (!within) {
    throw InputError(
        options.file, "",
        "a " + options.model + " surface misses its " + camera.model + " model by " +
            formatFixed(fit.fit.rms_px, 3) + " px RMS (" + formatFixed(fit.fit.max_px, 2) +
            " px at worst) over " + formatFixed(max_theta * kDegrees, 1) +
            " degrees off the axis, more than " + formatNumber(options.max_residual_px) +
            " px; another --model may come nearer, --max-residual PX allows it");
  }
  LensFile file;
  file.image_size = camera.image_size;
  if (!camera.camera_name.empty()) file.camera_name = camera.camera_name;
  file.lens = fit.fit.lens;
  file.calibration.date = currentDate();
  file.calibration.notes["imported_from"] = camera.format + " " + camera.model;
  file.calibration.notes["import_residual_rms_px"] = formatNumber(fit.fit.rms_px);
  file.calibration.notes["import_residual_max_px"] = formatNumber(fit.fit.max_px);
  writeLensFile(options.out, file);

  nlohmann::ordered_json result;
  result["residual_rms_px"] = fit.fit.rms_px;
  result["residual_max_px"] = fit.fit.max_px;
  result["model"] = options.model;
  result["format"] = camera.format;
  result["source_model"] = camera.model;
  result["camera"] = file.camera_name;
  result["max_theta_rad"] = max_theta;
  result["one_to_one_theta_rad"] = fit.field.one_to_one;
  result["affinity"] = fit.structure.affinity;
  result["turn"] = fit.structure.turn;
  result["decentring"] = fit.structure.decentring;
  result["out"] = options.out;
  printResult(json, result);
}

}  // namespace

void addImport(CLI::App& app) {
  CLI::App* command = app.add_subcommand("import", "A foreign calibration to a lens file");
  const auto options = std::make_shared<Options>();
  command
      ->add_option("file", options->file,
                   "ROS camera_info, Kalibr camchain, OCamCalib text or "
                   "mrcal .cameramodel")
      ->required();
  command->add_option("--format", options->format, "What FILE is")
      ->check(CLI::IsMember(foreignFormats()))
      ->capture_default_str();
  command->add_option("--camera", options->camera, "Camera of a Kalibr camchain, e.g. cam1");
  CLI::Option* model = command->add_option("--model", options->model, "Lens surface")
                           ->check(CLI::IsMember(lensModelNames()))
                           ->capture_default_str();
  command->add_option("--out", options->out, "Lens file to write")->required();
  command
      ->add_option("--max-residual", options->max_residual_px,
                   "Largest RMS over the field that is accepted [px]")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  command->add_option("--knots", options->knots, "Knots of a spline")
      ->check(CLI::Range(4, 32))
      ->capture_default_str();
  command->add_option("--terms", options->even_terms, "Even terms of an asphere: r^4, r^6, r^8")
      ->check(CLI::Range(0, 3))
      ->capture_default_str();
  const bool& json = addJsonFlag(*command);
  command->callback([options, model, &json] {
    options->model_given = model->count() > 0;
    run(*options, json);
  });
}

}  // namespace omnister::tools
