// SPDX-License-Identifier: Apache-2.0
/// @file A serial port by lines: 8 data bits, no parity, one stop bit, no flow control.
///
/// Boost.Asio opens and configures it. (libserialport 0.1.1 refuses pseudo terminals: it looks a
/// port up in /sys/class/tty and reads its modem lines, and a pseudo terminal has neither.)
#pragma once

#include <chrono>
#include <memory>
#include <optional>
#include <string>
#include <string_view>

#include "omnister/device/stage.h"

namespace omnister::device {

using Steady = std::chrono::steady_clock;

/// Every failure is a StageError that names the port; after one that says it is gone, it stays so.
class SerialPort {
 public:
  /// @throws StageError: no such port, no permission (names the group), in use, no serial port, a
  /// baud rate that it does not know
  SerialPort(const std::string& path, int baud);
  ~SerialPort();
  SerialPort(const SerialPort&) = delete;
  SerialPort& operator=(const SerialPort&) = delete;

  const std::string& path() const { return path_; }
  int baud() const { return baud_; }

  /// @throws StageError when the port is gone or takes nothing
  void write(std::string_view bytes);
  /// The next line without its end; empty lines are left out. @return nullopt at the deadline
  /// @throws StageError when the port is gone
  std::optional<std::string> readLine(Steady::time_point deadline);
  /// Forgets what has come but was not read.
  void discardInput();
  /// The part of a line that has come so far.
  const std::string& unfinished() const { return buffer_; }

 private:
  struct Handle;
  [[noreturn]] void gone(int error_number);

  std::string path_;
  int baud_;
  std::unique_ptr<Handle> handle_;
  std::string buffer_;
};

/// Why a port could not be opened, as a person should read it.
std::string describeOpenError(const std::string& path, int error_number);

}  // namespace omnister::device
