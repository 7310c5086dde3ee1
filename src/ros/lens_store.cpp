// SPDX-License-Identifier: Apache-2.0
#include "omnister/ros/lens_store.h"

#include <algorithm>
#include <cstdlib>
#include <system_error>

#include "omnister/common/error.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;

bool allowed(unsigned char c) {
  return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '-' ||
         c == '_' || c == '.';
}

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

}  // namespace

LensStore::LensStore(fs::path folder)
    : folder_(folder.empty() ? defaultFolder() : std::move(folder)) {}

fs::path LensStore::pathOf(const std::string& name) const {
  constexpr std::size_t kMaxName = 100;
  if (name.empty() || name.size() > kMaxName || name[0] == '.' ||
      !std::all_of(name.begin(), name.end(), allowed)) {
    throw InputError("store", "name",
                     "is \"" + printable(name) +
                         "\", expected letters, digits, '-', '_' and '.', not beginning with '.'");
  }
  return folder_ / (name + ".yaml");
}

std::optional<LensFile> LensStore::load(const std::string& name) const {
  const fs::path path = pathOf(name);
  std::error_code error;
  const fs::file_status status = fs::symlink_status(path, error);
  if (status.type() == fs::file_type::not_found) return std::nullopt;
  if (error) throw IoError("read", path.string(), error.value());
  if (fs::is_symlink(status))
    throw InputError(path.string(), "", "is a link, which a store does not follow");
  return readLensFile(path);
}

fs::path LensStore::save(const std::string& name, const LensFile& file) const {
  const fs::path path = pathOf(name);
  std::error_code error;
  fs::create_directories(folder_, error);
  if (error) throw IoError("make folder", folder_.string(), error.value());
  if (fs::is_symlink(fs::symlink_status(path, error))) {
    throw InputError(path.string(), "", "is a link, which a store does not follow");
  }
  writeLensFile(path, file);
  return path;
}

std::string LensStore::nameFrom(const std::string& text) {
  std::string name = text.substr(0, 100);
  for (char& c : name) {
    if (!allowed(static_cast<unsigned char>(c))) c = '_';
  }
  if (name.empty() || name[0] == '.') name.insert(0, "camera");
  return name.substr(0, 100);
}

}  // namespace omnister
