// SPDX-License-Identifier: Apache-2.0
#include "omnister/lens/lens_store.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <system_error>

#include "omnister/common/contained_path.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;

fs::path defaultFolder() {
  if (const char* ros_home = std::getenv("ROS_HOME"); ros_home != nullptr && *ros_home != '\0') {
    return fs::path(ros_home) / "omnister";
  }
  if (const char* home = std::getenv("HOME"); home != nullptr && *home != '\0') {
    return fs::path(home) / ".ros" / "omnister";
  }
  throw InputError("store", "",
                   "is not given, and neither ROS_HOME nor HOME says where one could be");
}

constexpr char kExtension[] = ".yaml";
constexpr char kVersions[] = ".versions";
constexpr std::size_t kMaxBytes = 16u << 20;
constexpr std::size_t kMaxDigits = 9;
constexpr int kLastVersion = 999999999;

/// @return whether something stands there  @throws IoError, InputError for a link
bool standsAt(const fs::path& path) {
  std::error_code error;
  const fs::file_status status = fs::symlink_status(path, error);
  if (status.type() == fs::file_type::not_found) return false;
  if (error) throw IoError("read", path.string(), error.value());
  if (fs::is_symlink(status))
    throw InputError(path.string(), "", "is a link, which a store does not follow");
  return true;
}

/// The file names in a folder, none where there is no folder.
std::vector<std::string> entriesOf(const fs::path& folder) {
  std::vector<std::string> names;
  if (!standsAt(folder)) return names;
  std::error_code error;
  fs::directory_iterator entry(folder, error);
  for (; !error && entry != fs::directory_iterator(); entry.increment(error))
    names.push_back(entry->path().filename().string());
  if (error) throw IoError("read", folder.string(), error.value());
  return names;
}

std::optional<int> versionOf(const std::string& file_name) {
  const fs::path path(file_name);
  const std::string digits = path.stem().string();
  if (path.extension() != kExtension || digits.empty() || digits.size() > kMaxDigits ||
      !std::all_of(digits.begin(), digits.end(), [](char c) { return c >= '0' && c <= '9'; })) {
    return std::nullopt;
  }
  const int version = std::stoi(digits);
  // One version has one name.
  if (version < 1 || std::to_string(version) != digits) return std::nullopt;
  return version;
}

/// Oldest first.
std::vector<int> versionsIn(const fs::path& folder) {
  std::vector<int> versions;
  for (const std::string& name : entriesOf(folder))
    if (const auto version = versionOf(name)) versions.push_back(*version);
  std::sort(versions.begin(), versions.end());
  return versions;
}

/// One above the newest; where that is no version any more, the highest that is free.
int freeVersion(const std::vector<int>& versions) {
  if (versions.empty()) return 1;
  int next = versions.back();
  if (next < kLastVersion) return next + 1;
  for (auto taken = versions.rbegin(); taken != versions.rend() && *taken == next; ++taken) --next;
  return next;
}

fs::path versionPath(const fs::path& folder, int version) {
  return folder / (std::to_string(version) + kExtension);
}

StoredLens readStored(const fs::path& path, int version, std::string* bytes) {
  StoredLens stored;
  stored.version = version;
  try {
    standsAt(path);
    *bytes = readFile(path, kMaxBytes);
    stored.file = parseLensFile(*bytes, path.string());
  } catch (const Error& error) {
    stored.problem = error.what();
  }
  return stored;
}

}  // namespace

std::string describe(const StoredLens& stored) {
  std::string text = "version " + std::to_string(stored.version);
  if (stored.current) text += " (current)";
  if (!stored.file) return text + ": cannot be read: " + printable(stored.problem, 300);
  const LensFile& file = *stored.file;
  text += ": " + std::string(file.lens->model()) + ", " + std::to_string(file.image_size.width) +
          "x" + std::to_string(file.image_size.height);
  if (file.calibration.rms_px)
    text += ", RMS " + formatNumber(std::round(*file.calibration.rms_px * 1000.0) / 1000.0) + " px";
  if (!file.calibration.date.empty()) text += ", " + printable(file.calibration.date, 40);
  return text;
}

LensStore::LensStore(fs::path folder)
    : folder_(folder.empty() ? defaultFolder() : std::move(folder)) {}

fs::path LensStore::pathOf(const std::string& name) const {
  if (!isPlainName(name)) {
    throw InputError("store", "name",
                     "is \"" + printable(name) +
                         "\", expected letters, digits, '-', '_' and '.', not beginning with '.'");
  }
  return folder_ / (name + kExtension);
}

fs::path LensStore::versionsOf(const std::string& name) const {
  return fs::path(pathOf(name)).replace_filename(name + kVersions);
}

std::optional<LensFile> LensStore::load(const std::string& name) const {
  const fs::path path = pathOf(name);
  if (!standsAt(path)) return std::nullopt;
  return readLensFile(path);
}

