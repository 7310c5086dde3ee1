// SPDX-License-Identifier: Apache-2.0
/// @file The one place where threads are made: oneTBB under a per-call limit.
#pragma once

#include <tbb/blocked_range.h>
#include <tbb/info.h>
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <cstddef>

namespace omnister {

/// @param threads wanted; 0 or less means every core, and there are no more than that
inline int threadCount(int threads) {
  const int cores = tbb::info::default_concurrency();
  return threads > 0 ? std::min(threads, cores) : cores;
}

/// Calls body(i) for i in [begin, end) on at most `threads` threads (0: every core). The result must
/// not depend on the order of calls, so that it is the same for any number of threads.
template <typename Body>
void parallelFor(std::size_t begin, std::size_t end, int threads, const Body& body,
                 std::size_t grain = 1) {
  if (begin >= end) return;
  if (threads == 1) {
    for (std::size_t i = begin; i < end; ++i) body(i);
    return;
  }
  tbb::task_arena arena(threadCount(threads));
  arena.execute([&] {
    tbb::parallel_for(tbb::blocked_range<std::size_t>(begin, end, grain),
                      [&](const tbb::blocked_range<std::size_t>& range) {
                        for (std::size_t i = range.begin(); i != range.end(); ++i) body(i);
                      });
  });
}

}  // namespace omnister
