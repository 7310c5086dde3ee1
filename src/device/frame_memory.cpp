// SPDX-License-Identifier: Apache-2.0
#include "omnister/device/frame_memory.h"

namespace omnister::device {

FrameMemory::~FrameMemory() {
  if (const std::shared_ptr<FramePool> pool = pool_.lock()) pool->giveBack(std::move(bytes));
}

FrameMemoryPtr FramePool::take(std::size_t bytes) {
  std::vector<std::uint8_t> memory;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (!idle_.empty()) {
      memory = std::move(idle_.back());
      idle_.pop_back();
    }
    if (memory.capacity() < bytes) ++allocated_;
  }
  memory.resize(bytes);
  return std::make_shared<FrameMemory>(std::move(memory), weak_from_this());
}

std::size_t FramePool::allocated() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  return allocated_;
}

void FramePool::giveBack(std::vector<std::uint8_t> memory) {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (memory.capacity() > 0 && idle_.size() < keep_) idle_.push_back(std::move(memory));
}

}  // namespace omnister::device
