// SPDX-License-Identifier: Apache-2.0
/// @file Whole-file reading and writing. A file written here is there whole or not at all.
#pragma once

#include <sys/types.h>

#include <cstddef>
#include <filesystem>
#include <string>
#include <string_view>

namespace omnister {

/// Reads a regular file. @throws IoError, or InputError when it is not a regular file or is larger
/// than `max_bytes`.
std::string readFile(const std::filesystem::path& path, std::size_t max_bytes = 256u << 20);

/// What becomes of the file that stood at the path before.
enum class Previous { kDrop, kKeep };

/// Writes to a temporary file in the same folder, syncs it, renames it over `path`, and syncs the
/// folder: killed at any moment, either the old file or the new one stands there. With
/// Previous::kKeep the old file stays beside it as `path` + "~". A symbolic link at `path` is
/// followed.
/// @throws IoError; the old file is then untouched and no temporary file is left.
void writeFileAtomically(const std::filesystem::path& path, std::string_view bytes,
                         Previous previous = Previous::kDrop);

/// A file that is there whole or not at all, for what is written piece by piece: write(), then
/// commit(). Until then it has no name where the file system can do that (O_TMPFILE), so that a
/// process that is killed leaves nothing behind; elsewhere it has a hidden one. What stands there
/// and is a device (/dev/null) or a pipe is not replaced, but written to at once.
class AtomicFile {
 public:
  /// @throws IoError
  explicit AtomicFile(std::filesystem::path path);
  ~AtomicFile();
  AtomicFile(const AtomicFile&) = delete;
  AtomicFile& operator=(const AtomicFile&) = delete;

  /// @throws IoError
  void write(std::string_view bytes);
  /// @throws IoError
  void commit(Previous previous = Previous::kDrop);
  /// Only where nothing has that name. @return false when something has  @throws IoError
  bool commitNew();

 private:
  void openDirectly(const std::filesystem::path& path, mode_t mode);
  void finish();
  /// Gives the file a name that is free. @return errno, 0 for success
  int giveName(const std::filesystem::path& name);

  std::filesystem::path target_;
  std::filesystem::path temporary_;  ///< empty while it has no name
  int fd_ = -1;
  bool direct_ = false;  ///< the target is a device or a pipe
};

}  // namespace omnister
