// SPDX-License-Identifier: Apache-2.0
/// @file Whole-file reading and writing. A file written here is there whole or not at all.
#pragma once

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
/// Previous::kKeep the old file stays beside it as `path` + "~". A symbolic link at `path` is followed.
/// @throws IoError; the old file is then untouched and no temporary file is left.
void writeFileAtomically(const std::filesystem::path& path, std::string_view bytes,
                         Previous previous = Previous::kDrop);

/// A temporary sibling of `path` for a library that writes by file name itself (an image codec, say):
/// write to path(), then commit(). Without commit() the temporary file is removed.
class AtomicFile {
 public:
  /// The temporary name ends in the extension of `path`, by which codecs choose a format.
  explicit AtomicFile(std::filesystem::path path);
  ~AtomicFile();
  AtomicFile(const AtomicFile&) = delete;
  AtomicFile& operator=(const AtomicFile&) = delete;

  const std::filesystem::path& path() const { return temporary_; }
  /// @throws IoError
  void commit(Previous previous = Previous::kDrop);

 private:
  std::filesystem::path target_;
  std::filesystem::path temporary_;
  bool committed_ = false;
};

}  // namespace omnister
