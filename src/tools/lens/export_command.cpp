// SPDX-License-Identifier: Apache-2.0
// `export`: a lens file becomes a calibration that other programs read.
#include <cmath>
#include <memory>
#include <optional>

#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"
#include "omnister/common/text.h"
#include "omnister/lens/lens_export.h"
#include "tools/cli/commands.h"

namespace omnister::tools {
namespace {

constexpr double kHalfPi = 1.57079632679489661923;

struct Options {
  std::string lens;
  std::string format;
  std::string model;
  std::string out;
  double max_residual_px = 0.5;
  double max_theta_deg = 0.0;
  bool narrow = false;
};

void run(const Options& options, bool json) {
  checkOutputs({options.lens}, {options.out});
  const LensFile file = readLensFile(options.lens);
  LensExport made;
  std::string failure;
  if (!options.narrow) {
    try {
      std::optional<double> narrowed;
      if (options.max_theta_deg > 0.0) narrowed = options.max_theta_deg * kHalfPi / 90.0;
      made = exportLens(file, options.format, options.model, narrowed);
      if (!(made.residual_rms_px <= options.max_residual_px)) {
        failure = "the nearest " + made.model + " camera misses this lens by " +
                  formatFixed(made.residual_rms_px, 3) + " px RMS (" +
                  formatFixed(made.residual_max_px, 2) + " px at worst) over " +
                  formatFixed(made.max_theta_rad * 90.0 / kHalfPi, 1) +
                  " degrees off the axis, more than " + formatNumber(options.max_residual_px) +
                  " px";
        for (const std::string& remark : made.remarks) failure += "; " + remark;
      }
    } catch (const InputError&) {
      throw;
    } catch (const Error& error) {
      failure = error.what();
    }
  }
  if (options.narrow || !failure.empty()) {
    const auto widest = namingSource(options.lens, [&] {
      return exportWidest(file, options.format, options.model, options.max_residual_px);
    });
    if (options.narrow && widest) {
      made = *widest;
      const double whole = file.lens->maxTheta();
      if (made.max_theta_rad < whole - 1e-3) {
        say("only " + formatFixed(made.max_theta_rad * 90.0 / kHalfPi, 1) +
            " degrees off the axis are said, of the lens' " +
            formatFixed(whole * 90.0 / kHalfPi, 1) + ": rays beyond come out wrong");
      }
    } else if (options.narrow) {
      throw InputError(options.lens, "",
                       "no " + (options.model.empty() ? options.format : options.model) +
                           " camera comes within " + formatNumber(options.max_residual_px) +
                           " px RMS of this lens, not even over 10 degrees off the axis");
    } else {
      if (widest && widest->max_theta_rad > 1e-3) {
        failure += "; over " + formatFixed(widest->max_theta_rad * 90.0 / kHalfPi, 1) +
                   " degrees off the axis " + widest->model + " comes within " +
                   formatFixed(widest->residual_rms_px, 3) + " px: --narrow writes that";
      }
      throw InputError(
          options.lens, "",
          failure + "; another --format may come nearer, --max-residual PX allows more");
    }
  }
  const std::string degrees = formatFixed(made.max_theta_rad * 90.0 / kHalfPi, 1);
  for (const std::string& remark : made.remarks) say(remark);
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
  result["remarks"] = made.remarks;
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
      "kalibr: a camchain with the nearest of pinhole-equidistant, eucm, ds and omni-radtan;\n"
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
  CLI::Option* theta = command
                           ->add_option("--max-theta", options->max_theta_deg,
                                        "Say the lens only this far off the axis [degrees]")
                           ->check(CLI::Range(5.0, 179.0));
  command
      ->add_flag("--narrow", options->narrow,
                 "Say the lens as far off the axis as --max-residual allows")
      ->excludes(theta);
  const bool& json = addJsonFlag(*command);
  command->callback([options, model, &json] {
    if (model->count() > 0 && options->format != "kalibr") {
      throw CLI::ValidationError("--model", "is for --format kalibr only");
    }
    run(*options, json);
  });
}

}  // namespace omnister::tools
