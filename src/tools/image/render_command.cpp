// SPDX-License-Identifier: Apache-2.0
#include <chrono>
#include <limits>
#include <memory>
#include <opencv2/core.hpp>

#include "omnister/common/image_file.h"
#include "omnister/common/pose.h"
#include "omnister/lens/lens_file.h"
#include "omnister/sim/renderer.h"
#include "omnister/stereo/cloud.h"
#include "tools/cli/commands.h"

namespace omnister::tools {
namespace {

struct Arguments {
  std::string lens, scene, pose = "0 0 0 0 0 0 1", out, range;
  sim::RenderOptions options;
  bool grey = false;
};

void run(const Arguments& arguments, bool json) {
  checkImagePath(arguments.out);
  if (!arguments.range.empty()) checkRangePath(arguments.range);
  checkOutputs({arguments.lens, arguments.scene}, {arguments.out, arguments.range});
  const LensFile lens = readLensFile(arguments.lens);
  const sim::ScenePtr scene = sim::readScene(arguments.scene);
  const Pose T_world_camera = parsePose(arguments.pose, "--pose");

  const auto start = std::chrono::steady_clock::now();
  const sim::Rendering rendering =
      sim::render(*scene, *lens.lens, lens.image_size, T_world_camera, arguments.options);
  const std::chrono::duration<double> spent = std::chrono::steady_clock::now() - start;

  const auto image_file = stageImage(arguments.out, rendering.image);
  if (!arguments.range.empty()) stageRange(arguments.range, rendering.range)->commit();
  image_file->commit();

  // NOLINTNEXTLINE(misc-redundant-expression): what is NaN is not equal.
  const cv::Mat hit = rendering.range == rendering.range;
  double nearest = 0.0;
  double furthest = 0.0;
  cv::minMaxLoc(rendering.range, &nearest, &furthest, nullptr, nullptr, hit);
  nlohmann::ordered_json result;
  result["out"] = arguments.out;
  if (!arguments.range.empty()) result["range"] = arguments.range;
  result["width"] = lens.image_size.width;
  result["height"] = lens.image_size.height;
  result["pixels_with_range"] = cv::countNonZero(hit);
  result["min_range_m"] = nearest;
  result["max_range_m"] = furthest;
  result["seconds"] = spent.count();
  printResult(json, result);
}

}  // namespace

void addRender(CLI::App& app) {
  CLI::App* command = app.add_subcommand(
      "render", "Render a scene through a lens, with exact range along each ray");
  auto arguments = std::make_shared<Arguments>();
  command->add_option("--lens", arguments->lens, "Lens file; its size is the image's")->required();
  command->add_option("--scene", arguments->scene, "Scene file")->required();
  command->add_option(
      "--pose", arguments->pose,
      "T_world_camera as \"tx ty tz qx qy qz qw\" [m]; default: the world's own frame");
  command->add_option("--out", arguments->out, "Image to write")->required();
  command->add_option(
      "--range", arguments->range,
      "32-bit float TIFF of range along the ray [m] to write, NaN where nothing is");
  command->add_option("--supersampling", arguments->options.supersampling, "Rays a pixel and axis")
      ->check(CLI::Range(1, 16))
      ->capture_default_str();
  command->add_flag("--adaptive", arguments->options.adaptive,
                    "More than one ray a pixel only where surfaces meet: several times faster");
  command
      ->add_option("--noise", arguments->options.noise_sigma,
                   "Gaussian noise, sigma [grey levels of 255]")
      ->check(CLI::Range(0.0, 255.0))
      ->capture_default_str();
  command
      ->add_option("--vignetting", arguments->options.vignetting,
                   "0: none, 1: the fourth power of the cosine off the axis")
      ->check(CLI::Range(0.0, 1.0))
      ->capture_default_str();
  command->add_option("--seed", arguments->options.seed, "Of the noise")->capture_default_str();
  command->add_flag("--grey", arguments->grey, "One channel in place of three");
  command->add_option("--threads", arguments->options.threads, "0: every core")
      ->check(CLI::Range(0, 1024))
      ->capture_default_str();
  const bool& json = addJsonFlag(*command);
  command->callback([arguments, &json] {
    arguments->options.color = !arguments->grey;
    run(*arguments, json);
  });
}

}  // namespace omnister::tools
