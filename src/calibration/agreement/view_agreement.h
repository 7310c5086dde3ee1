// SPDX-License-Identifier: Apache-2.0
/// @file Do all views show one camera at one setting? Images that were turned, mirrored, taken at
/// another focus or by another camera each fit a lens well enough, only not the same one.
#pragma once

#include <string>
#include <vector>

#include "calibration/fit/fit.h"

namespace omnister::calibration {

/// Views that agree on one lens.
struct ViewGroup {
  std::vector<std::size_t> views;  ///< places in FitInput, ascending
  double rms_px = 0.0;             ///< with a lens of their own
  /// What would make the first group's lens fit: "turned by 180 degrees", "mirrored left to right",
  /// ...; empty for the first group and where nothing of the kind does.
  std::string change;
};

struct Agreement {
  std::vector<ViewGroup> groups;  ///< the largest first; one where all views agree
  double together_px = 0.0;       ///< RMS of one lens for all of them
};

/// Looks for views that contradict each other: whether each would like another centre and scale
/// than the common lens has, and whether these wishes fall into groups. A split counts only where
/// lenses of their own serve the groups clearly better than the richest common one, each group has
/// three views or more, and the groups' lenses do not serve each other.
/// @param fit any fit of all views, each with a pose of its own
Agreement viewAgreement(const FitInput& input, const Fit& fit, int threads);

/// The same for views that no common lens explains: by lenses of a few views each.
Agreement viewAgreementFromFew(const FitInput& input, int threads);

/// Whether views that a fit of others left aside agree on a lens of their own.
/// @param fit of the views `kept` of the input @return `kept` first; one group where they do not
Agreement agreementOfRest(const FitInput& input, const std::vector<bool>& kept, const Fit& fit,
                          int threads);

/// What a person is told of groups that contradict each other. @param names of all views
std::string describeContradiction(const FitInput& input, const Agreement& agreement);

}  // namespace omnister::calibration
