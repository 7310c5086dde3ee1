// SPDX-License-Identifier: Apache-2.0
#include <malloc.h>
#include <sys/mman.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstring>
#include <fstream>
#include <iostream>
#include <map>
#include <memory>
#include <opencv2/core/utility.hpp>
#include <opencv2/imgproc.hpp>
#include <sstream>
#include <string>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/common/image_circle.h"
#include "omnister/common/image_file.h"
#include "omnister/common/numbers.h"
#include "omnister/common/parallel.h"
#include "omnister/lens/lens_file.h"
#include "omnister/lens/reduced_lens.h"
#include "omnister/stereo/cloud.h"
#include "omnister/stereo/input_region.h"
#include "omnister/stereo/matcher.h"
#include "omnister/stereo/matching_limits.h"
#include "omnister/stereo/pose_doubt.h"
#include "omnister/stereo/presets.h"
#include "omnister/stereo/thesis_matcher.h"
#include "tools/cli/commands.h"

namespace omnister::tools {
namespace {

using Clock = std::chrono::steady_clock;

double secondsSince(Clock::time_point start) {
  return std::chrono::duration<double>(Clock::now() - start).count();
}

struct StereoArguments {
  std::string lens;
  std::vector<std::string> lens_displaced;
  std::string reference;
  std::vector<std::string> displaced;
  std::vector<std::string> poses;
  std::string mask;
  std::string prior;
  std::string roi;
  std::vector<std::string> pose_sigmas;
  int reduce = 1;
  std::string preset;
  std::string matcher = "sweep";
  std::string thesis_mask = "fig5.5";
  int thesis_window = 11;
  MatcherOptions options;
  int repeat = 1;
  std::string cloud;
  std::string range;
};

// A figure of /proc/self/status [MiB], e.g. "VmHWM:"; 0 where the system has none.
double memoryFigure(const char* name) {
  std::ifstream status("/proc/self/status");
  std::string line;
  while (std::getline(status, line)) {
    if (line.rfind(name, 0) == 0) return std::atof(line.c_str() + std::strlen(name)) / 1024.0;
  }
  return 0.0;
}

// Memory of the matching alone. It begins with what a process would hold that has just the images
// and the outputs, all of them touched; from there on the peak counts anew, so that decoding does
// not hide in it.
class WorkingMemory {
 public:
  explicit WorkingMemory(std::size_t output_bytes) {
    // What decoding left in the heap would else be there for the matcher to use without being
    // counted.
    ::malloc_trim(0);
    void* outputs = ::mmap(nullptr, output_bytes, PROT_READ | PROT_WRITE,
                           MAP_PRIVATE | MAP_ANONYMOUS | MAP_POPULATE, -1, 0);
    baseline_ = memoryFigure("VmRSS:");
    if (outputs != MAP_FAILED) ::munmap(outputs, output_bytes);
    peak_before_ = memoryFigure("VmHWM:");
    std::ofstream("/proc/self/clear_refs") << "5";
  }

  double working() const { return std::max(0.0, memoryFigure("VmHWM:") - baseline_); }
  double peak() const { return std::max(peak_before_, memoryFigure("VmHWM:")); }

