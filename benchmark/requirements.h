// SPDX-License-Identifier: Apache-2.0
/// @file Figures beside what they must reach.
#pragma once

#include <cstdio>
#include <nlohmann/json.hpp>
#include <string>

namespace omnister::bench {

/// Prints each figure with its limit as it comes, and keeps them.
class Requirements {
 public:
  /// @param least the figure must reach the limit; else it must not exceed it
  void check(const std::string& what, double value, double limit, bool least = false) {
    const bool holds = least ? value >= limit : value <= limit;
    std::printf("%-11s %-66s %8.4f, %s %g\n", holds ? "holds" : "FALLS SHORT", what.c_str(), value,
                least ? "at least" : "at most", limit);
    json_.push_back({{"what", what}, {"value", value}, {"limit", limit}, {"holds", holds}});
    short_ += !holds;
  }
  int fallShort() const { return short_; }
  const nlohmann::ordered_json& json() const { return json_; }

 private:
  nlohmann::ordered_json json_ = nlohmann::ordered_json::array();
  int short_ = 0;
};

}  // namespace omnister::bench
