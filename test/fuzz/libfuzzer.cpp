// SPDX-License-Identifier: Apache-2.0
#include "fuzz.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  omnister::fuzz::fuzzOne({reinterpret_cast<const char*>(data), size});
  return 0;
}
