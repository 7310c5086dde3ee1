// SPDX-License-Identifier: Apache-2.0
#include <console_bridge/console.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <memory>
#include <opencv2/core.hpp>
#include <string>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/image_file.h"
#include "omnister/common/numbers.h"
#include "omnister/stereo/cloud.h"
#include "ros/bag/bag_run.h"
#include "tools/cli/commands.h"

namespace omnister::tools {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

struct BagArguments {
  std::string bag;
  std::string out;
  std::string mode = "stage";
  std::string mask;
  std::string format = "ply";
  bool ranges = false;
  bool restart = false;
  BagRunOptions options;
};

std::string stampText(std::int64_t stamp_ns) {
  char text[40];
  std::snprintf(text, sizeof(text), "%lld.%09lld", static_cast<long long>(stamp_ns / 1000000000),
                static_cast<long long>(stamp_ns % 1000000000));
  return text;
}

// Enough to tell another file by: reading a bag of gigabytes for it would not do.
Json describeFile(const std::string& path) {
  if (path.empty()) return nullptr;
  std::error_code error;
  const auto size = fs::file_size(path, error);
  if (error) throw IoError("read", path, error.value());
  const auto time = fs::last_write_time(path, error).time_since_epoch().count();
  return {
      {"path", fs::absolute(path).lexically_normal().string()}, {"bytes", size}, {"time", time}};
}

// All that the clouds depend on.
Json describeRun(const BagArguments& arguments) {
  const BagRunOptions& options = arguments.options;
  return {{"version", 1},
          {"bag", describeFile(arguments.bag)},
          {"mode", arguments.mode},
          {"image", options.image},
          {"right_image", options.right_image},
          {"lens", describeFile(options.lens)},
          {"lens_displaced", describeFile(options.lens_displaced)},
          {"rig", describeFile(options.rig_file)},
          {"mask", describeFile(arguments.mask)},
          {"fixed_frame", options.fixed_frame},
          {"min_baseline", options.pairing.min_baseline},
          {"max_baseline", options.pairing.max_baseline},
          {"positions", options.pairing.positions},
          {"settle_time", options.pairing.settle_time},
          {"max_skew", options.max_skew},
          {"min_range", options.matching.min_range},
          {"max_range", options.matching.max_range},
          {"hypotheses", options.matching.hypotheses},
          {"matcher", options.matcher},
          {"format", arguments.format},
          {"ranges", arguments.ranges}};
}

// The folder of one run. A cloud is done when the note beside it stands there, which is written
// last: a run that was killed goes on with the cloud it was at.
class RunFolder {
 public:
  explicit RunFolder(const BagArguments& arguments)
      : arguments_(arguments), folder_(arguments.out) {
    // As it is read again: names need not be UTF-8.
    const Json run = Json::parse(jsonText(describeRun(arguments)));
    const fs::path path = folder_ / "run.json";
    if (fs::exists(path) && !arguments.restart) {
      Json other;
      try {
        other = Json::parse(readFile(path, 1u << 20));
      } catch (const nlohmann::json::exception&) {
        throw InputError(path.string(), "", "is not the note of a run: --restart begins anew");
      }
      for (const auto& [key, value] : run.items())
        if (!other.is_object() || other.value(key, Json()) != value)
          throw InputError(path.string(), key,
                           "is of a run with other settings or files: give another --out, or "
                           "--restart to begin anew");
      return;
    }
    std::error_code error;
    begun_ = fs::create_directories(folder_, error);
    if (error) throw IoError("make folder", folder_.string(), error.value());
    if (arguments.restart) clear();
    writeFileAtomically(path, jsonText(run, 2) + "\n");
  }

  /// A run that is refused leaves no folder behind that it began.
  void removeIfBegun() const {
    if (!begun_) return;
    std::error_code ignored;
    fs::remove(folder_ / "run.json", ignored);
    fs::remove(folder_, ignored);
  }

  bool has(std::int64_t stamp_ns) const { return fs::exists(notePath(stamp_ns)); }

