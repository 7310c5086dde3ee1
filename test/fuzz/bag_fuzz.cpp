// SPDX-License-Identifier: Apache-2.0
// rosbag itself trusts a bag: none that is taken may lead it out of its memory, or to an end.
// As all of the ROS layer, before what else there is of ROS.
#include "ros/node/checked_lengths.h"
//
#include <console_bridge/console.h>
#include <rosbag/bag.h>
#include <rosbag/view.h>
#include <sys/mman.h>
#include <tf2_msgs/TFMessage.h>
#include <unistd.h>

#include <string>

#include "fuzz.h"
#include "ros/bag/bag_check.h"

namespace {

/// A file in memory, under a name of the file system.
class MemoryFile {
 public:
  explicit MemoryFile(std::string_view bytes) : fd_(::memfd_create("bag", MFD_CLOEXEC)) {
    while (!bytes.empty()) {
      const ssize_t n = ::write(fd_, bytes.data(), bytes.size());
      if (n <= 0) std::abort();
      bytes.remove_prefix(static_cast<std::size_t>(n));
    }
  }
  ~MemoryFile() { ::close(fd_); }
  MemoryFile(const MemoryFile&) = delete;
  MemoryFile& operator=(const MemoryFile&) = delete;
  std::string path() const { return "/proc/self/fd/" + std::to_string(fd_); }

 private:
  const int fd_;
};

void readAll(const std::string& path) {
  // One for all, as each looks for plugins when it is made.
  static rosbag::Bag bag;
  try {
    bag.open(path, rosbag::bagmode::Read);
    rosbag::View view(bag);
    for (const rosbag::MessageInstance& instance : view) {
      try {
        instance.instantiate<tf2_msgs::TFMessage>();
        std::vector<std::uint8_t> bytes(instance.size());
        ros::serialization::OStream stream(bytes.data(), static_cast<std::uint32_t>(bytes.size()));
        instance.write(stream);
      } catch (const std::exception&) {
        // A message of nonsense is left out.
      }
    }
  } catch (const std::exception&) {
    // Refused by rosbag.
  }
  bag.close();
}

}  // namespace

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  console_bridge::noOutputHandler();
  const MemoryFile file(bytes);
  if (takes([&] { checkBag(file.path()); })) readAll(file.path());
}
