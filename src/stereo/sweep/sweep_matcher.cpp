// SPDX-License-Identifier: Apache-2.0
#include "stereo/sweep/sweep_matcher.h"

#include <utility>

#include "stereo/result/range_uncertainty.h"
#include "stereo/sweep/multi_position.h"
#include "stereo/sweep/pair/pair.h"

namespace omnister {

std::unique_ptr<Matcher> makeSweepMatcher(const StereoGeometry& geometry,
                                          const MatcherOptions& options) {
  checkSweep(geometry, options);
  std::unique_ptr<Matcher> matcher;
  if (geometry.displaced.size() > 1 || options.refine || !options.prior.empty())
    matcher = makeMultiPositionMatcher(geometry, options);
  else
    matcher = makeSweepPair(geometry, options);
  return withCalibrationSigma(std::move(matcher), geometry, options);
}

}  // namespace omnister
