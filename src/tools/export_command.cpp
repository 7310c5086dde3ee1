// SPDX-License-Identifier: Apache-2.0
// `export`: a lens file becomes a calibration that other programs read.
#include <cmath>
#include <cstdio>
#include <memory>

#include "commands.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_export.h"

namespace omnister::tools {
namespace {

constexpr double kHalfPi = 1.57079632679489661923;

struct Options {
  std::string lens;
  std::string format;
  std::string model;
  std::string out;
  double max_residual_px = 0.5;
};

std::string round(double value, int digits) {
  char text[64];
  std::snprintf(text, sizeof text, "%.*f", digits, value);
  return text;
}

void run(const Options& options, bool json) {
  checkOutputs({options.lens}, {options.out});
  const LensFile file = readLensFile(options.lens);
  LensExport made;
  try {
    made = exportLens(file, options.format, options.model);
  } catch (const InputError&) {
    throw;
  } catch (const Error& error) {
    throw InputError(options.lens, "", error.what());
  }
  const std::string degrees = round(made.max_theta_rad * 90.0 / kHalfPi, 1);
  if (!(made.residual_rms_px <= options.max_residual_px)) {
    throw InputError(options.lens, "",
                     "the nearest " + made.model + " camera misses this lens by " +
                         round(made.residual_rms_px, 3) + " px RMS (" +
                         round(made.residual_max_px, 2) + " px at worst) over " + degrees +
                         " degrees off the axis, more than " +
                         formatNumber(options.max_residual_px) +
                         " px; another --format may come nearer, --max-residual PX allows it");
  }
  writeFileAtomically(options.out, made.text);
  if (made.max_theta_rad >= kHalfPi &&
      (made.model == "equidistant" || made.model == "pinhole-equidistant")) {
    say("the field reaches " + degrees +
        " degrees off the axis; OpenCV and Kalibr evaluate this model in front of the camera only");
  }

  nlohmann::ordered_json result;
  result["model"] = made.model;
  result["residual_rms_px"] = made.residual_rms_px;
  result["residual_max_px"] = made.residual_max_px;
  result["max_theta_rad"] = made.max_theta_rad;
  result["format"] = options.format;
  if (made.tried.size() > 1) {
    nlohmann::ordered_json tried;
    for (const auto& [name, rms] : made.tried) {
      tried[name] = std::isfinite(rms) ? nlohmann::ordered_json(rms) : nullptr;
    }
    result["tried_rms_px"] = tried;
  }
  result["out"] = options.out;
  printResult(json, result);
}

}  // namespace

void addExport(CLI::App& app) {
  CLI::App* command = app.add_subcommand("export", "A lens file to a foreign calibration");
  const auto options = std::make_shared<Options>();
  command->footer(
      "kalibr: a camchain with the nearest of eucm, ds, omni-radtan and pinhole-equidistant;\n"
      "ocam: OCamCalib text, polynomials both ways; equidistant: ROS camera_info.\n"
      "Residuals are over the field of the lens, as far as the image shows it.");
  command->add_option("lens", options->lens, "Lens file")->required();
  command->add_option("--format", options->format, "What to write")
      ->check(CLI::IsMember(exportFormats()))
      ->required();
  CLI::Option* model =
      command->add_option("--model", options->model, "Model of a camchain, else the nearest")
          ->check(CLI::IsMember(kalibrExportModels()));
  command->add_option("--out", options->out, "File to write")->required();
  command
      ->add_option("--max-residual", options->max_residual_px,
                   "Largest RMS over the field that is accepted [px]")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  const bool& json = addJsonFlag(*command);
  command->callback([options, model, &json] {
    if (model->count() > 0 && options->format != "kalibr") {
      throw CLI::ValidationError("--model", "is for --format kalibr only");
    }
    run(*options, json);
  });
}

}  // namespace omnister::tools
