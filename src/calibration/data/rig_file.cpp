// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/rig_file.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <set>

#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"
#include "omnister/common/yaml_text.h"

namespace omnister {

namespace {

constexpr std::size_t kMaxBytes = 1u << 20;
constexpr double kMaxMetres = 1e6;

class RigReader {
 public:
  RigReader(const YAML::Node& rig, std::string_view source) : rig_(rig), source_(source) {}

  [[noreturn]] void refuse(const std::string& key, const std::string& problem) const {
    throw InputError(source_, "rig" + (key.empty() ? "" : "." + key), problem);
  }

  std::string text(const std::string& key) const {
    const YAML::Node node = rig_[key];
    if (!node) refuse(key, "is missing");
    if (!node.IsScalar()) refuse(key, "is not a text");
    return node.Scalar();
  }

  double number(const std::string& key, const YAML::Node& node) const {
    const auto value = node.IsScalar() ? parseNumber(node.Scalar()) : std::optional<double>();
    if (!value || !std::isfinite(*value)) {
      refuse(key, "is '" +
                      (node.IsScalar() ? printable(node.Scalar(), 60) : std::string("no scalar")) +
                      "', expected a finite number");
    }
    return *value;
  }

  RigFile read() const {
    static const std::array<std::string, 7> kKeys = {
        "version", "reference", "displaced", "T_ref_disp", "baseline_m", "rms_px", "date"};
    std::set<std::string> seen;
    for (const auto& entry : rig_) {
      const std::string key = entry.first.IsScalar() ? entry.first.Scalar() : "";
      if (std::find(kKeys.begin(), kKeys.end(), key) == kKeys.end()) {
        refuse(printable(key, 60), "is unknown");
      }
      if (!seen.insert(key).second) refuse(key, "stands there twice");
    }
    if (!rig_["version"]) refuse("version", "is missing, expected 1");
    if (number("version", rig_["version"]) != 1.0) {
      refuse("version", "is " + printable(text("version"), 60) + ", expected 1");
    }
    RigFile file;
    file.reference = text("reference");
    file.displaced = text("displaced");
    if (file.reference.empty()) refuse("reference", "is empty, expected a lens file");
    if (file.displaced.empty()) refuse("displaced", "is empty, expected a lens file");
    const YAML::Node pose = rig_["T_ref_disp"];
    if (!pose || !pose.IsSequence() || pose.size() != 7) {
      refuse("T_ref_disp", "is not a list of 7 numbers, expected [tx, ty, tz, qx, qy, qz, qw]");
    }
    std::string numbers;
    for (std::size_t i = 0; i < 7; ++i) {
      numbers += (i > 0 ? " " : "") + formatNumber(number("T_ref_disp", pose[i]));
    }
    file.T_ref_disp = parsePose(numbers, std::string(source_) + ": rig.T_ref_disp");
    const double baseline = file.T_ref_disp.translation().norm();
    if (!(baseline > 0.0) || baseline > kMaxMetres) {
      refuse("T_ref_disp",
             "has a baseline of " + formatNumber(baseline) + " m, expected more than 0");
    }
    if (const YAML::Node node = rig_["baseline_m"]) {
      const double told = number("baseline_m", node);
      if (std::abs(told - baseline) > 1e-3 * baseline) {
        refuse("baseline_m", "is " + formatNumber(told) + ", expected the length of T_ref_disp, " +
                                 formatNumber(baseline));
      }
    }
    if (const YAML::Node node = rig_["rms_px"]) {
      file.rms_px = number("rms_px", node);
      if (*file.rms_px < 0.0) refuse("rms_px", "is negative");
    }
    if (rig_["date"]) file.date = text("date");
    return file;
  }

 private:
  YAML::Node rig_;
  std::string_view source_;
};

std::string quotedYaml(const std::string& text) {
  YAML::Emitter emitter;
  emitter << YAML::DoubleQuoted << text;
  return emitter.c_str();
}

}  // namespace

RigFile parseRigFile(std::string_view text, std::string_view source) {
  return readYaml(text, source, [&](const YAML::Node& root) {
    if (!root.IsMap() || !root["rig"] || !root["rig"].IsMap()) {
      throw InputError(source, "", "has no block 'rig', expected a rig file");
    }
    return RigReader(root["rig"], source).read();
  });
}

RigFile readRigFile(const std::filesystem::path& path) {
  RigFile file = parseRigFile(readFile(path, kMaxBytes), path.string());
  const std::filesystem::path folder = std::filesystem::absolute(path).parent_path();
  for (std::filesystem::path* lens : {&file.reference, &file.displaced}) {
    if (lens->is_relative()) *lens = (folder / *lens).lexically_normal();
  }
  return file;
}

std::string formatRigFile(const RigFile& rig) {
  const Eigen::Vector3d t = rig.T_ref_disp.translation();
  const Eigen::Quaterniond q(rig.T_ref_disp.linear());
  std::string text = "rig:\n  version: 1\n";
  text += "  reference: " + quotedYaml(rig.reference.string()) + "\n";
  text += "  displaced: " + quotedYaml(rig.displaced.string()) + "\n";
  text += "  T_ref_disp: [";
  const std::array<double, 7> numbers = {t.x(), t.y(), t.z(), q.x(), q.y(), q.z(), q.w()};
  for (std::size_t i = 0; i < numbers.size(); ++i)
    text += (i > 0 ? ", " : "") + formatNumber(numbers[i]);
  text += "]\n  baseline_m: " + formatNumber(t.norm()) + "\n";
  if (rig.rms_px) text += "  rms_px: " + formatNumber(*rig.rms_px) + "\n";
  if (!rig.date.empty()) text += "  date: " + quotedYaml(rig.date) + "\n";
  return text;
}

void writeRigFile(const std::filesystem::path& path, const RigFile& rig) {
  RigFile written = rig;
  const std::filesystem::path folder =
      std::filesystem::absolute(path).parent_path().lexically_normal();
  for (std::filesystem::path* lens : {&written.reference, &written.displaced}) {
    const auto absolute = std::filesystem::absolute(*lens).lexically_normal();
    const auto relative = absolute.lexically_relative(folder);
    *lens = !relative.empty() && *relative.begin() != ".." ? relative : absolute;
  }
  writeFileAtomically(path, formatRigFile(written), Previous::kKeep);
}

}  // namespace omnister
