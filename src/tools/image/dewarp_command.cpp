// SPDX-License-Identifier: Apache-2.0
#include <chrono>
#include <memory>
#include <opencv2/core.hpp>

#include "omnister/common/error.h"
#include "omnister/common/image_file.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_file.h"
#include "omnister/view/view.h"
#include "tools/cli/commands.h"

namespace omnister::tools {
namespace {

constexpr double kDegree = 3.14159265358979324 / 180.0;

struct Arguments {
  std::string lens, view = "0 0 0", projection = "pinhole", in, out;
  double hfov = 90.0;
  Size size{640, 480};
  bool plain = false;
};

void run(const Arguments& arguments, bool json) {
  checkImagePath(arguments.out);
  checkOutputs({arguments.lens, arguments.in}, {arguments.out});
  const auto angles = parseNumbers(arguments.view);
  if (!angles || angles->size() != 3 || !cv::checkRange(*angles)) {
    throw InputError(
        "--view", "",
        "is '" + printable(arguments.view) + "', expected \"pan tilt roll\" in degrees");
  }
  const LensFile lens = readLensFile(arguments.lens);
  const cv::Mat image = readImage(arguments.in);
  if (image.size() != lens.image_size) {
    throw InputError(arguments.in, "",
                     "is " + std::to_string(image.cols) + "x" + std::to_string(image.rows) +
                         ", but the lens belongs to " + std::to_string(lens.image_size.width) +
                         "x" + std::to_string(lens.image_size.height));
  }
  const ViewGeometry geometry = makeViewGeometry(
      projectionOf(arguments.projection), {arguments.size.width, arguments.size.height},
      arguments.hfov * kDegree,
      viewRotation((*angles)[0] * kDegree, (*angles)[1] * kDegree, (*angles)[2] * kDegree));
  const auto start = std::chrono::steady_clock::now();
  const View view(*lens.lens, lens.image_size, geometry, !arguments.plain);
  const auto made = std::chrono::steady_clock::now();
  const cv::Mat result = namingSource(arguments.in, [&] { return view.render(image); });
  const auto done = std::chrono::steady_clock::now();
  writeImage(arguments.out, result);

  nlohmann::ordered_json summary;
  summary["out"] = arguments.out;
  summary["focal_px"] = geometry.focal_px;
  summary["seen_fraction"] =
      cv::countNonZero(view.mask()) / static_cast<double>(geometry.size.area());
  summary["seconds"] = {{"maps", std::chrono::duration<double>(made - start).count()},
                        {"render", std::chrono::duration<double>(done - made).count()}};
  printResult(json, summary);
}

}  // namespace

void addDewarp(CLI::App& app) {
  CLI::App* command =
      app.add_subcommand("dewarp", "A virtual view: pan, tilt, roll and zoom in an image");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("--lens", arguments->lens, "Lens file")->required();
  command
      ->add_option("--view", arguments->view,
                   "\"pan tilt roll\" [deg]: right, down, clockwise are positive")
      ->capture_default_str();
  command->add_option("--hfov", arguments->hfov, "Horizontal field of the view [deg]")
      ->capture_default_str();
  command->add_option("--size", arguments->size, "Of the view, WxH [px]; default 640x480");
  command
      ->add_option("--projection", arguments->projection, "pinhole, cylindrical or equirectangular")
      ->check(CLI::IsMember({"pinhole", "cylindrical", "equirectangular"}))
      ->capture_default_str();
  command->add_flag("--no-anti-alias", arguments->plain,
                    "Do not smooth where the view shows the image smaller than it is");
  command->add_option("IN", arguments->in, "Image")->required();
  command->add_option("OUT", arguments->out, "View to write")->required();
  const bool& json = addJsonFlag(*command);
  command->callback([arguments, &json] { run(*arguments, json); });
}

}  // namespace omnister::tools
