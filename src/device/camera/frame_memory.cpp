// SPDX-License-Identifier: Apache-2.0
#include "omnister/device/frame_memory.h"

namespace omnister::device {

FrameMemory::~FrameMemory() {
  if (const std::shared_ptr<FramePool> pool = pool_.lock()) {
    pool->giveBack({std::move(bytes), std::move(wrapping)});
  }
}

FrameMemoryPtr FramePool::take(std::size_t bytes) {
  Idle memory;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (!idle_.empty()) {
      memory = std::move(idle_.back());
      idle_.pop_back();
    }
    if (memory.bytes.capacity() < bytes) ++allocated_;
  }
  memory.bytes.resize(bytes);
  auto frame = std::make_shared<FrameMemory>(std::move(memory.bytes), weak_from_this());
  frame->wrapping = std::move(memory.wrapping);
  return frame;
}

std::size_t FramePool::allocated() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  return allocated_;
}

void FramePool::giveBack(Idle memory) {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (memory.bytes.capacity() > 0 && idle_.size() < keep_) idle_.push_back(std::move(memory));
}

}  // namespace omnister::device
