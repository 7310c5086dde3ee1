// SPDX-License-Identifier: Apache-2.0
/// @file Pieces of comma-separated text, as the files of corners and of stage positions have it.
#pragma once

#include <string>
#include <string_view>
#include <vector>

#include "omnister/common/error.h"

namespace omnister::calibration {

inline std::string_view trimmed(std::string_view text) {
  const auto blank = [](char c) { return c == ' ' || c == '\t' || c == '\r'; };
  while (!text.empty() && blank(text.front())) text.remove_prefix(1);
  while (!text.empty() && blank(text.back())) text.remove_suffix(1);
  return text;
}

/// For messages.
inline std::string inQuotes(std::string_view text) { return "'" + printable(text, 60) + "'"; }

/// The next line without its end; moves `text` behind it.
inline std::string_view takeLine(std::string_view& text) {
  const std::size_t end = text.find('\n');
  const std::string_view line = text.substr(0, end);
  text.remove_prefix(end == std::string_view::npos ? text.size() : end + 1);
  return line;
}

/// The first line without blanks and the byte order mark that spreadsheets put in front of it.
inline std::string takeHeader(std::string_view& text) {
  if (text.substr(0, 3) == "\xEF\xBB\xBF") text.remove_prefix(3);
  std::string header;
  for (const char c : trimmed(takeLine(text)).substr(0, 200)) {
    if (c != ' ' && c != '\t') header += c;
  }
  return header;
}

/// What stands between the commas of a line, without blanks around it.
inline std::vector<std::string_view> fieldsOf(std::string_view line) {
  std::vector<std::string_view> fields;
  for (;;) {
    const std::size_t comma = line.find(',');
    fields.push_back(trimmed(line.substr(0, comma)));
    if (comma == std::string_view::npos) return fields;
    line.remove_prefix(comma + 1);
  }
}

}  // namespace omnister::calibration
