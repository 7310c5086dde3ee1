// SPDX-License-Identifier: Apache-2.0
#include "omnister/device/replay_camera.h"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <set>
#include <thread>

#include "omnister/common/file_io.h"
#include "omnister/common/image_file.h"
#include "omnister/common/numbers.h"
#include "omnister/common/yaml_text.h"

namespace omnister::device {
namespace {

namespace fs = std::filesystem;
using Steady = std::chrono::steady_clock;
using std::chrono::milliseconds;
using std::chrono::nanoseconds;

constexpr std::size_t kMaxFrames = 1000000;
constexpr std::size_t kMaxFileBytes = 64u << 20;

/// Decimal seconds to nanoseconds without the rounding of a double.
std::optional<Stamp> parseStamp(const std::string& text) {
  const std::size_t point = text.find('.');
  const std::string whole = text.substr(0, point);
  std::string decimals = point == std::string::npos ? "" : text.substr(point + 1);
  const auto digits = [](const std::string& part) {
    return std::all_of(part.begin(), part.end(),
                       [](unsigned char c) { return std::isdigit(c) != 0; });
  };
  if (whole.empty() || whole.size() > 9 + 1 || !digits(whole) || !digits(decimals) ||
      (point != std::string::npos && decimals.empty())) {
    return std::nullopt;
  }
  decimals.resize(9, '0');
  const long long seconds = std::stoll(whole);
  if (seconds > 4294967295LL) return std::nullopt;
  return Stamp(nanoseconds(seconds * 1000000000LL + std::stoll(decimals)));
}

std::string scalarText(const YAML::Node& node) {
  return node.IsScalar() ? "\"" + printable(node.Scalar()) + "\""
         : node.IsNull() ? "empty"
                         : "a list or a mapping";
}

class Reader {
 public:
  Reader(std::string_view source, fs::path folder) : source_(source), folder_(std::move(folder)) {}

  Recording read(const YAML::Node& root) {
    if (!root.IsMap()) refuse("", "is not a mapping with version and frames");
    checkKeys(root, "", {"version", "rate", "lens", "encoding", "frames"});
    if (!root["version"] || scalarText(root["version"]) != "\"1\"") {
      refuse("version", root["version"] ? "is " + scalarText(root["version"]) + ", expected 1"
                                        : "is missing, expected 1");
    }
    Recording recording;
    recording.name = folder_.filename().string();
    if (root["rate"]) {
      recording.rate_hz = number(root["rate"], "rate");
      if (!(recording.rate_hz >= 1e-3 && recording.rate_hz <= 1e4)) {
        refuse("rate", "is " + scalarText(root["rate"]) + ", expected 0.001 to 10000 Hz");
      }
    }
    if (root["lens"]) recording.lens = folder_ / text(root["lens"], "lens");
    if (root["encoding"]) recording.encoding = text(root["encoding"], "encoding");
    const YAML::Node frames = root["frames"];
    if (!frames || !frames.IsSequence() || frames.size() == 0) {
      refuse("frames", "expected a list of at least one frame");
    }
    if (frames.size() > kMaxFrames) {
      refuse("frames", "has " + std::to_string(frames.size()) + " entries, expected at most " +
                           std::to_string(kMaxFrames));
    }
    for (const YAML::Node& node : frames) readFrame(node, &recording);
    return recording;
  }

