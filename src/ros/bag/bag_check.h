// SPDX-License-Identifier: Apache-2.0
/// @file Whether a bag is what it says of itself. rosbag trusts every length and offset in a file,
/// and reads wherever they point.
#pragma once

#include <cstddef>
#include <filesystem>

namespace omnister {

/// What rosbag leaves out of a sound bag without a word.
struct BagFacts {
  std::size_t untimed = 0;  ///< messages recorded at time 0
};

/// Walks all records of a bag (format 2.0), those in its chunks too: each lies within the file or
/// its chunk, and the index points at messages alone.
/// @throws InputError naming the file, the byte and what is wrong there, IoError
BagFacts checkBag(const std::filesystem::path& path);

}  // namespace omnister
