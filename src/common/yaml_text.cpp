// SPDX-License-Identifier: Apache-2.0
#include "omnister/common/yaml_text.h"

#include <algorithm>
#include <string>

namespace omnister {
namespace {

constexpr std::string_view kBlanks = " \t\r";

/// "---" or "..." at the beginning of a line, alone or before a blank: only so a document ends.
bool isMarker(std::string_view line) {
  const std::string_view mark = line.substr(0, 3);
  return (mark == "---" || mark == "...") &&
         (line.size() == 3 || kBlanks.find(line[3]) != std::string_view::npos);
}

/// Found in the text, as YAML::LoadAll() never returns from some that is no YAML.
void checkSingleDocument(std::string_view text, std::string_view source) {
  bool content = false, ended = false;
  std::size_t number = 1;
  for (std::size_t begin = 0; begin < text.size(); ++number) {
    const std::size_t end = std::min(text.find('\n', begin), text.size());
    std::string_view line = text.substr(begin, end - begin);
    begin = end + 1;
    if (isMarker(line)) {
      ended = content;
      line.remove_prefix(3);
    }
    const std::size_t first = line.find_first_not_of(kBlanks);
    if (first == std::string_view::npos || line[first] == '#' || line[first] == '%') continue;
    if (ended) {
      throw InputError(source, "line " + std::to_string(number),
                       "begins another YAML document, expected a single one");
    }
    content = true;
  }
}

}  // namespace

YAML::Node yamlDocument(std::string_view text, std::string_view source) {
  YAML::Node document = YAML::Load(std::string(text));
  checkSingleDocument(text, source);
  return document;
}

InputError yamlError(std::string_view source, const YAML::Exception& error) {
  return {source, error.mark.is_null() ? "" : "line " + std::to_string(error.mark.line + 1),
          "is not YAML: " + printable(error.msg)};
}

}  // namespace omnister
