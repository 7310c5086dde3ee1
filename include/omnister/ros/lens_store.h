// SPDX-License-Identifier: Apache-2.0
/// @file The folder where calibrations of cameras are kept.
#pragma once

#include <filesystem>
#include <optional>
#include <string>

#include "omnister/lens/lens_file.h"

namespace omnister {

/// One lens file a camera, `NAME.yaml`, and the one before it, `NAME.yaml~`. Nothing is ever read
/// or written outside the folder: names are letters, digits, `-`, `_` and `.` (not first), and a
/// link in the folder is refused.
class LensStore {
 public:
  /// @param folder empty: `$ROS_HOME/omnister`, or `~/.ros/omnister`. Made when first written to.
  explicit LensStore(std::filesystem::path folder);

  const std::filesystem::path& folder() const { return folder_; }

  /// @throws InputError for a name with path parts or other characters
  std::filesystem::path pathOf(const std::string& name) const;
  /// @return nullopt when there is none  @throws IoError, InputError for a broken one
  std::optional<LensFile> load(const std::string& name) const;
  /// Whole or not at all. @return where it stands  @throws IoError, InputError
  std::filesystem::path save(const std::string& name, const LensFile& file) const;

  /// A name made of any text: other characters become `_`.
  static std::string nameFrom(const std::string& text);

 private:
  std::filesystem::path folder_;
};

}  // namespace omnister