  void write(const BagCloud& result) const {
    const std::string name = "cloud_" + stampText(result.stamp_ns);
    writeCloud(folder_ / (name + "." + arguments_.format), result.cloud);
    if (arguments_.ranges)
      writeRange(folder_ / ("range_" + stampText(result.stamp_ns) + ".tiff"), result.match.range);
    const std::size_t pixels = result.match.range.total();
    std::vector<float> relative;
    for (int v = 0; v < result.match.range.rows; ++v) {
      const float* range = result.match.range.ptr<float>(v);
      const float* sigma = result.match.sigma.ptr<float>(v);
      for (int u = 0; u < result.match.range.cols; ++u)
        if (std::isfinite(range[u]) && std::isfinite(sigma[u]))
          relative.push_back(sigma[u] / range[u]);
    }
    const auto half = relative.begin() + static_cast<std::ptrdiff_t>(relative.size() / 2);
    if (!relative.empty()) std::nth_element(relative.begin(), half, relative.end());
    Json note = {{"stamp", stampText(result.stamp_ns)},
                 {"frame_id", result.frame_id},
                 {"file", name + "." + arguments_.format},
                 {"positions", result.positions},
                 {"baseline_m", result.baseline_m},
                 {"valid", result.match.statistics.valid},
                 {"valid_fraction", static_cast<double>(result.match.statistics.valid) /
                                        static_cast<double>(std::max<std::size_t>(1, pixels))},
                 {"median_relative_sigma", relative.empty() ? Json(nullptr) : Json(*half)},
                 {"seconds", result.seconds}};
    writeFileAtomically(notePath(result.stamp_ns), jsonText(note) + "\n");
  }

  // The notes of this run and those it went on from, as a table in the order of time.
  std::vector<Json> writeTable() const {
    std::vector<fs::path> paths;
    for (const fs::directory_entry& entry : fs::directory_iterator(folder_))
      if (isNote(entry.path())) paths.push_back(entry.path());
    std::vector<Json> notes;
    for (const fs::path& path : paths) {
      try {
        notes.push_back(Json::parse(readFile(path, 1u << 20)));
        notes.back().at("stamp").get_ref<const std::string&>();
        notes.back().at("valid_fraction").get<double>();
      } catch (const nlohmann::json::exception&) {
        throw InputError(path.string(), "", "is not the note of a cloud: --restart begins anew");
      }
    }
    const auto stamp = [](const Json& note) {
      return parseNumber(note.at("stamp").get_ref<const std::string&>()).value_or(0.0);
    };
    std::stable_sort(notes.begin(), notes.end(),
                     [&](const Json& a, const Json& b) { return stamp(a) < stamp(b); });
    std::string table =
        "stamp,frame_id,file,positions,baseline_m,valid,valid_fraction,median_relative_sigma,"
        "seconds\n";
    for (const Json& note : notes) {
      std::string row;
      for (const auto& [key, value] : note.items())
        row += (row.empty() ? "" : ",") + (value.is_string() ? value.get<std::string>()
                                           : value.is_null() ? std::string("nan")
                                                             : jsonText(value));
      table += row + "\n";
    }
    writeFileAtomically(folder_ / "clouds.csv", table);
    return notes;
  }

 private:
  static bool isNote(const fs::path& path) {
    return path.extension() == ".json" && path.filename().string().rfind("cloud_", 0) == 0;
  }

  void clear() const {
    for (const fs::directory_entry& entry : fs::directory_iterator(folder_))
      if (isNote(entry.path())) fs::remove(entry.path());
  }

  fs::path notePath(std::int64_t stamp_ns) const {
    return folder_ / ("cloud_" + stampText(stamp_ns) + ".json");
  }

  const BagArguments& arguments_;
  const fs::path folder_;
  bool begun_ = false;  ///< the folder was not there before
};

[[noreturn]] void refuseWithoutImages(const std::string& bag, const BagRunSummary& summary) {
  std::string reasons;
  for (const auto& [reason, count] : summary.dropped)
    reasons += (reasons.empty() ? " (" : ", ") + std::to_string(count) + " times: " + reason;
  throw InputError(bag, "",
                   "holds no image that can be used" + (reasons.empty() ? "" : reasons + ")"));
}

void runBagCommand(BagArguments& arguments, bool json) {
  // What it says of a damaged bag comes before our message, which says the same.
  console_bridge::noOutputHandler();
  const auto start = std::chrono::steady_clock::now();
  arguments.options.rig = arguments.mode == "rig";
  arguments.options.pairing.history =
      static_cast<std::size_t>(std::max(0, arguments.options.pairing.positions)) + 7;
  if (!arguments.mask.empty())
    arguments.options.matching.mask = readImage(arguments.mask, ImageColor::kGray) != 0;
  const RunFolder folder(arguments);
  std::size_t clouds = 0;
  BagRunSummary summary;
  try {
    summary = runBag(
        arguments.bag, arguments.options, [&](std::int64_t stamp) { return !folder.has(stamp); },
        [&](const BagCloud& cloud) {
          folder.write(cloud);
          ++clouds;
        },
        consoleProgress());
    if (summary.images == 0) refuseWithoutImages(arguments.bag, summary);
  } catch (const Error&) {
    if (clouds == 0) folder.removeIfBegun();
    throw;
  }
  const std::vector<Json> notes = folder.writeTable();
  std::vector<double> valid;
  for (const Json& note : notes) valid.push_back(note.at("valid_fraction").get<double>());
  std::sort(valid.begin(), valid.end());
  const double seconds =
      std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  Json result = {
      {"images", summary.images},
      {"sets", summary.sets},
      {"clouds", clouds},
      {"clouds_before", notes.size() - clouds},
      {"median_valid_fraction", valid.empty() ? Json(nullptr) : Json(valid[valid.size() / 2])},
      {"frames", summary.frames},
      {"dropped", summary.dropped},
      {"recorded_seconds", summary.recorded_seconds},
      {"seconds", seconds}};
  printResult(json, result);
}

}  // namespace

