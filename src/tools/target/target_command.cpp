// SPDX-License-Identifier: Apache-2.0
#include <cmath>
#include <filesystem>
#include <memory>

#include "omnister/calibration/target.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "tools/cli/commands.h"
#include "tools/target/target_print.h"

namespace omnister::tools {
namespace {

namespace fs = std::filesystem;

struct Arguments {
  std::string type, dictionary, page = "a4", out, yaml;
  int cols = 0;
  int rows = 0;
  double square_mm = 0.0;
  double marker_mm = 0.0;
  double dot_mm = 0.0;
  double spacing = 0.3;
  bool asymmetric = false;
  bool legacy = false;
  int border_bits = 2;
  bool plain_corners = false;
  bool joining_squares = false;
};

// The smallest dictionary of 4x4 bits that has a marker for every white square.
std::string smallestDictionary(int cols, int rows) {
  const int markers = (cols * rows + 1) / 2;
  for (const int size : {50, 100, 250}) {
    if (markers <= size) return "DICT_4X4_" + std::to_string(size);
  }
  return "DICT_4X4_1000";
}

// To the nanometre, so that 24.4 mm stand in the file as 0.0244 m.
double metres(double millimetres) { return std::round(1e6 * millimetres) / 1e9; }

Target makeTarget(const Arguments& arguments) {
  Target target;
  target.cols = arguments.cols;
  target.rows = arguments.rows;
  target.square_m = metres(arguments.square_mm);
  if (arguments.type == "checkerboard") {
    target.type = TargetType::kCheckerboard;
  } else if (arguments.type == "circles") {
    target.type = TargetType::kCircles;
    target.asymmetric = arguments.asymmetric;
    target.dot_m = metres(arguments.dot_mm);
  } else if (arguments.type == "charuco") {
    target.type = TargetType::kCharuco;
    target.marker_m = arguments.marker_mm > 0.0 ? metres(arguments.marker_mm)
                                                : metres(0.75 * arguments.square_mm);
    target.dictionary = arguments.dictionary.empty() ? smallestDictionary(target.cols, target.rows)
                                                     : arguments.dictionary;
    target.legacy = arguments.legacy;
  } else {
    target.type = TargetType::kAprilGrid;
    target.spacing = arguments.spacing;
    target.dictionary = arguments.dictionary.empty() ? "tag36h11" : arguments.dictionary;
    target.border_bits = arguments.border_bits;
    // Kalibr's tags come with the squares; a border of one bit is the inventors' own drawing.
    target.joining_squares =
        arguments.joining_squares || (arguments.border_bits == 2 && !arguments.plain_corners);
  }
  checkTarget(target, "target");
  return target;
}

void run(const Arguments& arguments, bool json) {
  const fs::path out = arguments.out;
  const std::string extension = out.extension().string();
  if (extension != ".pdf" && extension != ".svg") {
    throw InputError("--out", "",
                     "is '" + arguments.out + "', expected a name that ends in .pdf or .svg");
  }
  const fs::path yaml =
      arguments.yaml.empty() ? fs::path(out).replace_extension(".yaml") : fs::path(arguments.yaml);
  if (fs::absolute(yaml).lexically_normal() == fs::absolute(out).lexically_normal()) {
    throw InputError("--yaml", "", "is the same file as --out, expected another");
  }
  const Target target = makeTarget(arguments);
  const Layout layout = layOut(target, parsePage(arguments.page));
  const std::string drawing = extension == ".pdf" ? drawPdf(layout) : drawSvg(layout);
  writeFileAtomically(yaml, formatTarget(target));
  writeFileAtomically(out, drawing);

  nlohmann::ordered_json result;
  result["out"] = out.string();
  result["yaml"] = yaml.string();
  result["type"] = arguments.type;
  result["points"] = targetPoints(target).size();
  result["width_mm"] = 1e3 * metres(layout.width_mm);
  result["height_mm"] = 1e3 * metres(layout.height_mm);
  result["page"] = layout.page.name;
  result["page_width_mm"] = layout.page.width_mm;
  result["page_height_mm"] = layout.page.height_mm;
  printResult(json, result);
  if (target.type == TargetType::kAprilGrid) {
    say(target.border_bits == 2
            ? "The tags have Kalibr's border of two bits; --border-bits 1 prints the other."
            : "The tags have a border of one bit; Kalibr wants two, --border-bits 2.");
  }
  say("Print at 100 %, without fitting to the page, and check the bar of " +
      std::to_string(static_cast<int>(layout.bar_mm)) + " mm with a ruler.");
}

}  // namespace

void addTarget(CLI::App& app) {
  CLI::App* command =
      app.add_subcommand("target", "Print a calibration board at true scale, with its TARGET.yaml");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("--type", arguments->type, "Kind of board; coded ones may be seen in part")
      ->required()
      ->check(CLI::IsMember({"checkerboard", "circles", "charuco", "aprilgrid"}));
  command
      ->add_option(
          "--cols", arguments->cols,
          "Inner corners (checkerboard), dots (circles), squares (charuco) or tags (aprilgrid) "
          "a row")
      ->required();
  command->add_option("--rows", arguments->rows, "Rows of them")->required();
  command
      ->add_option("--square-mm,--tag-mm", arguments->square_mm,
                   "Side of a square, spacing of dots, or side of a tag [mm]")
      ->required();
  command->add_option("--marker-mm", arguments->marker_mm,
                      "charuco: side of a marker [mm]; default: three quarters of the square");
  command->add_option(
      "--dictionary", arguments->dictionary,
      "charuco: e.g. DICT_4X4_50 (default: the smallest of 4x4 bits that suffices); "
      "aprilgrid: tag36h11 (default), tag36h10, tag25h9 or tag16h5");
  command->add_flag("--legacy", arguments->legacy,
                    "charuco: layout of OpenCV before 4.6.0 (matters for an even number of rows)");
  command
      ->add_option("--spacing", arguments->spacing,
                   "aprilgrid: gap between tags as a share of the tag")
      ->capture_default_str();
  command
      ->add_option("--border-bits", arguments->border_bits,
                   "aprilgrid: width of a tag's black border: 2 as Kalibr prints it, with black "
                   "squares at the corners of the tags; 1 as the tags' inventors do, without")
      ->check(CLI::Range(1, 2))
      ->capture_default_str();
  CLI::Option* joining =
      command->add_flag("--joining-squares", arguments->joining_squares,
                        "aprilgrid: Kalibr's black squares at the corners of the tags, with "
                        "--border-bits 1 too; more accurate corners, slower to find");
  command
      ->add_flag("--no-joining-squares", arguments->plain_corners,
                 "aprilgrid: without these squares, with --border-bits 2 too")
      ->excludes(joining);
  command->add_flag("--asymmetric", arguments->asymmetric,
                    "circles: every second row shifted by the spacing");
  command->add_option("--dot-mm", arguments->dot_mm,
                      "circles: diameter of a dot [mm]; default: half the distance of neighbours");
  command
      ->add_option("--page", arguments->page,
                   "a0 to a4, letter, legal, tabloid, or WxH [mm]; turned to landscape if needed")
      ->capture_default_str();
  command->add_option("--out", arguments->out, "Drawing to write: BOARD.pdf or BOARD.svg")
      ->required();
  command->add_option("--yaml", arguments->yaml,
                      "TARGET.yaml to write; default: beside the drawing, by its name");
  bool& json = addJsonFlag(*command);
  command->callback([arguments, &json] { run(*arguments, json); });
}

}  // namespace omnister::tools