 private:
  void readFrame(const YAML::Node& node, Recording* recording) const {
    const std::string place = "frames[" + std::to_string(recording->frames.size()) + "]";
    if (!node.IsMap()) refuse(place, "is not a mapping with image");
    checkKeys(node, place + ".", {"image", "stamp", "stage_position_m", "settled"});
    if (!node["image"]) refuse(place + ".image", "is missing");
    Recording::Entry entry;
    entry.image = folder_ / text(node["image"], place + ".image");
    if (node["stamp"]) {
      entry.stamp = parseStamp(text(node["stamp"], place + ".stamp"));
      if (!entry.stamp) {
        refuse(place + ".stamp",
               "is " + scalarText(node["stamp"]) + ", expected seconds since 1970");
      }
    }
    if (node["stage_position_m"]) {
      entry.stage_position_m = number(node["stage_position_m"], place + ".stage_position_m");
    }
    if (node["settled"]) {
      const std::string word = text(node["settled"], place + ".settled");
      if (word != "true" && word != "false") {
        refuse(place + ".settled", "is \"" + printable(word) + "\", expected true or false");
      }
      entry.settled = word == "true";
    }
    if (!recording->frames.empty()) {
      const Recording::Entry& previous = recording->frames.back();
      if (previous.stamp.has_value() != entry.stamp.has_value()) {
        refuse(place + ".stamp", "expected in all frames or in none");
      }
      if (entry.stamp && *entry.stamp <= *previous.stamp) {
        refuse(place + ".stamp",
               "is " + scalarText(node["stamp"]) + ", expected one after that of the frame before");
      }
    }
    recording->frames.push_back(std::move(entry));
  }

  void checkKeys(const YAML::Node& map, const std::string& prefix,
                 const std::set<std::string>& known) const {
    std::set<std::string> seen;
    for (const auto& item : map) {
      const std::string key = item.first.IsScalar() ? item.first.Scalar() : "?";
      if (!seen.insert(key).second) refuse(prefix + printable(key), "stands there twice");
      if (known.count(key) > 0) continue;
      std::string list;
      for (const std::string& name : known) list += (list.empty() ? "" : ", ") + name;
      refuse(prefix + printable(key), "is not known, expected one of " + list);
    }
  }

  std::string text(const YAML::Node& node, const std::string& place) const {
    if (!node.IsScalar() || node.Scalar().empty())
      refuse(place, "is " + scalarText(node) + ", expected text");
    return node.Scalar();
  }

  double number(const YAML::Node& node, const std::string& place) const {
    const std::optional<double> value = node.IsScalar() ? parseNumber(node.Scalar()) : std::nullopt;
    if (!value || !std::isfinite(*value)) {
      refuse(place, "is " + scalarText(node) + ", expected a finite number");
    }
    return *value;
  }

  [[noreturn]] void refuse(const std::string& place, const std::string& problem) const {
    throw InputError(source_, place, problem);
  }

