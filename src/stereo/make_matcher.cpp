// SPDX-License-Identifier: Apache-2.0
#include "omnister/common/error.h"
#include "omnister/stereo/matcher.h"
#include "omnister/stereo/thesis_matcher.h"
#include "stereo/sweep/sweep_matcher.h"

namespace omnister {

std::unique_ptr<Matcher> makeMatcher(const std::string& name, const StereoGeometry& geometry,
                                     const MatcherOptions& options) {
  if (name == "thesis") return makeThesisMatcher(geometry, options);
  if (name == "sweep") return makeSweepMatcher(geometry, options);
  throw Error("unknown matcher '" + printable(name) + "', expected sweep or thesis");
}

}  // namespace omnister
