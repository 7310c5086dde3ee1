// SPDX-License-Identifier: Apache-2.0
#include "lens/file/yaml_view.h"

#include <algorithm>
#include <cmath>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/common/yaml_text.h"

namespace omnister::detail {
namespace {

// More numbers than any file of ours holds (the covariance of the largest lens has 1600).
constexpr std::size_t kMaxItems = 100000;

std::string quoted(const std::string& text) { return "\"" + printable(text, 60) + "\""; }

}  // namespace

YamlView YamlView::load(std::string_view text, std::string_view source) {
  std::string copy(text);
  // OpenCV writes a header that is no YAML directive.
  if (copy.rfind("%YAML:", 0) == 0) copy[0] = '#';
  YAML::Node root;
  try {
    root = yamlDocument(copy, source);
  } catch (const YAML::Exception& error) {
    throw yamlError(source, error);
  } catch (const InputError&) {
    throw;
  } catch (const std::exception& error) {
    throw InputError(source, "", std::string("is not YAML: ") + error.what());
  }
  YamlView view(root, std::string(source), "");
  if (!root.IsMap()) view.refuse("is not a YAML mapping of keys to values");
  return view;
}

void YamlView::refuse(const std::string& problem) const {
  std::string place = path_;
  const YAML::Mark mark = node_.Mark();
  if (!place.empty() && !mark.is_null()) place += " (line " + std::to_string(mark.line + 1) + ")";
  throw InputError(source_, place, problem);
}

std::vector<std::string> YamlView::keys() const {
  if (!node_.IsMap()) refuse("is not a mapping, expected keys with values");
  std::vector<std::string> out;
  if (node_.size() > kMaxItems) refuse("has too many keys");
  for (const auto& entry : node_) {
    if (!entry.first.IsScalar()) refuse("has a key that is no plain word");
    out.push_back(entry.first.Scalar());
  }
  std::vector<std::string> sorted = out;
  std::sort(sorted.begin(), sorted.end());
  const auto twice = std::adjacent_find(sorted.begin(), sorted.end());
  if (twice != sorted.end()) refuse("has the key " + quoted(*twice) + " twice");
  return out;
}

std::optional<YamlView> YamlView::find(const std::string& key) const {
  const std::vector<std::string> all = keys();
  if (std::find(all.begin(), all.end(), key) == all.end()) return std::nullopt;
  YAML::Node child = node_[key];
  if (child.IsNull()) return std::nullopt;
  return YamlView(child, source_, path_.empty() ? key : path_ + "." + key);
}

YamlView YamlView::at(const std::string& key) const {
  auto child = find(key);
  if (!child) {
    throw InputError(source_, path_.empty() ? key : path_ + "." + key, "is missing");
  }
  return *child;
}

std::string YamlView::scalar(const char* expected) const {
  if (!node_.IsScalar()) {
    refuse(std::string(node_.IsSequence() ? "is a list" : "is a mapping") + ", expected " +
           expected);
  }
  return node_.Scalar();
}

std::string YamlView::text() const { return scalar("text"); }

double YamlView::number() const {
  const std::string word = scalar("a number");
  const auto value = parseNumber(word);
  if (!value || !std::isfinite(*value)) refuse("is " + quoted(word) + ", expected a finite number");
  return *value;
}

int YamlView::whole(int least, int most) const {
  const double value = number();
  if (value != std::floor(value) || value < least || value > most) {
    refuse("is " + formatNumber(value) + ", expected a whole number from " + std::to_string(least) +
           " to " + std::to_string(most));
  }
  return static_cast<int>(value);
}

std::vector<YamlView> YamlView::items() const {
  if (!node_.IsSequence()) refuse("is not a list");
  if (node_.size() > kMaxItems) refuse("has too many entries");
  std::vector<YamlView> out;
  std::size_t i = 0;
  for (const auto& entry : node_) {
    out.push_back(YamlView(entry, source_, path_ + "[" + std::to_string(i++) + "]"));
  }
  return out;
}

std::vector<double> YamlView::numbers() const {
  if (!node_.IsSequence()) refuse("is not a list, expected a list of numbers");
  std::vector<double> out;
  for (const YamlView& item : items()) out.push_back(item.number());
  return out;
}

std::vector<double> YamlView::numbers(std::size_t count) const {
  if (node_.IsSequence() && node_.size() != count) {
    refuse("has " + std::to_string(node_.size()) + " entries, expected " + std::to_string(count) +
           " numbers");
  }
  return numbers();
}

}  // namespace omnister::detail