 private:
  double baseline_ = 0.0;
  double peak_before_ = 0.0;
};

std::string sizeText(cv::Size size) {
  return std::to_string(size.width) + "x" + std::to_string(size.height);
}

cv::Mat readMatchingImage(const std::string& path, const std::string& lens_path,
                          cv::Size lens_size) {
  cv::Mat image = readImage(path);
  if (image.depth() != CV_8U && image.depth() != CV_16U) {
    throw InputError(path, "", "is not an image of 8 or 16 bits a channel");
  }
  if (image.size() != lens_size) {
    throw InputError(path, "",
                     "is " + sizeText(image.size()) + ", but the lens " + printable(lens_path) +
                         " is for " + sizeText(lens_size));
  }
  return image;
}

// 16-bit images go to 8 bits by the smallest number of bits that holds all of them: a 12-bit camera
// in 16-bit files keeps its contrast, and all images keep one scale.
void scaleTo8Bit(const std::vector<cv::Mat*>& images) {
  double largest = 0.0;
  for (const cv::Mat* image : images) {
    if (image->depth() == CV_8U) continue;
    double most = 0.0;
    cv::minMaxLoc(image->reshape(1), nullptr, &most);
    largest = std::max(largest, most);
  }
  int bits = 8;
  while (bits < 16 && std::ldexp(1.0, bits) <= largest) ++bits;
  for (cv::Mat* image : images) {
    if (image->depth() == CV_16U) {
      image->convertTo(*image, CV_8U, 255.0 / (std::ldexp(1.0, bits) - 1.0));
    }
  }
}

cv::Mat greyOf(const cv::Mat& image) {
  cv::Mat grey;
  if (image.channels() == 1) return image;
  cv::cvtColor(image, grey, image.channels() == 4 ? cv::COLOR_BGRA2GRAY : cv::COLOR_BGR2GRAY);
  return grey;
}

void checkFiles(const StereoArguments& arguments) {
  if (!arguments.cloud.empty()) checkCloudPath(arguments.cloud);
  if (!arguments.range.empty()) checkRangePath(arguments.range);
  std::vector<std::string> inputs = {arguments.lens, arguments.reference, arguments.mask,
                                     arguments.prior};
  inputs.insert(inputs.end(), arguments.lens_displaced.begin(), arguments.lens_displaced.end());
  inputs.insert(inputs.end(), arguments.displaced.begin(), arguments.displaced.end());
  checkOutputs(inputs, {arguments.cloud, arguments.range});
}

cv::Mat readPrior(const std::string& path, cv::Size size) {
  const cv::Mat prior = readImage(path);
  if (prior.type() != CV_32FC1 || prior.size() != size) {
    throw InputError(path, "",
                     "is not a range image (32-bit float, one channel) of " + sizeText(size) +
                         ", the size of the cloud");
  }
  return prior;
}

// "metres radians": standard deviations of each coordinate of the place and of each rotation.
Eigen::MatrixXd parsePoseSigma(const std::string& text) {
  std::istringstream stream(text);
  std::string place, rotation, rest;
  stream >> place >> rotation;
  const auto metres = parseNumber(place), radians = parseNumber(rotation);
  if (!metres || !radians || !(*metres >= 0.0 && *metres <= 1e3) ||
      !(*radians >= 0.0 && *radians <= 3.2) || (stream >> rest)) {
    throw Error("--pose-sigma is '" + printable(text) +
                "', expected two numbers, of the place [m] and of the rotation [rad]");
  }
  Eigen::VectorXd variances(6);
  variances << Eigen::Vector3d::Constant(*metres * *metres),
      Eigen::Vector3d::Constant(*radians * *radians);
  return variances.asDiagonal();
}

// What a lens leaves dark on a sensor larger than its image says nothing of the scene, and noise in
// it matches noise. Found where it takes a part of the lens' field.
struct Surround {
  cv::Mat mask;  // CV_8UC1; empty where the picture fills the field
  std::string remark;
};

Surround findSurround(const cv::Mat& image, const LensModel& lens) {
  constexpr double kRim = 2.0;           // half grey, half black [px]
  constexpr double kLeastShare = 0.005;  // of the field
  constexpr int kStep = 4;               // [px]
  Surround surround;
  const auto circle = findImageCircle({image});
  if (!circle) return surround;
  std::size_t field = 0;
  std::size_t dark = 0;
  for (int v = 0; v < image.rows; v += kStep) {
    for (int u = 0; u < image.cols; u += kStep) {
      const Eigen::Vector2d pixel(u, v);
      if (!lens.unproject(pixel)) continue;
      ++field;
      dark += (pixel - circle->center).norm() > circle->radius;
    }
  }
  if (static_cast<double>(dark) < kLeastShare * static_cast<double>(field)) return surround;
  surround.mask = circleMask(*circle, image.size(), kRim);
  surround.remark = "the picture is a disc of radius " +
                    std::to_string(static_cast<int>(std::lround(circle->radius))) + " px about (" +
                    std::to_string(static_cast<int>(std::lround(circle->center.x()))) + ", " +
                    std::to_string(static_cast<int>(std::lround(circle->center.y()))) +
                    "), smaller than the lens' field: the black around it is left out; --mask says "
                    "otherwise";
  return surround;
}

struct Inputs {
  std::string surround;  // remark on what was left out, may be empty
  StereoGeometry geometry;
  cv::Mat reference;               // CV_8UC1
  cv::Mat color;                   // CV_8UC1 or CV_8UC3, for the cloud
  std::vector<cv::Mat> displaced;  // CV_8UC1
};

// Everything in a smaller image, with the lens of that image.
void reduceInputs(int factor, Inputs* inputs) {
  StereoGeometry& geometry = inputs->geometry;
  // What is one lens stays one.
  std::map<LensPtr, LensPtr> lenses;
  const auto shrink = [&](LensPtr& lens, cv::Size& size, const char* whose) {
    LensPtr& small = lenses[lens];
    if (!small) small = reducedLens(lens, factor);
    lens = small;
    size = size / factor;
    if (size.width < 16 || size.height < 16) {
      throw Error(std::string("reduced ") + std::to_string(factor) + " times the " + whose +
                  " image would be " + sizeText(size) + ", expected 16x16 or more");
    }
  };
  shrink(geometry.reference_lens, geometry.reference_size, "reference");
  for (auto& displaced : geometry.displaced) shrink(displaced.lens, displaced.size, "displaced");
  inputs->reference = reducedImage(inputs->reference, factor);
  inputs->color = reducedImage(inputs->color, factor);
  for (cv::Mat& image : inputs->displaced) image = reducedImage(image, factor);
}

Inputs readInputs(StereoArguments& arguments) {
  const std::size_t count = arguments.displaced.size();
  if (arguments.poses.size() != count) {
    throw Error(std::to_string(count) + " displaced image(s) but " +
                std::to_string(arguments.poses.size()) +
                " pose(s): give one --pose for each --displaced");
  }
  if (arguments.lens_displaced.size() > 1 && arguments.lens_displaced.size() != count) {
    throw Error(std::to_string(count) + " displaced image(s) but " +
                std::to_string(arguments.lens_displaced.size()) +
                " lenses: give --lens-displaced once for all, or one for each --displaced");
  }
  if (arguments.pose_sigmas.size() > 1 && arguments.pose_sigmas.size() != count) {
    throw Error(std::to_string(count) + " displaced image(s) but " +
                std::to_string(arguments.pose_sigmas.size()) +
                " --pose-sigma: give it once for all, or once for each --displaced");
  }
  Inputs inputs;
  const LensFile lens = readLensFile(arguments.lens);
  inputs.geometry.reference_lens = lens.lens;
  inputs.geometry.reference_size = lens.image_size;
  if (lens.covariance) inputs.geometry.reference_covariance = *lens.covariance;
  std::vector<std::string> lens_paths(count, arguments.lens);
  // One file is one lens, so that what it is wrong by is known to move both images alike.
  std::map<std::string, LensFile> lenses = {{arguments.lens, lens}};
  for (std::size_t i = 0; i < count; ++i) {
    if (!arguments.lens_displaced.empty()) {
      lens_paths[i] = arguments.lens_displaced[arguments.lens_displaced.size() > 1 ? i : 0];
    }
    auto known = lenses.find(lens_paths[i]);
    if (known == lenses.end()) {
      known = lenses.emplace(lens_paths[i], readLensFile(lens_paths[i])).first;
    }
    StereoGeometry::Displaced displaced;
    displaced.lens = known->second.lens;
    displaced.size = known->second.image_size;
    displaced.T_ref_disp = parsePose(arguments.poses[i], "--pose");
    if (known->second.covariance) displaced.covariance = *known->second.covariance;
    if (!arguments.pose_sigmas.empty()) {
      displaced.pose_covariance =
          parsePoseSigma(arguments.pose_sigmas[arguments.pose_sigmas.size() > 1 ? i : 0]);
    }
    inputs.geometry.displaced.push_back(displaced);
  }
  inputs.color = readMatchingImage(arguments.reference, arguments.lens, lens.image_size);
  std::vector<cv::Mat*> images = {&inputs.color};
  inputs.displaced.resize(count);
  for (std::size_t i = 0; i < count; ++i) {
    inputs.displaced[i] =
        readMatchingImage(arguments.displaced[i], lens_paths[i], inputs.geometry.displaced[i].size);
    images.push_back(&inputs.displaced[i]);
  }
  scaleTo8Bit(images);
  inputs.reference = greyOf(inputs.color);
  if (inputs.color.channels() == 4) cv::cvtColor(inputs.color, inputs.color, cv::COLOR_BGRA2BGR);
  for (cv::Mat& image : inputs.displaced) image = greyOf(image);
  cv::Mat mask;
  if (!arguments.mask.empty()) {
    mask = readImage(arguments.mask, ImageColor::kGray);
    if (mask.size() != lens.image_size) {
      throw InputError(arguments.mask, "",
                       "is " + sizeText(mask.size()) + ", but the lens " +
                           printable(arguments.lens) + " is for " + sizeText(lens.image_size));
    }
  }
  if (mask.empty()) {
    Surround surround = findSurround(inputs.reference, *lens.lens);
    mask = surround.mask;
    inputs.surround = std::move(surround.remark);
  }
  const cv::Rect region = parseRegion(arguments.roi, lens.image_size, "--roi");
  if (arguments.reduce > 1) reduceInputs(arguments.reduce, &inputs);
  arguments.options.mask = matchingMask(mask, region, lens.image_size, arguments.reduce);
  if (!arguments.prior.empty())
    arguments.options.prior = readPrior(arguments.prior, inputs.geometry.reference_size);
  return inputs;
}

std::unique_ptr<Matcher> makeNamedMatcher(const StereoArguments& arguments,
                                          const StereoGeometry& geometry) {
  if (arguments.matcher != "thesis") {
    return makeMatcher(arguments.matcher, geometry, arguments.options);
  }
  ThesisOptions thesis;
  thesis.mask = parseThesisMask(arguments.thesis_mask);
  thesis.window = arguments.thesis_window;
  return makeThesisMatcher(geometry, arguments.options, thesis);
}

double median(std::vector<double> values) {
  std::sort(values.begin(), values.end());
  const std::size_t half = values.size() / 2;
  return values.size() % 2 == 1 ? values[half] : 0.5 * (values[half - 1] + values[half]);
}

void runStereo(StereoArguments& arguments, bool json) {
  checkFiles(arguments);
  cv::setNumThreads(threadCount(std::clamp(arguments.options.threads, 0, kMaxThreads)));

  if (!arguments.preset.empty()) {
    const MatchingPreset& preset = matchingPreset(arguments.preset);
    arguments.reduce = preset.reduce;
    arguments.options.refine = preset.refine;
  }
  auto start = Clock::now();
  const char* for_the_sweep = arguments.options.refine                            ? "--refine"
                              : !arguments.prior.empty()                          ? "--prior"
                              : arguments.options.cost != MatchCost::kCensus      ? "--cost"
                              : arguments.options.window != MatchWindow::kSurface ? "--window"
                                                                                  : nullptr;
  if (arguments.matcher == "thesis" && for_the_sweep != nullptr) {
    throw Error(std::string(for_the_sweep) + " is for the sweep, not for the thesis' matcher");
  }
  if (arguments.reduce < 1 || arguments.reduce > 64) {
    throw Error("--reduce is " + std::to_string(arguments.reduce) + ", expected 1 to 64");
  }
  const Inputs inputs = readInputs(arguments);
  const double read_seconds = secondsSince(start);
  // Fails here with a clear message rather than in the matcher.
  const MatchingLimits limits = checkMatching(inputs.geometry, arguments.options);

  // Outputs: range, sigma, score and x, y, z as floats, and the colour.
  const std::size_t pixels = inputs.reference.total();
  const WorkingMemory memory(pixels * (6 * sizeof(float) + 3));

  start = Clock::now();
  const std::unique_ptr<Matcher> matcher = makeNamedMatcher(arguments, inputs.geometry);
  const PointMaker points(*inputs.geometry.reference_lens, inputs.geometry.reference_size,
                          arguments.options.threads);
  const double setup_seconds = secondsSince(start);

  MatchResult match;
  Cloud cloud;
  std::map<std::string, std::vector<double>> stages;
  for (int i = 0; i < arguments.repeat; ++i) {
    match = {};
    cloud = {};
    match = matcher->match(inputs.reference, inputs.displaced);
    start = Clock::now();
    cloud = points.make(match, inputs.color, arguments.options.threads);
    const double cloud_seconds = secondsSince(start);
    for (const auto& [stage, seconds] : match.statistics.seconds) {
      if (stage != "total") stages[stage].push_back(seconds);
    }
    stages["cloud"].push_back(cloud_seconds);
    stages["total"].push_back(match.statistics.seconds.at("total") + cloud_seconds);
  }
  const double working_memory = memory.working();
  const std::size_t field = points.countField(arguments.options.mask);

  // All that can fail is done before the first output appears.
  start = Clock::now();
  std::vector<std::unique_ptr<AtomicFile>> outputs;
  if (!arguments.cloud.empty()) outputs.push_back(stageCloud(arguments.cloud, cloud));
  if (!arguments.range.empty()) outputs.push_back(stageRange(arguments.range, match.range));
  for (const auto& output : outputs) output->commit();
  const double write_seconds = secondsSince(start);

  nlohmann::ordered_json result;
  result["matcher"] = arguments.matcher;
  result["width"] = inputs.reference.cols;
  result["height"] = inputs.reference.rows;
  result["min_range_m"] = limits.min_range;
  result["max_range_m"] = std::isfinite(limits.max_range) ? nlohmann::ordered_json(limits.max_range)
                                                          : nlohmann::ordered_json(nullptr);
  result["hypotheses"] = limits.hypotheses;
  result["baseline_m"] = limits.longest_baseline;
  result["valid"] = match.statistics.valid;
  result["valid_fraction"] =
      field > 0 ? static_cast<double>(match.statistics.valid) / static_cast<double>(field) : 0.0;
  for (const auto& [reason, count] : match.statistics.rejected) result["rejected"][reason] = count;
  // Of images that give little: why.
  std::vector<std::string> remarks = imageRemarks(inputs.reference, inputs.displaced);
  const double share =
      field > 0 ? static_cast<double>(match.statistics.valid) / static_cast<double>(field) : 0.0;
  if (share < kDoubtfulShare && remarks.empty() && inputs.displaced.size() == 1) {
    if (const auto doubt =
            poseDoubt(inputs.geometry, arguments.options, inputs.reference, inputs.displaced[0])) {
      remarks.push_back(*doubt);
    }
  }
  if (!inputs.surround.empty()) remarks.push_back(inputs.surround);
  for (const std::string& remark : remarks) {
    result["remarks"].push_back(remark);
    std::cerr << "omnister: " << remark << '\n';
  }
  if (match.statistics.valid == 0 && remarks.empty()) {
    std::cerr << "omnister: no pixel got a range; rejected by test:";
    for (const auto& [reason, count] : match.statistics.rejected)
      if (count > 0) std::cerr << ' ' << reason << ' ' << count;
    std::cerr << '\n';
  }
  result["threads"] = threadCount(arguments.options.threads);
  result["repeat"] = arguments.repeat;
  nlohmann::ordered_json& seconds = result["seconds"];
  seconds["read"] = read_seconds;
  seconds["setup"] = setup_seconds;
  for (const auto& [stage, values] : stages) {
    if (stage != "total") seconds[stage] = median(values);
  }
  seconds["write"] = write_seconds;
  seconds["total"] = median(stages["total"]);
  result["working_memory_mb"] = working_memory;
  result["peak_memory_mb"] = memory.peak();
  printResult(json, result);
}

}  // namespace

void addStereo(CLI::App& app) {
  CLI::App* command = app.add_subcommand(
      "stereo", "Range for every pixel of a wide-angle image, from one or more displaced ones");
  auto arguments = std::make_shared<StereoArguments>();
  // Each takes one value, so that values that begin with "-" are not taken for options.
  const auto repeatable = [&](const char* name, std::vector<std::string>& values,
                              const char* help) {
    return command->add_option(name, values, help)->allow_extra_args(false);
  };
  command->add_option("--lens", arguments->lens, "Lens file of the reference camera")
      ->required()
      ->type_name("LENS.yaml");
  repeatable("--lens-displaced", arguments->lens_displaced,
             "Lens file of the displaced camera: once for all, or one for each --displaced; "
             "default: the reference camera's")
      ->type_name("LENS.yaml");
  command
      ->add_option("--reference", arguments->reference,
                   "Reference image, 8 or 16 bit, grey or colour")
      ->required()
      ->type_name("IMAGE");
  repeatable("--displaced", arguments->displaced, "Displaced image; may be given again for more")
      ->required()
      ->type_name("IMAGE");
  repeatable("--pose", arguments->poses,
             "T_ref_disp, one for each --displaced: \"tx ty tz qx qy qz qw\" [m], which maps "
             "coordinates of the displaced camera into the reference camera")
      ->type_name("POSE");
  repeatable("--pose-sigma", arguments->pose_sigmas,
             "How well a pose is known, \"metres radians\": standard deviations of each coordinate "
             "of the place and of each rotation, which make part of sigma as the lens files' "
             "covariances do; once for all, or one for each --displaced; default: exact")
      ->type_name("SIGMAS");
  command
      ->add_option("--min-range", arguments->options.min_range,
                   "Least range along the ray [m]; 0: four baselines")
      ->capture_default_str();
  command
      ->add_option("--max-range", arguments->options.max_range,
                   "Largest range along the ray [m]; 0: no limit")
      ->capture_default_str();
  command
      ->add_option("--hypotheses", arguments->options.hypotheses,
                   "Most candidates a pixel; 0: one for every pixel of parallax")
      ->capture_default_str();
  command->add_option("--matcher", arguments->matcher, "How to match")
      ->check(CLI::IsMember({"sweep", "thesis"}))
      ->capture_default_str();
  command
      ->add_option_function<std::string>(
          "--cost",
          [arguments](const std::string& name) { arguments->options.cost = parseMatchCost(name); },
          "How the sweep compares windows: census, zncc (grey values without their means) or eq3.1 "
          "of the thesis (grey values as they are: for images of one exposure)")
      ->check(CLI::IsMember({"census", "zncc", "eq3.1"}))
      ->default_str("census");
  command
      ->add_option_function<std::string>(
          "--window",
          [arguments](const std::string& name) {
            arguments->options.window = parseMatchWindow(name);
          },
          "How the sweep's windows stand: as the surfaces seen in coarser images, normal to the "
          "ray, "
          "parallel to the image plane (fronto), or the better of these two (best)")
      ->check(CLI::IsMember({"surface", "ray", "fronto", "best"}))
      ->default_str("surface");
  command
      ->add_option("--thesis-mask", arguments->thesis_mask,
                   "Mask of the thesis matcher: a square of dewarped space (fig5.4) or of distinct "
                   "pixels of the distorted image (fig5.5)")
      ->check(CLI::IsMember({"fig5.4", "fig5.5"}))
      ->capture_default_str();
  command->add_option("--thesis-window", arguments->thesis_window, "Side of that mask, odd [px]")
      ->capture_default_str();
  std::vector<std::string> presets;
  for (const MatchingPreset& preset : matchingPresets()) presets.push_back(preset.name);
  CLI::Option* preset =
      command
          ->add_option("--preset", arguments->preset,
                       "fast: images of half the size; balanced: as they are; accurate: --refine")
          ->check(CLI::IsMember(presets));
  CLI::Option* refine = command->add_flag(
      "--refine", arguments->options.refine,
      "Let grey values have the last word on a pair's ranges: a quarter less error for a few "
      "times the time; several displaced images always are refined");
  command->add_option("--threads", arguments->options.threads, "Threads; 0: every core")
      ->check(CLI::Range(0, 1024))
      ->capture_default_str();
  command
      ->add_option("--repeat", arguments->repeat,
                   "Match the same images this often after one set-up; times are the medians")
      ->check(CLI::Range(1, 100000))
      ->capture_default_str();
  command
      ->add_option("--mask", arguments->mask,
                   "Image of the reference size; pixels that are 0 in it are left out")
      ->type_name("IMAGE");
  command
      ->add_option(
          "--roi", arguments->roi,
          "Region of interest of the reference image, \"x,y,width,height\" [px]; what lies "
          "around it is left out")
      ->type_name("X,Y,W,H");
  CLI::Option* reduce = command
                            ->add_option("--reduce", arguments->reduce,
                                         "Reduce the images so many times, and the cloud with them")
                            ->capture_default_str();
  command
      ->add_option("--prior", arguments->prior,
                   "Range image of the cloud's size, of a frame before: it stands where the images "
                   "find nothing themselves but their grey values confirm it")
      ->type_name("RANGE.tiff");
  command->add_option("--cloud", arguments->cloud, "Organized cloud to write")
      ->type_name("OUT.ply|OUT.pcd");
  command
      ->add_option("--range", arguments->range,
                   "Range image to write: 32-bit float, along the ray [m], NaN where invalid")
      ->type_name("OUT.tiff");
  preset->excludes(refine)->excludes(reduce);
  bool& json = addJsonFlag(*command);
  command->footer(
      "seconds.total is the matching and the points of one frame, images in memory; read, setup "
      "and write "
      "stand beside it. valid_fraction is the share of the pixels inside the lens' field (and the "
      "mask) that got a range. working_memory_mb is the peak of set-up, matching and points less "
      "what a "
      "process holds with just the images and the outputs [MiB].");
  command->callback([arguments, &json] { runStereo(*arguments, json); });
}

}  // namespace omnister::tools
