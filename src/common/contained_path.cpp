// SPDX-License-Identifier: Apache-2.0
#include "omnister/common/contained_path.h"

#include <algorithm>
#include <system_error>

#include "omnister/common/error.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;

bool isPlain(unsigned char c) {
  return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '-' ||
         c == '_' || c == '.';
}

}  // namespace

bool isPlainName(const std::string& name) {
  constexpr std::size_t kMostCharacters = 100;
  return !name.empty() && name.size() <= kMostCharacters && name[0] != '.' &&
         std::all_of(name.begin(), name.end(), isPlain);
}

fs::path pathInside(const fs::path& root, const fs::path& wanted, const std::string& source,
                    const std::string& key) {
  const fs::path folder = fs::absolute(root).lexically_normal();
  const auto refuse = [&](const std::string& problem) {
    throw InputError(source, key, "\"" + printable(wanted.string(), 200) + "\" " + problem);
  };
  std::error_code error;
  fs::create_directories(folder, error);
  if (error) throw IoError("make folder", folder.string(), error.value());
  const fs::path inside = wanted.is_absolute() ? wanted.lexically_relative(folder) : wanted;
  if (inside.empty() || inside == ".") refuse("is not inside " + folder.string());
  fs::path path = folder;
  for (const fs::path& part : inside) {
    if (part.empty()) continue;  // a slash at the end
    if (!isPlainName(part.string())) {
      refuse("leads out of " + folder.string() +
             " or has other characters than letters, digits, '-', '_' and '.'");
    }
    path /= part;
    if (fs::is_symlink(fs::symlink_status(path, error)))
      refuse("is reached by a link, which is not followed");
  }
  return path;
}

}  // namespace omnister
