// SPDX-License-Identifier: Apache-2.0
#pragma once

/// Compiles a hot loop for wider registers too; the loader picks. Such files are compiled without
/// contraction to fused multiply-add, so that every variant gives the same bits.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && \
    !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
#define OMNISTER_CLONES __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define OMNISTER_CLONES
#endif
