// SPDX-License-Identifier: Apache-2.0
/// @file Arrays of messages that claim to be longer than their message. ROS makes room for as many
/// elements as a message says that it holds before it looks whether they are there, so that four
/// bytes take all memory there is; and reckons their bytes in 32 bits, so that of 2^29 numbers none
/// is missed. The build includes this file before all others of the ROS layer: its overload is the
/// one that messages, services and bags are read by.
#pragma once

#include <ros/serialization.h>

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

namespace ros::serialization {

/// As ROS' own. @throws StreamOverrunException where the rest of the message cannot hold so many
template <typename T, class Allocator>
inline void deserialize(IStream& stream, std::vector<T, Allocator>& elements) {
  // Nothing is shorter than what is empty.
  static const std::uint64_t least = std::max<std::uint32_t>(1, serializationLength(T()));
  std::uint32_t count = 0;
  if (stream.getLength() >= sizeof count) {
    std::memcpy(&count, stream.getData(), sizeof count);
    if (count * least > stream.getLength() - sizeof count) throwStreamOverrun();
  }
  VectorSerializer<T, Allocator>::read(stream, elements);
}

}  // namespace ros::serialization
