// SPDX-License-Identifier: Apache-2.0
/// @file YAML from files that may hold anything.
#pragma once

#include <yaml-cpp/yaml.h>

#include <string_view>

#include "omnister/common/error.h"

namespace omnister {

/// The document of `text`; null where there is none. @throws YAML::Exception; InputError naming
/// `source` where there is more than one, of which all but the first would be passed over
YAML::Node yamlDocument(std::string_view text, std::string_view source);

/// What yaml-cpp has to say, with the line.
InputError yamlError(std::string_view source, const YAML::Exception& error);

/// `read(document)` of `text`. @throws InputError naming `source`, and the line where that is no
/// YAML
template <typename Read>
auto readYaml(std::string_view text, std::string_view source, const Read& read) {
  try {
    return read(yamlDocument(text, source));
  } catch (const YAML::Exception& error) {
    throw yamlError(source, error);
  }
}

}  // namespace omnister
