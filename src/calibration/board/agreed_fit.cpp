// SPDX-License-Identifier: Apache-2.0
// A first fit of views that agree on one lens.
#include <algorithm>
#include <exception>

#include "calibration/agreement/view_agreement.h"
#include "calibration/board/calibration_steps.h"

namespace omnister::calibration {
namespace {

/// Marks of the views of `all` that `part` has too.
std::vector<bool> keptOf(const FitInput& all, const FitInput& part) {
  std::vector<bool> kept;
  for (const int index : all.index) {
    kept.push_back(std::find(part.index.begin(), part.index.end(), index) != part.index.end());
  }
  return kept;
}

/// Leaves out all but the first group, by name.
void leaveOut(const FitInput& input, const Agreement& agreement, Prepared& prepared) {
  std::vector<bool> keep(input.corners.size(), false);
  for (const std::size_t view : agreement.groups.front().views) keep[view] = true;
  prepared.warnings.push_back(describeContradiction(input, agreement));
  for (std::size_t g = 1; g < agreement.groups.size(); ++g) {
    const ViewGroup& group = agreement.groups[g];
    for (const std::size_t view : group.views) {
      ViewResult& result = prepared.views[static_cast<std::size_t>(input.index[view])];
      result.used = false;
      result.reason = group.change.empty() ? "it contradicts the larger set of views that agree"
                                           : "its image seems to be " + group.change;
    }
  }
  prepared.input = input.subset(keep);
  prepared.input.separate();
}

}  // namespace

Fit agreedFirstFit(Prepared& prepared, const CalibrationOptions& options) {
  if (options.contradictions == Contradictions::kKeep) {
    return trustedFirstFit(prepared, options.threads);
  }
  const FitInput all = prepared.input;
  Prepared tried = prepared;
  std::optional<Fit> fit;
  std::exception_ptr failure;
  try {
    fit = trustedFirstFit(tried, options.threads);
  } catch (const Error&) {
    failure = std::current_exception();
  }
  Agreement agreement;
  const FitInput* judged = &all;
  if (!fit) {
    agreement = viewAgreementFromFew(all, options.threads);
    if (agreement.groups.size() < 2) std::rethrow_exception(failure);
  } else {
    const std::vector<bool> kept = keptOf(all, tried.input);
    const auto lost = static_cast<std::size_t>(std::count(kept.begin(), kept.end(), false));
    if (lost >= 3 && 7 * lost >= kept.size()) {
      agreement = agreementOfRest(all, kept, *fit, options.threads);
    }
    if (agreement.groups.size() < 2) {
      agreement = viewAgreement(tried.input, *fit, options.threads);
      judged = &tried.input;
    }
  }
  if (agreement.groups.size() < 2) {
    prepared = std::move(tried);
    return *fit;
  }
  if (options.contradictions == Contradictions::kRefuse) {
    throw ContradictionError(describeContradiction(*judged, agreement));
  }
  if (judged == &tried.input) prepared.views = tried.views;
  leaveOut(*judged, agreement, prepared);
  return trustedFirstFit(prepared, options.threads);
}

}  // namespace omnister::calibration
