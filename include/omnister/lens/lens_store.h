// SPDX-License-Identifier: Apache-2.0
/// @file The folder where calibrations of cameras are kept, with those that stood there before.
#pragma once

#include <cstddef>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "omnister/lens/lens_file.h"

namespace omnister {

/// A calibration that a store keeps.
struct StoredLens {
  int version = 0;
  bool current = false;          ///< it is the one in use
  std::optional<LensFile> file;  ///< nullopt when it cannot be read
  std::string problem;           ///< why it cannot be read
};

/// One line about a stored calibration: version, model, residual, date, or what is wrong with it.
std::string describe(const StoredLens& stored);

/// One lens file a camera, `NAME.yaml`, the one before it, `NAME.yaml~`, and the latest versions,
/// `NAME.versions/1.yaml` and so on, that one among them. Nothing is ever read or written outside
/// the folder: names are letters, digits, `-`, `_` and `.` (not first), and a link in the folder is
/// refused. Several processes may use one store; whoever saves last is current.
class LensStore {
 public:
  /// As many versions of a camera are kept.
  static constexpr std::size_t kMaxVersions = 20;

  /// @param folder empty: `$ROS_HOME/omnister`, or `~/.ros/omnister`. Made when first written to.
  explicit LensStore(std::filesystem::path folder);

  const std::filesystem::path& folder() const { return folder_; }

  /// @throws InputError for a name with path parts or other characters
  std::filesystem::path pathOf(const std::string& name) const;
  /// @return nullopt when there is none  @throws IoError, InputError for a broken one
  std::optional<LensFile> load(const std::string& name) const;
  /// Whole or not at all; what stood there before becomes a version, even a broken one.
  /// @return where it stands  @throws IoError, InputError
  std::filesystem::path save(const std::string& name, const LensFile& file) const;

  /// The cameras of which something is stored, sorted. @throws IoError
  std::vector<std::string> names() const;
  /// Newest first. A current file that is none of them has version 0. @throws IoError, InputError
  std::vector<StoredLens> versions(const std::string& name) const;
  /// Makes an earlier version the current one; nothing is lost by it.
  /// @param version nullopt: the newest good one older than the current one
  /// @return what is current now  @throws InputError when there is none, IoError
  StoredLens rollBack(const std::string& name, std::optional<int> version) const;

  /// A name made of any text: other characters become `_`.
  static std::string nameFrom(const std::string& text);

 private:
  std::filesystem::path versionsOf(const std::string& name) const;
  void makeFolders(const std::string& name) const;
  /// Keeps the current file as a version where it is none yet.
  void keepCurrent(const std::string& name) const;
  void addVersion(const std::string& name, const std::string& bytes) const;
  void dropOldest(const std::string& name) const;

  std::filesystem::path folder_;
};

}  // namespace omnister
