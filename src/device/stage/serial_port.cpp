// SPDX-License-Identifier: Apache-2.0
#include "device/stage/serial_port.h"

#include <grp.h>
#include <poll.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <termios.h>
#include <unistd.h>

#include <algorithm>
#include <boost/asio/io_context.hpp>
#include <boost/asio/serial_port.hpp>
#include <cerrno>
#include <cstring>

namespace omnister::device {
namespace {

namespace asio = boost::asio;

// Nobody's line is longer; what is, is noise.
constexpr std::size_t kLongestLine = 4096;
constexpr std::chrono::milliseconds kWriteTimeout(500);

std::string reasonOf(int error_number) { return std::strerror(error_number); }

std::string groupOf(const std::string& path) {
  struct stat status {};
  if (stat(path.c_str(), &status) != 0) return "dialout";
  const struct group* group = getgrgid(status.st_gid);
  return group ? group->gr_name : std::to_string(status.st_gid);
}

/// Waits on a descriptor until the deadline; at least one look. @return the events, 0 at the
/// deadline
short waitFor(int fd, short events, Steady::time_point deadline) {
  while (true) {
    const auto left = std::chrono::ceil<std::chrono::milliseconds>(deadline - Steady::now());
    pollfd poller{fd, events, 0};
    const int found = poll(&poller, 1, std::max(0, static_cast<int>(left.count())));
    if (found > 0) return poller.revents;
    if (found == 0) return 0;
    if (errno != EINTR) return POLLERR;
  }
}

}  // namespace

std::string describeOpenError(const std::string& path, int error_number) {
  const std::string name = printable(path);
  switch (error_number) {
    case ENOENT:
    case ENXIO:
    case ENODEV:
      return "there is no port " + name;
    case EACCES:
    case EPERM:
      return "no permission for " + name + ": the user must be in the group \"" + groupOf(path) +
             "\" (adduser USER " + groupOf(path) + ", then log in again)";
    case EBUSY:
    case EWOULDBLOCK:
      return name + " is in use by another program";
    case ENOTTY:
    case EINVAL:
      return name + " is not a serial port";
    default:
      return "cannot open " + name + ": " + reasonOf(error_number);
  }
}

struct SerialPort::Handle {
  asio::io_context context;
  asio::serial_port port{context};
  int fd() { return port.native_handle(); }
};

SerialPort::SerialPort(const std::string& path, int baud)
    : path_(path), baud_(baud), handle_(std::make_unique<Handle>()) {
  boost::system::error_code error;
  handle_->port.open(path, error);
  if (error) throw StageError(describeOpenError(path, error.value()));
  // The lock ends with the process, whatever becomes of it; the kernel's own (TIOCEXCL) would stay.
  if (flock(handle_->fd(), LOCK_EX | LOCK_NB) != 0) {
    throw StageError(describeOpenError(path, errno));
  }
  using Port = asio::serial_port_base;
  handle_->port.set_option(Port::baud_rate(static_cast<unsigned>(baud)), error);
  if (error)
    throw StageError(printable(path) + " has no rate of " + std::to_string(baud) + " baud");
  for (int i = 0; i < 4 && !error; ++i) {
    if (i == 0) handle_->port.set_option(Port::character_size(8), error);
    if (i == 1) handle_->port.set_option(Port::parity(Port::parity::none), error);
    if (i == 2) handle_->port.set_option(Port::stop_bits(Port::stop_bits::one), error);
    if (i == 3) handle_->port.set_option(Port::flow_control(Port::flow_control::none), error);
  }
  if (error) throw StageError("cannot configure " + printable(path) + ": " + error.message());
  discardInput();
}

SerialPort::~SerialPort() = default;

void SerialPort::gone(int error_number) {
  throw StageError("the port " + printable(path_) + " is gone" +
                   (error_number != 0 ? " (" + reasonOf(error_number) + ")" : ""));
}

void SerialPort::write(std::string_view bytes) {
  const Steady::time_point deadline = Steady::now() + kWriteTimeout;
  while (!bytes.empty()) {
    const ssize_t written = ::write(handle_->fd(), bytes.data(), bytes.size());
    if (written > 0) {
      bytes.remove_prefix(static_cast<std::size_t>(written));
      continue;
    }
    if (written < 0 && errno == EINTR) continue;
    if (written < 0 && errno != EAGAIN) gone(errno);
    const short events = waitFor(handle_->fd(), POLLOUT, deadline);
    if (events == 0) throw StageError("the port " + printable(path_) + " takes nothing");
    if ((events & POLLOUT) == 0) gone(EIO);
  }
}

std::optional<std::string> SerialPort::readLine(Steady::time_point deadline) {
  const auto isEnd = [](char c) { return c == '\n' || c == '\r'; };
  while (true) {
    buffer_.erase(buffer_.begin(), std::find_if_not(buffer_.begin(), buffer_.end(), isEnd));
    const auto end = std::find_if(buffer_.begin(), buffer_.end(), isEnd);
    if (end != buffer_.end()) {
      std::string line(buffer_.begin(), end);
      buffer_.erase(buffer_.begin(), end);
      return line;
    }
    if (buffer_.size() > kLongestLine) return std::exchange(buffer_, {});
    const short events = waitFor(handle_->fd(), POLLIN, deadline);
    if (events == 0) return std::nullopt;
    char bytes[512];
    const ssize_t count = ::read(handle_->fd(), bytes, sizeof(bytes));
    if (count > 0) {
      buffer_.append(bytes, static_cast<std::size_t>(count));
    } else if (count == 0) {
      gone(0);
    } else if (errno != EINTR && errno != EAGAIN) {
      gone(errno);
    }
  }
}

void SerialPort::discardInput() {
  tcflush(handle_->fd(), TCIFLUSH);
  buffer_.clear();
}

}  // namespace omnister::device
