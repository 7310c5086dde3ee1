// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/presets.h"

#include "omnister/common/error.h"

namespace omnister {

const std::vector<MatchingPreset>& matchingPresets() {
  static const std::vector<MatchingPreset> presets = {
      {"fast", "images of half the size, one displaced image", 2, false, 1},
      {"balanced", "all pixels, one displaced image", 1, false, 1},
      {"accurate", "all pixels, four displaced images where there are, grey values refined", 1,
       true, 4},
  };
  return presets;
}

const MatchingPreset& matchingPreset(const std::string& name) {
  std::string names;
  for (const MatchingPreset& preset : matchingPresets()) {
    if (name == preset.name) return preset;
    names += std::string(names.empty() ? "" : ", ") + preset.name;
  }
  throw Error("preset is '" + printable(name, 60) + "', expected one of " + names);
}

}  // namespace omnister
