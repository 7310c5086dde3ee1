// SPDX-License-Identifier: Apache-2.0
#include "ros/node/parameters.h"

#include <ros/console.h>

#include <algorithm>
#include <cmath>
#include <sstream>

#include "omnister/common/numbers.h"

namespace omnister {
namespace {

std::string shown(XmlRpc::XmlRpcValue value) {
  if (value.getType() == XmlRpc::XmlRpcValue::TypeString) {
    return "\"" + printable(static_cast<std::string&>(value)) + "\"";
  }
  std::ostringstream text;
  text << value;
  return printable(text.str());
}

std::optional<double> asNumber(XmlRpc::XmlRpcValue value) {
  switch (value.getType()) {
    case XmlRpc::XmlRpcValue::TypeInt:
      return static_cast<int&>(value);
    case XmlRpc::XmlRpcValue::TypeDouble:
      return static_cast<double&>(value);
    case XmlRpc::XmlRpcValue::TypeString:
      return parseNumber(static_cast<std::string&>(value));
    default:
      return std::nullopt;
  }
}

}  // namespace

bool Parameters::has(const std::string& key) const { return node_.hasParam(key); }

bool Parameters::find(const std::string& key, XmlRpc::XmlRpcValue* value) {
  known_.insert(key);
  return node_.getParam(key, *value);
}

void Parameters::refuse(const std::string& key, const std::string& problem) const {
  throw InputError("parameter " + node_.resolveName(key), "", problem);
}

std::string Parameters::text(const std::string& key, const std::string& fallback) {
  XmlRpc::XmlRpcValue value;
  if (!find(key, &value)) return fallback;
  switch (value.getType()) {
    case XmlRpc::XmlRpcValue::TypeString:
      return static_cast<std::string&>(value);
    case XmlRpc::XmlRpcValue::TypeInt:
      return std::to_string(static_cast<int&>(value));
    case XmlRpc::XmlRpcValue::TypeDouble:
      return formatNumber(static_cast<double&>(value));
    case XmlRpc::XmlRpcValue::TypeBoolean:
      return static_cast<bool&>(value) ? "true" : "false";
    default:
      refuse(key, "is " + shown(value) + ", expected text");
  }
}

std::string Parameters::choice(const std::string& key, const std::string& fallback,
                               const std::vector<std::string>& choices) {
  const std::string value = text(key, fallback);
  std::string list;
  for (const std::string& choice : choices) {
    if (value == choice) return value;
    list += (list.empty() ? "" : ", ") + choice;
  }
  refuse(key, "is \"" + printable(value) + "\", expected one of " + list);
}

double Parameters::number(const std::string& key, double fallback, double min, double max,
                          const std::string& unit) {
  XmlRpc::XmlRpcValue value;
  if (!find(key, &value)) return fallback;
  const std::optional<double> number = asNumber(value);
  if (number && *number >= min && *number <= max && std::isfinite(*number)) return *number;
  refuse(key, "is " + shown(value) + ", expected a number from " + formatNumber(min) + " to " +
                  formatNumber(max) + (unit.empty() ? "" : " " + unit));
}

int Parameters::integer(const std::string& key, int fallback, int min, int max) {
  XmlRpc::XmlRpcValue value;
  if (!find(key, &value)) return fallback;
  const std::optional<double> number = asNumber(value);
  if (number && *number >= min && *number <= max && *number == std::floor(*number)) {
    return static_cast<int>(*number);
  }
  refuse(key, "is " + shown(value) + ", expected a whole number from " + std::to_string(min) +
                  " to " + std::to_string(max));
}

bool Parameters::flag(const std::string& key, bool fallback) {
  XmlRpc::XmlRpcValue value;
  if (!find(key, &value)) return fallback;
  if (value.getType() == XmlRpc::XmlRpcValue::TypeBoolean) return static_cast<bool&>(value);
  const std::string word = text(key, "");
  if (word == "true" || word == "1") return true;
  if (word == "false" || word == "0") return false;
  refuse(key, "is " + shown(value) + ", expected true or false");
}

std::vector<double> Parameters::numbers(const std::string& key, const XmlRpc::XmlRpcValue& given,
                                        std::size_t count) const {
  XmlRpc::XmlRpcValue value = given;
  std::optional<std::vector<double>> result;
  if (value.getType() == XmlRpc::XmlRpcValue::TypeString) {
    result = parseNumbers(static_cast<std::string&>(value));
  } else if (value.getType() == XmlRpc::XmlRpcValue::TypeArray) {
    result.emplace();
    for (int i = 0; i < value.size(); ++i) {
      result->push_back(asNumber(value[i]).value_or(std::nan("")));
    }
  }
  if (result && result->size() == count &&
      std::all_of(result->begin(), result->end(), [](double x) { return std::isfinite(x); })) {
    return *result;
  }
  refuse(key, "is " + shown(value) + ", expected " + std::to_string(count) + " finite numbers");
}

Eigen::Vector3d Parameters::direction(const std::string& key, const Eigen::Vector3d& fallback) {
  XmlRpc::XmlRpcValue value;
  if (!find(key, &value)) return fallback;
  const std::vector<double> given = numbers(key, value, 3);
  const Eigen::Vector3d vector(given[0], given[1], given[2]);
  const double length = vector.stableNorm();
  if (!(length > 1e-6) || !std::isfinite(length)) {
    refuse(key, "is " + shown(value) + ", expected a direction of length above 1e-6");
  }
  return vector / length;
}

Pose Parameters::pose(const std::string& key, const Pose& fallback) {
  XmlRpc::XmlRpcValue value;
  if (!find(key, &value)) return fallback;
  std::string text;
  for (const double x : numbers(key, value, 7)) text += formatNumber(x) + " ";
  return parsePose(text, "parameter " + node_.resolveName(key));
}

std::string Parameters::frame(const std::string& key, const std::string& fallback) {
  const std::string name = text(key, fallback);
  const bool plain = std::none_of(name.begin(), name.end(), [](unsigned char c) {
    return std::isspace(c) != 0 || std::iscntrl(c) != 0;
  });
  if ((name.empty() && !fallback.empty()) || (!name.empty() && name[0] == '/') || !plain ||
      name.size() > kLongestFrame) {
    refuse(key, "is \"" + printable(name) + "\", expected a frame name of at most " +
                    std::to_string(kLongestFrame) +
                    " characters, without blanks or a leading slash");
  }
  return name;
}

std::vector<std::string> Parameters::texts(const std::string& key) {
  XmlRpc::XmlRpcValue value;
  std::vector<std::string> result;
  if (!find(key, &value)) return result;
  if (value.getType() == XmlRpc::XmlRpcValue::TypeString) {
    result.push_back(static_cast<std::string&>(value));
    return result;
  }
  if (value.getType() != XmlRpc::XmlRpcValue::TypeArray) {
    refuse(key, "is " + shown(value) + ", expected a list of texts");
  }
  for (int i = 0; i < value.size(); ++i) {
    if (value[i].getType() != XmlRpc::XmlRpcValue::TypeString) {
      refuse(key, "is " + shown(value) + ", expected a list of texts");
    }
    result.push_back(static_cast<std::string&>(value[i]));
  }
  return result;
}

void Parameters::warnUnknown() const {
  std::vector<std::string> names;
  if (!node_.getParamNames(names)) return;
  const std::string prefix = node_.getNamespace() + "/";
  for (const std::string& name : names) {
    if (name.compare(0, prefix.size(), prefix) != 0) continue;
    const std::string key = name.substr(prefix.size());
    // Names with a slash belong to others (image_transport's plugins, dynamic_reconfigure).
    if (key.find('/') != std::string::npos || known_.count(key) > 0) continue;
    ROS_WARN_STREAM("parameter " << name << " is not known here and changes nothing");
  }
}

}  // namespace omnister
