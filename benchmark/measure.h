// SPDX-License-Identifier: Apache-2.0
/// @file Clocks, memory and medians of this process.
#pragma once

#include <malloc.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstring>
#include <ctime>
#include <exception>
#include <limits>
#include <vector>

namespace omnister::bench {

/// Wall clock and the processor time of all threads [s].
struct Instant {
  double wall = 0.0, cpu = 0.0;
  static Instant now() {
    timespec spec{};
    ::clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &spec);
    return {
        std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(),
        static_cast<double>(spec.tv_sec) + 1e-9 * static_cast<double>(spec.tv_nsec)};
  }
};

inline double medianOf(std::vector<double> values) {
  if (values.empty()) return std::numeric_limits<double>::quiet_NaN();
  std::sort(values.begin(), values.end());
  const std::size_t n = values.size();
  return n % 2 == 1 ? values[n / 2] : 0.5 * (values[n / 2 - 1] + values[n / 2]);
}

/// A line of /proc/self/status in MiB, e.g. "VmHWM:".
inline double statusMebibytes(const char* key) {
  double result = std::numeric_limits<double>::quiet_NaN();
  if (std::FILE* file = std::fopen("/proc/self/status", "r")) {
    char line[256];
    while (std::fgets(line, sizeof line, file) != nullptr) {
      if (std::strncmp(line, key, std::strlen(key)) == 0) {
        long kilobytes = 0;
        if (std::sscanf(line + std::strlen(key), "%ld", &kilobytes) == 1) {
          result = static_cast<double>(kilobytes) / 1024.0;
        }
      }
    }
    std::fclose(file);
  }
  return result;
}

/// Peak memory of what runs between construction and mebibytes(), above what was held before.
/// NaN where the system does not let the peak be reset.
class PeakMemory {
 public:
  PeakMemory() {
    ::malloc_trim(0);
    if (std::FILE* file = std::fopen("/proc/self/clear_refs", "w")) {
      reset_ = std::fputs("5", file) >= 0;
      reset_ = std::fclose(file) == 0 && reset_;
    }
    before_ = statusMebibytes("VmRSS:");
  }
  double mebibytes() const {
    return reset_ ? statusMebibytes("VmHWM:") - before_ : std::numeric_limits<double>::quiet_NaN();
  }

 private:
  bool reset_ = false;
  double before_ = 0.0;
};

/// A benchmark's main: what goes wrong is one line and exit code 1.
template <class Body>
int report(const char* name, const Body& body) {
  try {
    return body();
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s: %s\n", name, error.what());
    return 1;
  }
}

}  // namespace omnister::bench
