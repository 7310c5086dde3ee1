// SPDX-License-Identifier: Apache-2.0
/// @file Reading a node's private parameters: every value is checked, and what is refused names the
/// resolved key, the value and the range. Load them all into one struct before anything starts.
#pragma once

#include <ros/node_handle.h>

#include <Eigen/Core>
#include <set>
#include <string>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/common/pose.h"

namespace omnister {

inline constexpr std::size_t kLongestFrame = 255;  ///< of names of frames that we take [characters]

/// What `read` makes of a file that a parameter names. What goes wrong names the parameter, too.
template <typename Read>
auto fromFileOf(const ros::NodeHandle& private_node, const std::string& key, const Read& read) {
  try {
    return read();
  } catch (const std::exception& error) {
    throw InputError("parameter " + private_node.resolveName(key), "", error.what());
  }
}

/// Getters throw InputError("~key", …). A parameter that is not set takes its default.
class Parameters {
 public:
  /// @param node the private node handle
  explicit Parameters(const ros::NodeHandle& node) : node_(node) {}

  bool has(const std::string& key) const;

  /// A string; numbers and booleans are taken as they are written (launch files turn `0` into a
  /// number).
  std::string text(const std::string& key, const std::string& fallback);
  std::string choice(const std::string& key, const std::string& fallback,
                     const std::vector<std::string>& choices);
  /// A finite number in [min, max]. @param unit for the message, e.g. "m"
  double number(const std::string& key, double fallback, double min, double max,
                const std::string& unit = "");
  int integer(const std::string& key, int fallback, int min, int max);
  bool flag(const std::string& key, bool fallback);
  /// Three finite numbers, as a list or as text "x y z", normalised.
  Eigen::Vector3d direction(const std::string& key, const Eigen::Vector3d& fallback);
  /// "tx ty tz qx qy qz qw" (metres), as text or as a list.
  Pose pose(const std::string& key, const Pose& fallback);
  /// A tf frame name: not empty unless the default is, no leading slash.
  std::string frame(const std::string& key, const std::string& fallback);
  std::vector<std::string> texts(const std::string& key);

  /// The same for a parameter of this node. @param read gets the path
  template <typename Read>
  auto file(const std::string& key, const std::string& path, const Read& read) const {
    return fromFileOf(node_, key, [&] { return read(path); });
  }

  /// A key that others read.
  void ignore(const std::string& key) { known_.insert(key); }

  /// Warns of parameters that stand in the namespace and that none of the getters asked for.
  void warnUnknown() const;

 private:
  bool find(const std::string& key, XmlRpc::XmlRpcValue* value);
  [[noreturn]] void refuse(const std::string& key, const std::string& problem) const;
  std::vector<double> numbers(const std::string& key, const XmlRpc::XmlRpcValue& value,
                              std::size_t count) const;

  ros::NodeHandle node_;
  std::set<std::string> known_;
};

}  // namespace omnister
