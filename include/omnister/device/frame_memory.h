// SPDX-License-Identifier: Apache-2.0
/// @file Memory of images that goes round between a camera and those who look at its frames, so
/// that an image is neither copied nor allocated anew.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <vector>

namespace omnister::device {

class FramePool;

/// The bytes of one image. Whoever takes `bytes` out (a message) puts them back, or they are lost
/// to the pool, which then allocates others.
class FrameMemory {
 public:
  explicit FrameMemory(std::vector<std::uint8_t> memory, std::weak_ptr<FramePool> pool)
      : bytes(std::move(memory)), pool_(std::move(pool)) {}
  /// Back to the pool.
  ~FrameMemory();
  FrameMemory(const FrameMemory&) = delete;
  FrameMemory& operator=(const FrameMemory&) = delete;

  std::vector<std::uint8_t> bytes;
  /// What a device made around the bytes, good for as long as these stay where they are; kept with
  /// them, so that it need not be made for each frame.
  std::shared_ptr<void> wrapping;

 private:
  std::weak_ptr<FramePool> pool_;
};
using FrameMemoryPtr = std::shared_ptr<FrameMemory>;

/// Safe to use from several threads; frames may outlive it.
class FramePool : public std::enable_shared_from_this<FramePool> {
 public:
  /// @param keep most idle memories that are kept
  static std::shared_ptr<FramePool> make(std::size_t keep) {
    return std::shared_ptr<FramePool>(new FramePool(keep));
  }
  /// Memory of that size, of unknown content, and what was around it if it was in use before.
  FrameMemoryPtr take(std::size_t bytes);
  /// Memories that had to be allocated so far.
  std::size_t allocated() const;

 private:
  friend class FrameMemory;
  explicit FramePool(std::size_t keep) : keep_(keep) {}
  struct Idle {
    std::vector<std::uint8_t> bytes;
    std::shared_ptr<void> wrapping;
  };
  void giveBack(Idle memory);

  const std::size_t keep_;
  mutable std::mutex mutex_;
  std::vector<Idle> idle_;
  std::size_t allocated_ = 0;
};

}  // namespace omnister::device
