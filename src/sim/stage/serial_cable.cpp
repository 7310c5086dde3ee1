// SPDX-License-Identifier: Apache-2.0
#include <fcntl.h>
#include <poll.h>
#include <stdlib.h>
#include <termios.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/sim/serial_devices.h"

namespace omnister::sim {
namespace {

constexpr int kTick = 3;  // [ms]

[[noreturn]] void fail(const char* action, const std::string& path) {
  throw IoError(action, path, errno);
}

}  // namespace

SerialCable::SerialCable(std::filesystem::path link, std::function<void(std::string_view)> on_bytes,
                         std::function<void()> on_tick)
    : link_(std::move(link)), on_bytes_(std::move(on_bytes)), on_tick_(std::move(on_tick)) {
  open();
  thread_ = std::thread(&SerialCable::run, this);
}

SerialCable::~SerialCable() {
  stop_ = true;
  thread_.join();
  close();
}

void SerialCable::open() {
  const int device_end = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
  if (device_end < 0) fail("opening", "/dev/ptmx");
  char name[128];
  int kept_end = -1;
  if (grantpt(device_end) == 0 && unlockpt(device_end) == 0 &&
      ptsname_r(device_end, name, sizeof(name)) == 0) {
    kept_end = ::open(name, O_RDWR | O_NOCTTY | O_CLOEXEC);
  }
  termios settings{};
  if (kept_end < 0 || tcgetattr(kept_end, &settings) != 0) {
    const int reason = errno;
    ::close(device_end);
    if (kept_end >= 0) ::close(kept_end);
    throw IoError("open a pseudo terminal", "/dev/pts", reason);
  }
  // Bytes are bytes, also before somebody configures it.
  cfmakeraw(&settings);
  tcsetattr(kept_end, TCSANOW, &settings);
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    device_end_ = device_end;
    kept_end_ = kept_end;
  }
  std::error_code error;
  if (std::filesystem::is_symlink(link_, error)) std::filesystem::remove(link_, error);
  std::filesystem::create_symlink(name, link_, error);
  if (error) {
    close();
    throw IoError("make the link", link_.string(), error.value());
  }
}

void SerialCable::close() {
  std::error_code ignored;
  if (std::filesystem::is_symlink(link_, ignored)) std::filesystem::remove(link_, ignored);
  const std::lock_guard<std::mutex> lock(mutex_);
  if (device_end_ >= 0) ::close(device_end_);
  if (kept_end_ >= 0) ::close(kept_end_);
  device_end_ = kept_end_ = -1;
}

void SerialCable::unplug() { close(); }

void SerialCable::plugIn() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (device_end_ >= 0) return;
  }
  open();
}

void SerialCable::send(std::string_view bytes) {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (device_end_ < 0) return;
  while (!bytes.empty()) {
    const ssize_t written = ::write(device_end_, bytes.data(), bytes.size());
    if (written < 0 && errno == EINTR) continue;
    if (written <= 0) return;
    bytes.remove_prefix(static_cast<std::size_t>(written));
  }
}

void SerialCable::run() {
  while (!stop_) {
    char bytes[512];
    ssize_t count = 0;
    int polled = -1;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      polled = device_end_;
    }
    // Whatever becomes of the descriptor meanwhile: it is read only while it is ours.
    pollfd poller{polled, POLLIN, 0};
    if (poll(&poller, 1, kTick) > 0) {
      const std::lock_guard<std::mutex> lock(mutex_);
      if (device_end_ >= 0) count = ::read(device_end_, bytes, sizeof(bytes));
    }
    if (count > 0) {
      on_bytes_(std::string_view(bytes, static_cast<std::size_t>(count)));
      continue;
    }
    on_tick_();
  }
}

SerialStageDevice::SerialStageDevice(std::shared_ptr<SimulatedStage> stage, std::uint32_t seed)
    : stage_(std::move(stage)), random_(seed) {}

void SerialStageDevice::setFaults(const WireFaults& faults) {
  const std::lock_guard<std::mutex> lock(faults_mutex_);
  faults_ = faults;
}

WireFaults SerialStageDevice::faults() {
  const std::lock_guard<std::mutex> lock(faults_mutex_);
  return faults_;
}

bool SerialStageDevice::happens(double share) {
  const std::lock_guard<std::mutex> lock(faults_mutex_);
  return std::uniform_real_distribution<double>(0.0, 1.0)(random_) < share;
}

std::string SerialStageDevice::wire(std::string line) {
  // What is as short as "$H" would turn into another command of that kind too often to be likely.
  if (line.size() < 4 || !happens(faults().garble)) return line;
  const std::lock_guard<std::mutex> lock(faults_mutex_);
  const std::size_t at = random_() % line.size();
  const char other = static_cast<char>(0x21 + random_() % 0x5e);
  switch (random_() % 4) {
    case 0:
      line.erase(at, 1);
      break;
    case 1:
      line.insert(at, 1, other);
      break;
    default:
      line[at] = other != line[at] ? other : '\x7f';
      break;
  }
  return line;
}

}  // namespace omnister::sim
