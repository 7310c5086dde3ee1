// SPDX-License-Identifier: Apache-2.0
/// @file Exceptions that reach a person. Every message is one line, says what was wrong, where, and
/// what was expected, and has its control characters escaped (see printable()).
#pragma once

#include <stdexcept>
#include <string>
#include <string_view>

namespace omnister {

/// Something a person can mend. Commands print what() and exit with 1; nodes log it and go on.
class Error : public std::runtime_error {
 public:
  explicit Error(std::string_view message);
};

/// Bad data: names the source (file, argument, topic), the place in it, and what was expected
/// there.
class InputError : public Error {
 public:
  /// @param source file or argument, e.g. "wide.yaml"
  /// @param place key, line or column inside it, e.g. "lens_surface.center" or "line 12"; may be
  /// empty
  /// @param problem what was found and what was expected, e.g. "is nan, expected a finite number"
  InputError(std::string_view source, std::string_view place, std::string_view problem);
};

/// Reading or writing failed. The message carries the path and the system's reason (strerror).
class IoError : public Error {
 public:
  IoError(std::string_view action, std::string_view path, int error_number);
};

/// Escapes control characters and invalid UTF-8 as \xNN and cuts after `max_length` characters, so
/// that text from a file or a message can stand in a log line.
std::string printable(std::string_view text, std::size_t max_length = 200);

}  // namespace omnister
