// SPDX-License-Identifier: Apache-2.0
/// @file Where files may be written that are named by a message: inside one folder, and nowhere
/// else.
#pragma once

#include <filesystem>
#include <string>

namespace omnister {

/// Letters, digits, `-`, `_` and `.`, not beginning with `.`; 1 to 100 of them.
bool isPlainName(const std::string& name);

/// @param root is made if it is not there
/// @param wanted relative to the root, or absolute and inside it; plain names all the way, none of
/// them a link
/// @return the path; what it names need not exist
/// @throws InputError naming `source` and `key` for a path that leads elsewhere; IoError
std::filesystem::path pathInside(const std::filesystem::path& root,
                                 const std::filesystem::path& wanted, const std::string& source,
                                 const std::string& key);

}  // namespace omnister