  std::string source_;
  fs::path folder_;
};

bool isImageName(const fs::path& path) {
  std::string extension = path.extension().string();
  std::transform(extension.begin(), extension.end(), extension.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  static const std::set<std::string> kExtensions = {".png",  ".jpg", ".jpeg", ".tif",
                                                    ".tiff", ".bmp", ".pgm",  ".ppm"};
  return kExtensions.count(extension) > 0;
}

/// Encoding of an image as OpenCV reads it; empty for types that no camera gives.
std::string encodingOf(const cv::Mat& image) {
  switch (image.type()) {
    case CV_8UC1:
      return "mono8";
    case CV_8UC3:
      return "bgr8";
    case CV_8UC4:
      return "bgra8";
    case CV_16UC1:
      return "mono16";
    case CV_16UC3:
      return "bgr16";
    case CV_16UC4:
      return "bgra16";
    default:
      return "";
  }
}

/// The type that pixels of a recording's `encoding` have; nullopt for an encoding not offered here.
std::optional<int> typeOf(const std::string& encoding) {
  static const std::set<std::string> kBayer = {"rggb", "bggr", "gbrg", "grbg"};
  if (encoding == "mono8") return CV_8UC1;
  if (encoding == "mono16") return CV_16UC1;
  if (encoding == "bgr8") return CV_8UC3;
  if (encoding.rfind("bayer_", 0) == 0 && encoding.size() > 10 &&
      kBayer.count(encoding.substr(6, 4)) > 0) {
    if (encoding.substr(10) == "8") return CV_8UC1;
    if (encoding.substr(10) == "16") return CV_16UC1;
  }
  return std::nullopt;
}

class ReplayCamera : public Camera {
 public:
  ReplayCamera(Recording recording, const CameraSettings& settings)
      : recording_(std::move(recording)), settings_(settings) {
    const auto missing = [this](const std::string& name) {
      remarks_.push_back(name + " cannot be changed in a recording, the setting is left aside");
    };
    if (settings.exposure_us) missing("exposure_us");
    if (settings.gain) missing("gain");
    if (!settings.pixel_format.empty()) missing("pixel_format");
    if (settings.trigger != "off") missing("trigger");
    buildTimes();
  }

  CameraIdentity identity() const override { return {"omnister", "replay", recording_.name}; }

  void start() override {
    running_ = true;
    resume_ = true;
  }

  void stop() override { running_ = false; }

  bool finished() const override { return next_ >= recording_.frames.size() && !settings_.loop; }

  std::optional<std::filesystem::path> lensFile() const override { return recording_.lens; }

  std::vector<std::string> takeRemarks() override { return std::exchange(remarks_, {}); }

  std::optional<Frame> grab(milliseconds timeout) override {
    const Steady::time_point until = Steady::now() + timeout;
    if (!running_ || finished()) {
      std::this_thread::sleep_until(until);
      return std::nullopt;
    }
    while (!finished()) {
      if (next_ >= recording_.frames.size()) {
        next_ = 0;
        ++lap_;
      }
      const nanoseconds offset = times_[next_] + lap_duration_ * lap_;
      if (resume_) {
        steady_start_ = Steady::now() - offset;
        system_start_ = now() - offset;
        resume_ = false;
      }
      if (settings_.paced) {
        const Steady::time_point due = steady_start_ + offset;
        if (due > until) {
          std::this_thread::sleep_until(until);
          return std::nullopt;
        }
        std::this_thread::sleep_until(due);
      }
      std::optional<Frame> frame = load(recording_.frames[next_]);
      const std::optional<Stamp>& recorded = recording_.frames[next_].stamp;
      ++next_;
      ++sequence_;
      if (!frame) {
        if (Steady::now() >= until) return std::nullopt;
        continue;
      }
      frame->sequence = sequence_;
      if (settings_.recorded_stamps && recorded) {
        frame->stamp = *recorded + lap_duration_ * lap_;
      } else {
        frame->stamp = settings_.paced ? system_start_ + offset : now();
      }
      return frame;
    }
    return std::nullopt;
  }

 private:
  /// When each frame is due, from the first.
  void buildTimes() {
    const std::size_t count = recording_.frames.size();
    const bool stamped = recording_.frames.front().stamp && settings_.frame_rate_hz <= 0.0;
    const double rate =
        settings_.frame_rate_hz > 0.0 ? settings_.frame_rate_hz : recording_.rate_hz;
    const nanoseconds period(std::llround(1e9 / rate));
    times_.resize(count);
    for (std::size_t i = 0; i < count; ++i) {
      times_[i] = stamped ? *recording_.frames[i].stamp - *recording_.frames.front().stamp
                          : period * static_cast<std::int64_t>(i);
    }
    // A lap ends one mean interval after its last frame.
    const nanoseconds mean =
        count > 1 ? times_.back() / static_cast<std::int64_t>(count - 1) : period;
    lap_duration_ = times_.back() + mean;
  }

  std::optional<Frame> load(const Recording::Entry& entry) {
    Frame frame;
    const std::string name = printable(entry.image.string());
    std::string problem;
    try {
      frame.image = readImage(entry.image);
    } catch (const Error& error) {
      problem = error.what();
    }
    if (problem.empty()) {
      frame.encoding = recording_.encoding.empty() ? encodingOf(frame.image) : recording_.encoding;
      if (frame.encoding.empty()) {
        problem = name + ": has pixels of type " + cv::typeToString(frame.image.type()) +
                  ", expected 8 or 16 bit with 1, 3 or 4 channels";
      } else if (!recording_.encoding.empty() &&
                 typeOf(recording_.encoding) != frame.image.type()) {
        problem = name + ": has pixels of type " + cv::typeToString(frame.image.type()) +
                  ", which are not " + recording_.encoding;
      }
    }
    if (!problem.empty()) {
      remarks_.push_back(problem);
      return std::nullopt;
    }
    frame.stage_position_m = entry.stage_position_m;
    frame.settled = entry.settled;
    return frame;
  }

  Recording recording_;
  CameraSettings settings_;
  std::vector<nanoseconds> times_;
  nanoseconds lap_duration_{0};
  std::vector<std::string> remarks_;
  bool running_ = false;
  bool resume_ = true;
  std::size_t next_ = 0;
  std::int64_t lap_ = 0;
  std::uint64_t sequence_ = 0;
  Steady::time_point steady_start_;
  Stamp system_start_;
};

void checkFiles(const Recording& recording, std::string_view source) {
  for (std::size_t i = 0; i < recording.frames.size(); ++i) {
    std::error_code error;
    if (fs::is_regular_file(recording.frames[i].image, error)) continue;
    throw InputError(
        source, "frames[" + std::to_string(i) + "].image",
        "names " + printable(recording.frames[i].image.string()) + ", which is no file");
  }
}

}  // namespace

Recording parseRecording(std::string_view text, std::string_view source, const fs::path& folder) {
  return readYaml(text, source, [&](const YAML::Node& root) {
    Recording recording = Reader(source, folder).read(root);
    if (!recording.encoding.empty() && !typeOf(recording.encoding)) {
      throw InputError(source, "encoding",
                       "is \"" + printable(recording.encoding) +
                           "\", expected mono8, mono16, bgr8 or bayer_{rggb,bggr,gbrg,grbg}{8,16}");
    }
    return recording;
  });
}

Recording readRecording(const fs::path& path) {
  std::error_code error;
  if (!fs::is_directory(path, error)) {
    fs::path folder = path.parent_path();
    if (folder.empty()) folder = ".";
    Recording recording = parseRecording(readFile(path, kMaxFileBytes), path.string(), folder);
    recording.name = path.stem().string();
    checkFiles(recording, path.string());
    return recording;
  }
  const fs::path folder = fs::canonical(path, error);
  if (error) throw IoError("open folder", path.string(), error.value());
  const fs::path list = folder / "replay.yaml";
  if (fs::exists(list, error)) {
    Recording recording = parseRecording(readFile(list, kMaxFileBytes), list.string(), folder);
    checkFiles(recording, list.string());
    return recording;
  }
  Recording recording;
  recording.name = folder.filename().string();
  for (fs::directory_iterator item(folder, error), end; !error && item != end;
       item.increment(error)) {
    std::error_code ignored;
    if (!isImageName(item->path()) || !item->is_regular_file(ignored)) continue;
    if (recording.frames.size() >= kMaxFrames) {
      throw InputError(path.string(), "",
                       "holds more than " + std::to_string(kMaxFrames) + " images");
    }
    recording.frames.emplace_back();
    recording.frames.back().image = item->path();
  }
  if (error) throw IoError("read folder", path.string(), error.value());
  if (recording.frames.empty()) {
    throw InputError(path.string(), "", "holds no replay.yaml and no image");
  }
  std::sort(recording.frames.begin(), recording.frames.end(),
            [](const Recording::Entry& a, const Recording::Entry& b) { return a.image < b.image; });
  return recording;
}

std::unique_ptr<Camera> makeReplayCamera(Recording recording, const CameraSettings& settings) {
  if (recording.frames.empty()) throw InputError(recording.name, "frames", "is empty");
  return std::make_unique<ReplayCamera>(std::move(recording), settings);
}

}  // namespace omnister::device
