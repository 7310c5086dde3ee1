// SPDX-License-Identifier: Apache-2.0
/// @file What every fuzz target shares. A target defines fuzzOne(); it is linked with libFuzzer
/// (`./run fuzz`, under AddressSanitizer and UndefinedBehaviorSanitizer) or with driver.cpp, which
/// replays the seeds and some mutations of them in the ordinary tests.
///
/// The contract under test: bytes from anywhere are either taken or refused by omnister::Error.
/// Anything else (another exception, a broken invariant, a finding of a sanitizer) ends the
/// process.
#pragma once

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string_view>

#include "omnister/common/error.h"

namespace omnister::fuzz {

/// One input. Defined by each target.
void fuzzOne(std::string_view bytes);

/// Runs `parse`, which may refuse by Error. @return whether it took the input
template <typename Parse>
bool takes(const Parse& parse) {
  try {
    parse();
    return true;
  } catch (const Error& error) {
    // A message goes to a log: one line of printable text.
    for (const char* c = error.what(); *c != '\0'; ++c)
      if (static_cast<unsigned char>(*c) < 0x20 || *c == 0x7f) std::abort();
    return false;
  }
}

inline void require(bool condition, const char* what) {
  if (condition) return;
  std::fprintf(stderr, "broken: %s\n", what);
  std::abort();
}

/// Whether to do now what takes long: under libFuzzer for one in so many inputs, always the same
/// ones.
inline bool timeForMore([[maybe_unused]] std::string_view bytes,
                        [[maybe_unused]] std::size_t one_in = 64) {
#ifdef FUZZING_BUILD_MODE_UNSAFE_FOR_PRODUCTION
  return std::hash<std::string_view>{}(bytes) % one_in == 0;
#else
  return true;
#endif
}

/// Takes numbers from the front of the input; zeros when it has run out.
class Bytes {
 public:
  explicit Bytes(std::string_view bytes) : rest_(bytes) {}

  template <typename T>
  T take() {
    T value{};
    const std::size_t size = rest_.size() < sizeof(T) ? rest_.size() : sizeof(T);
    std::memcpy(&value, rest_.data(), size);
    rest_.remove_prefix(size);
    return value;
  }
  std::string_view text(std::size_t length) {
    const std::string_view taken = rest_.substr(0, length);
    rest_.remove_prefix(taken.size());
    return taken;
  }
  std::string_view rest() const { return rest_; }
  bool empty() const { return rest_.empty(); }

 private:
  std::string_view rest_;
};

}  // namespace omnister::fuzz
