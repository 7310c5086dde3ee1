// SPDX-License-Identifier: Apache-2.0
/// @file A YAML node that knows where it stands, so that every refusal names file, key and line.
#pragma once

#include <yaml-cpp/yaml.h>

#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace omnister::detail {

class YamlView {
 public:
  /// @throws InputError when the text is not YAML, or not a mapping
  static YamlView load(std::string_view text, std::string_view source);

  /// @throws InputError when the key is missing
  YamlView at(const std::string& key) const;
  /// nullopt when missing or null. @throws InputError when this is no mapping
  std::optional<YamlView> find(const std::string& key) const;
  /// Keys of a mapping, in file order. @throws InputError for no mapping, or a key given twice
  std::vector<std::string> keys() const;

  bool isSequence() const { return node_.IsSequence(); }
  bool isMap() const { return node_.IsMap(); }

  std::string text() const;
  double number() const;  ///< finite
  int whole(int least, int most) const;
  std::vector<double> numbers() const;  ///< a sequence of finite numbers
  std::vector<double> numbers(std::size_t count) const;
  std::vector<YamlView> items() const;  ///< of a sequence

  /// An InputError at this place.
  [[noreturn]] void refuse(const std::string& problem) const;
  const std::string& source() const { return source_; }

 private:
  YamlView(const YAML::Node& node, std::string source, std::string path)
      : node_(node), source_(std::move(source)), path_(std::move(path)) {}
  std::string scalar(const char* expected) const;

  YAML::Node node_;
  std::string source_;
  std::string path_;
};

}  // namespace omnister::detail
