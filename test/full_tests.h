// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdlib>
#include <string_view>

namespace omnister::test {

/// What takes long is run too: `./run test --full` says so.
inline bool fullTests() {
  const char* full = std::getenv("OMNISTER_FULL_TESTS");
  return full != nullptr && std::string_view(full) == "ON";
}

}  // namespace omnister::test