void addBag(CLI::App& app) {
  CLI::App* command = app.add_subcommand(
      "bag",
      "Clouds of a whole recording, without a ROS master and as fast as it goes; killed, it "
      "goes on where it was");
  auto arguments = std::make_shared<BagArguments>();
  BagRunOptions& options = arguments->options;
  options.matching.max_range = 50.0;
  command->add_option("BAG", arguments->bag, "Recording with images and tf")->required();
  command->add_option("--out", arguments->out, "Folder for clouds, clouds.csv and run.json")
      ->required()
      ->type_name("DIR");
  command->add_option("--mode", arguments->mode, "One camera that moves, or two")
      ->check(CLI::IsMember({"stage", "rig"}))
      ->capture_default_str();
  command
      ->add_option("--image", options.image,
                   "Topic of the (left) images; default: the only image topic of the bag")
      ->type_name("TOPIC");
  command->add_option("--right-image", options.right_image, "rig: topic of the right images")
      ->type_name("TOPIC");
  command
      ->add_option("--lens", options.lens,
                   "Lens file; default: the latest on CAMERA/lens_model in the bag")
      ->type_name("LENS.yaml");
  command
      ->add_option("--lens-displaced", options.lens_displaced, "rig: lens file of the right camera")
      ->type_name("LENS.yaml");
  command->add_option("--rig", options.rig_file, "rig: pose and lenses of both; default: tf")
      ->type_name("RIG.yaml");
  command
      ->add_option("--fixed-frame", options.fixed_frame,
                   "stage: tf frame in which the scene stands still")
      ->capture_default_str();
  const auto number = [&](const char* name, double& value, double low, double high,
                          const char* help) {
    command->add_option(name, value, help)->check(CLI::Range(low, high))->capture_default_str();
  };
  number("--min-baseline", options.pairing.min_baseline, 1e-6, 1e3,
         "stage: least distance of displaced frames [m]");
  number("--max-baseline", options.pairing.max_baseline, 1e-6, 1e3,
         "stage: largest distance of displaced frames [m]");
  number("--settle-time", options.pairing.settle_time, 0.0, 10.0,
         "stage: the camera rests this long around a frame [s]; 0 for recordings made in motion");
  command->add_option("--positions", options.pairing.positions, "stage: displaced frames in a set")
      ->check(CLI::Range(1, 16))
      ->capture_default_str();
  number("--max-skew", options.max_skew, 0.0, 1.0, "rig: largest difference of stamps [s]");
  number("--min-range", options.matching.min_range, 0.0, 1e4, "Least range along the ray [m]");
  number("--max-range", options.matching.max_range, 0.0, 1e4,
         "Largest range along the ray [m]; 0: no limit");
  command
      ->add_option("--hypotheses", options.matching.hypotheses,
                   "Most candidates a pixel; 0: one for every pixel of parallax")
      ->capture_default_str();
  command->add_option("--matcher", options.matcher, "How to match")
      ->check(CLI::IsMember({"sweep", "thesis"}))
      ->capture_default_str();
  command->add_option("--threads", options.matching.threads, "Threads; 0: every core")
      ->check(CLI::Range(0, 1024))
      ->capture_default_str();
  command->add_option("--mask", arguments->mask, "Image; pixels that are 0 in it are left out")
      ->type_name("IMAGE");
  command->add_option("--format", arguments->format, "Of the clouds")
      ->check(CLI::IsMember({"ply", "pcd"}))
      ->capture_default_str();
  command->add_flag("--ranges", arguments->ranges, "Also write range images (TIFF)");
  command->add_flag("--restart", arguments->restart, "Begin anew in a folder that holds a run");
  bool& json = addJsonFlag(*command);
  command->callback([arguments, &json] { runBagCommand(*arguments, json); });
}

}  // namespace omnister::tools
