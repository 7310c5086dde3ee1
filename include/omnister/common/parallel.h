// SPDX-License-Identifier: Apache-2.0
/// @file Parallel computation: oneTBB under a per-call limit.
#pragma once

#include <tbb/blocked_range.h>
#include <tbb/info.h>
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <cstddef>

// GCC says it by a macro, clang by a feature.
#if defined(__SANITIZE_THREAD__)
#define OMNISTER_THREAD_SANITIZER 1
#elif defined(__has_feature)
#if __has_feature(thread_sanitizer)
#define OMNISTER_THREAD_SANITIZER 1
#endif
#endif
#ifdef OMNISTER_THREAD_SANITIZER
#include <atomic>
#include <exception>
#include <thread>
#include <vector>
#endif

namespace omnister {

/// @param threads wanted; 0 or less means every core, and there are no more than that
inline int threadCount(int threads) {
  const int cores = tbb::info::default_concurrency();
  return threads > 0 ? std::min(threads, cores) : cores;
}

#ifdef OMNISTER_THREAD_SANITIZER
namespace detail {

/// The same with plain threads. oneTBB's library is not built with ThreadSanitizer, which thus
/// cannot see how it hands work over, and tells of races in all of it; joins it does see. What the
/// bodies do to each other is then all there is to tell. At least two threads, on one core too.
template <typename Body>
void parallelForOnThreads(std::size_t begin, std::size_t end, int threads, const Body& body,
                          std::size_t grain) {
  // Relaxed, so that the counter itself orders nothing that the bodies do.
  std::atomic<std::size_t> next{begin};
  std::exception_ptr failure;
  std::atomic_flag failed = ATOMIC_FLAG_INIT;
  const auto work = [&] {
    try {
      for (;;) {
        const std::size_t from = next.fetch_add(grain, std::memory_order_relaxed);
        if (from >= end) return;
        for (std::size_t i = from; i < std::min(from + grain, end); ++i) body(i);
      }
    } catch (...) {
      next.store(end, std::memory_order_relaxed);
      if (!failed.test_and_set()) failure = std::current_exception();
    }
  };
  std::vector<std::thread> team;
  for (int i = 0; i < std::max(2, threads); ++i) team.emplace_back(work);
  for (std::thread& member : team) member.join();
  if (failure) std::rethrow_exception(failure);
}

}  // namespace detail
#endif

/// Calls body(i) for i in [begin, end) on at most `threads` threads (0: every core). The result
/// must not depend on the order of calls, so that it is the same for any number of threads.
template <typename Body>
void parallelFor(std::size_t begin, std::size_t end, int threads, const Body& body,
                 std::size_t grain = 1) {
  if (begin >= end) return;
  if (threads == 1) {
    for (std::size_t i = begin; i < end; ++i) body(i);
    return;
  }
#ifdef OMNISTER_THREAD_SANITIZER
  detail::parallelForOnThreads(begin, end, threadCount(threads), body, grain);
#else
  const auto run = [&] {
    tbb::parallel_for(tbb::blocked_range<std::size_t>(begin, end, grain),
                      [&](const tbb::blocked_range<std::size_t>& range) {
                        for (std::size_t i = range.begin(); i != range.end(); ++i) body(i);
                      });
  };
  const int count = threadCount(threads);
  if (count == tbb::info::default_concurrency()) {
    // The caller's own arena: workers that have just left it are still awake. Isolated, as a body
    // that calls this again must not get to run another body of the outer call while it waits.
    tbb::this_task_arena::isolate(run);
  } else {
    tbb::task_arena(count).execute(run);
  }
#endif
}

}  // namespace omnister
