// SPDX-License-Identifier: Apache-2.0
#include "omnister/device/frame_memory.h"

#include <gtest/gtest.h>

namespace omnister::device {
namespace {

TEST(FramePool, MemoryComesBackWithWhatWasMadeAroundIt) {
  const std::shared_ptr<FramePool> pool = FramePool::make(1);
  const auto wrapping = std::make_shared<int>(7);
  const std::uint8_t* data = nullptr;
  for (int round = 0; round < 3; ++round) {
    const FrameMemoryPtr memory = pool->take(100);
    if (round > 0) {
      EXPECT_EQ(memory->bytes.data(), data);
      EXPECT_EQ(memory->wrapping, wrapping);
    }
    data = memory->bytes.data();
    memory->wrapping = wrapping;
    // As a message does, for as long as it lives.
    std::vector<std::uint8_t> taken = std::move(memory->bytes);
    memory->bytes = std::move(taken);
  }
  EXPECT_EQ(pool->allocated(), 1U);
  EXPECT_EQ(wrapping.use_count(), 2);
  const FrameMemoryPtr first = pool->take(100), second = pool->take(100);
  EXPECT_EQ(second->wrapping, nullptr);
  second->wrapping = wrapping;
}

TEST(FramePool, WhatItDoesNotKeepIsGone) {
  auto wrapping = std::make_shared<int>(7);
  FrameMemoryPtr outlives;
  {
    const std::shared_ptr<FramePool> pool = FramePool::make(1);
    outlives = pool->take(10);
    const FrameMemoryPtr first = pool->take(10), second = pool->take(10);
    for (const FrameMemoryPtr& memory : {outlives, first, second}) memory->wrapping = wrapping;
  }
  EXPECT_EQ(wrapping.use_count(), 2);
  outlives.reset();
  EXPECT_EQ(wrapping.use_count(), 1);
}

}  // namespace
}  // namespace omnister::device
