// SPDX-License-Identifier: Apache-2.0
/// @file Names for settings of the sweep that go together: `fast`, `balanced`, `accurate`.
#pragma once

#include <string>
#include <vector>

namespace omnister {

struct MatchingPreset {
  const char* name;
  const char* meaning;  ///< one line for people
  int reduce;           ///< images are made smaller so many times first
  bool refine;          ///< grey values have the last word on a pair's ranges too
  int positions;        ///< displaced images, where there are more to choose from
};

/// From quick to slow.
const std::vector<MatchingPreset>& matchingPresets();

/// @throws Error for a name that is none of them
const MatchingPreset& matchingPreset(const std::string& name);

}  // namespace omnister
