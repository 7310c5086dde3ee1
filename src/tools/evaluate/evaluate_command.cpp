// SPDX-License-Identifier: Apache-2.0
#include <filesystem>
#include <memory>
#include <string>

#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "tools/cli/commands.h"
#include "tools/evaluate/evaluate_plane.h"
#include "tools/evaluate/evaluate_rig.h"
#include "tools/thesis/evaluate_thesis.h"

namespace omnister::tools {
namespace {

void addThesis(CLI::App& evaluate) {
  CLI::App* command = evaluate.add_subcommand(
      "thesis", "The measurements of Johnson 1997 again, on simulated boards");
  struct Arguments {
    std::string out;
    ThesisEvaluationOptions options;
  };
  auto arguments = std::make_shared<Arguments>();
  command->add_option("--out", arguments->out, "Folder for index.html and thesis.json")
      ->required()
      ->type_name("DIR");
  command
      ->add_option("--scale", arguments->options.scale,
                   "Size of the images beside the thesis' 3060x2036; less is quicker")
      ->check(CLI::Range(0.1, 2.0))
      ->capture_default_str();
  command
      ->add_option("--grid", arguments->options.grid,
                   "Spacing of the pixels whose depth is measured, at full size [px]")
      ->check(CLI::Range(8, 400))
      ->capture_default_str();
  command->add_option("--threads", arguments->options.threads, "Threads; 0: every core")
      ->check(CLI::Range(0, 1024));
  bool& json = addJsonFlag(*command);
  command->callback([arguments, &json] {
    arguments->options.progress = consoleProgress();
    std::error_code error;
    std::filesystem::create_directories(arguments->out, error);
    if (error) throw IoError("create", arguments->out, error.value());
    const ThesisEvaluation evaluation = evaluateThesis(arguments->options);
    const std::filesystem::path folder(arguments->out);
    writeFileAtomically(folder / "thesis.json", jsonText(evaluation.json, 2) + "\n");
    writeFileAtomically(folder / "index.html", evaluation.html);
    if (json) {
      printResult(true, evaluation.json);
      return;
    }
    nlohmann::ordered_json result;
    for (const auto& claim : evaluation.json.at("claims")) {
      result[claim.at("claim").get<std::string>()] =
          claim.at("holds").get<bool>() ? "holds" : "does not hold";
    }
    result["report"] = (folder / "index.html").string();
    printResult(false, result);
  });
}

}  // namespace

void addEvaluate(CLI::App& app) {
  CLI::App* command = app.add_subcommand("evaluate", "How good a result is");
  command->require_subcommand(1);
  addThesis(*command);
  addPlane(*command);
  addBoard(*command);
  addPair(*command);
}

}  // namespace omnister::tools
