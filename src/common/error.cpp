// SPDX-License-Identifier: Apache-2.0
#include "omnister/common/error.h"

#include <cstring>

namespace omnister {
namespace {

// Length of the valid UTF-8 sequence at the start of `text`, 0 when there is none.
std::size_t utf8Length(std::string_view text) {
  const auto byte = [&](std::size_t i) { return static_cast<unsigned char>(text[i]); };
  const unsigned char first = byte(0);
  std::size_t length = 0;
  if (first < 0x80) {
    length = 1;
  } else if (first >= 0xC2 && first < 0xE0) {
    length = 2;
  } else if (first >= 0xE0 && first < 0xF0) {
    length = 3;
  } else if (first >= 0xF0 && first < 0xF5) {
    length = 4;
  }
  if (length == 0 || length > text.size()) return 0;
  for (std::size_t i = 1; i < length; ++i) {
    if ((byte(i) & 0xC0) != 0x80) return 0;
  }
  // U+0080 to U+009F are control characters too.
  if (length == 2 && first == 0xC2 && byte(1) < 0xA0) return 0;
  return length;
}

}  // namespace

std::string printable(std::string_view text, std::size_t max_length) {
  static constexpr char kHex[] = "0123456789abcdef";
  std::string out;
  while (!text.empty()) {
    if (out.size() >= max_length) return out + "...";
    const auto first = static_cast<unsigned char>(text.front());
    const std::size_t length = utf8Length(text);
    if (length == 0 || first < 0x20 || first == 0x7F) {
      out += "\\x";
      out += kHex[first >> 4];
      out += kHex[first & 15];
      text.remove_prefix(1);
    } else {
      out += text.substr(0, length);
      text.remove_prefix(length);
    }
  }
  return out;
}

namespace {

constexpr std::size_t kMaxMessage = 1000;

std::string located(std::string_view source, std::string_view place, std::string_view problem) {
  std::string out = printable(source);
  if (!place.empty()) out += ": " + printable(place);
  return out + ": " + std::string(problem);
}

}  // namespace

Error::Error(std::string_view message) : std::runtime_error(printable(message, kMaxMessage)) {}

InputError::InputError(std::string_view source, std::string_view place, std::string_view problem)
    : Error(located(source, place, problem)) {}

IoError::IoError(std::string_view action, std::string_view path, int error_number)
    : Error("cannot " + std::string(action) + " " + printable(path) + ": " +
            std::strerror(error_number)) {}

}  // namespace omnister
