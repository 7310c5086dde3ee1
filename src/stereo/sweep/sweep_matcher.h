// SPDX-License-Identifier: Apache-2.0
/// @file The fast matcher: candidates are descriptors laid once along the displaced image's
/// epipolar curves, compared with windows of distinct pixels of the distorted reference image
/// (Johnson 1997, fig. 5.5). See src/stereo/sweep/grid/geometry.h for the coordinates.
#pragma once

#include <memory>

#include "omnister/stereo/matcher.h"

namespace omnister {

/// @throws Error as makeMatcher()
std::unique_ptr<Matcher> makeSweepMatcher(const StereoGeometry& geometry,
                                          const MatcherOptions& options);

}  // namespace omnister
