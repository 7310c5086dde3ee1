// SPDX-License-Identifier: Apache-2.0
/// @file The keys of a target file: each asked for by name and kind, the others refused.
#pragma once

#include <yaml-cpp/yaml.h>

#include <cmath>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <string_view>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"

namespace omnister {

inline std::string inQuotes(std::string_view text) { return "'" + printable(text, 60) + "'"; }

/// The keys of one mapping. Every one must be asked for, or finish() names it as unknown.
class TargetKeys {
 public:
  TargetKeys(const YAML::Node& map, std::string_view source) : source_(source) {
    for (const auto& entry : map) {
      if (!entry.first.IsScalar()) throw InputError(source_, "", "has a key that is not a word");
      const std::string& key = entry.first.Scalar();
      if (!values_.emplace(key, entry.second).second) {
        throw InputError(source_, key, "stands there twice");
      }
    }
  }

  bool has(const std::string& key) const { return values_.count(key) > 0; }

  std::optional<std::string> text(const std::string& key) {
    const auto found = values_.find(key);
    if (found == values_.end()) return std::nullopt;
    known_.insert(key);
    if (!found->second.IsScalar()) throw InputError(source_, key, "is not a single value");
    return found->second.Scalar();
  }

  std::string required(const std::string& key, std::string_view expected) {
    auto value = text(key);
    if (!value) throw InputError(source_, key, "is missing, expected " + std::string(expected));
    return *value;
  }

  int integer(const std::string& key) {
    const std::string value = required(key, "a whole number");
    const auto number = parseNumber(value);
    if (!number || *number != std::floor(*number) || std::abs(*number) > 1e6) {
      throw InputError(source_, key, "is " + inQuotes(value) + ", expected a whole number");
    }
    return static_cast<int>(*number);
  }

  double number(const std::string& key) {
    const std::string value = required(key, "a number");
    const auto parsed = parseNumber(value);
    if (!parsed) throw InputError(source_, key, "is " + inQuotes(value) + ", expected a number");
    return *parsed;
  }

  double number(const std::string& key, double otherwise) {
    return values_.count(key) == 0 ? otherwise : number(key);
  }

  bool flag(const std::string& key) {
    const auto value = text(key);
    if (!value || *value == "false") return false;
    if (*value == "true") return true;
    throw InputError(source_, key, "is " + inQuotes(*value) + ", expected true or false");
  }

  void finish(std::string_view type) const {
    for (const auto& [key, value] : values_) {
      if (known_.count(key) != 0) continue;
      std::string list;
      for (const auto& name : known_) list += (list.empty() ? "" : ", ") + name;
      throw InputError(source_, key,
                       "is not a key of " + std::string(type) + ", which has " + list);
    }
  }

 private:
  std::string source_;
  std::map<std::string, YAML::Node> values_;
  std::set<std::string> known_;
};

}  // namespace omnister