void LensStore::makeFolders(const std::string& name) const {
  const fs::path folder = versionsOf(name);
  standsAt(folder);  // refuses a link
  std::error_code error;
  fs::create_directories(folder, error);
  if (error) throw IoError("make folder", folder.string(), error.value());
}

void LensStore::addVersion(const std::string& name, const std::string& bytes) const {
  const fs::path folder = versionsOf(name);
  for (;;) {
    const std::vector<int> versions = versionsIn(folder);
    const int next = freeVersion(versions);
    if (!versions.empty()) {
      std::string newest;
      readStored(versionPath(folder, versions.back()), versions.back(), &newest);
      if (newest == bytes) return;
    }
    AtomicFile file(versionPath(folder, next));
    file.write(bytes);
    // Another process may have taken the number.
    if (file.commitNew()) return;
  }
}

void LensStore::keepCurrent(const std::string& name) const {
  const fs::path path = pathOf(name);
  if (!standsAt(path)) return;
  std::string bytes;
  try {
    bytes = readFile(path, kMaxBytes);
  } catch (const Error&) {
    return;  // no lens file in any case; it stays as NAME.yaml~
  }
  const fs::path folder = versionsOf(name);
  for (const int version : versionsIn(folder)) {
    std::string other;
    readStored(versionPath(folder, version), version, &other);
    if (other == bytes) return;
  }
  addVersion(name, bytes);
}

void LensStore::dropOldest(const std::string& name) const {
  const std::vector<StoredLens> all = versions(name);
  std::error_code ignored;
  for (std::size_t i = kMaxVersions; i < all.size(); ++i)
    if (!all[i].current) fs::remove(versionPath(versionsOf(name), all[i].version), ignored);
}

fs::path LensStore::save(const std::string& name, const LensFile& file) const {
  const fs::path path = pathOf(name);
  const std::string bytes = formatLensFile(file);
  makeFolders(name);
  keepCurrent(name);
  addVersion(name, bytes);
  writeFileAtomically(path, bytes, Previous::kKeep);
  dropOldest(name);
  return path;
}

std::vector<std::string> LensStore::names() const {
  std::vector<std::string> names;
  for (const std::string& entry : entriesOf(folder_)) {
    const fs::path path(entry);
    const std::string stem = path.stem().string();
    if ((path.extension() == kExtension || path.extension() == kVersions) && entry[0] != '.')
      names.push_back(stem);
  }
  std::sort(names.begin(), names.end());
  names.erase(std::unique(names.begin(), names.end()), names.end());
  return names;
}

std::vector<StoredLens> LensStore::versions(const std::string& name) const {
  const fs::path folder = versionsOf(name);
  const fs::path path = pathOf(name);
  std::string current;
  std::optional<StoredLens> in_use;
  if (standsAt(path)) in_use = readStored(path, 0, &current);
  std::vector<StoredLens> all;
  std::vector<int> numbers = versionsIn(folder);
  std::reverse(numbers.begin(), numbers.end());
  for (const int version : numbers) {
    std::string bytes;
    all.push_back(readStored(versionPath(folder, version), version, &bytes));
    // Of equal ones the newest is meant.
    if (in_use && bytes == current) {
      all.back().current = true;
      in_use.reset();
    }
  }
  if (in_use) {
    in_use->current = true;
    all.insert(all.begin(), std::move(*in_use));
  }
  return all;
}

StoredLens LensStore::rollBack(const std::string& name, std::optional<int> version) const {
  const std::vector<StoredLens> all = versions(name);
  const StoredLens* chosen = nullptr;
  bool passed = std::none_of(all.begin(), all.end(), [](const auto& one) { return one.current; });
  for (const StoredLens& one : all) {
    if (version ? one.version == *version : passed && one.file.has_value()) {
      chosen = &one;
      break;
    }
    passed = passed || one.current;
  }
  const std::string folder = versionsOf(name).string();
  if (chosen == nullptr) {
    throw InputError(folder, "",
                     version ? "has no version " + std::to_string(*version)
                             : "has no good version older than the current one");
  }
  if (!chosen->file) throw InputError(folder, "", describe(*chosen));
  if (!chosen->current) {
    makeFolders(name);
    keepCurrent(name);
    const std::string bytes = readFile(versionPath(folder, chosen->version), kMaxBytes);
    parseLensFile(bytes, folder);  // another process may have changed it
    writeFileAtomically(pathOf(name), bytes, Previous::kKeep);
  }
  StoredLens result = *chosen;
  result.current = true;
  return result;
}

std::string LensStore::nameFrom(const std::string& text) {
  std::string name = text.substr(0, 100);
  for (char& c : name) {
    if (c != '.' && !isPlainName(std::string(1, c))) c = '_';
  }
  if (name.empty() || name[0] == '.') name.insert(0, "camera");
  return name.substr(0, 100);
}

}  // namespace omnister
