// SPDX-License-Identifier: Apache-2.0
/// @file The measurements of Johnson 1997 made again on simulated boards.
#pragma once

#include <nlohmann/json.hpp>
#include <string>

#include "omnister/common/progress.h"

namespace omnister::tools {

struct ThesisEvaluationOptions {
  /// Size of the images beside the thesis' (3060x2036 for chapters 4 and 5): 1 is the full thing.
  double scale = 1.0;
  /// Of the pixels whose depth is measured, at full size [px].
  int grid = 80;
  int threads = 0;  ///< 0: every core
  Progress progress;
};

struct ThesisEvaluation {
  std::string html;             ///< one page that needs no other file
  nlohmann::ordered_json json;  ///< the figures
};

/// Figures 3.2, 3.3, 3.5, 4.2, 4.5, 4.9, 4.10, 4.12 to 4.15, 5.1, 5.3, 5.6 to 5.8 and tables 4.1
/// and 5.1 for the spherical lens, the quadric by the thesis' procedure and by our fit, the conic
/// and the asphere, on three lens shapes; the masks of fig. 5.4 and fig. 5.5; memory; and which of
/// the claims hold.
/// @throws Error for options out of range
ThesisEvaluation evaluateThesis(const ThesisEvaluationOptions& options);

}  // namespace omnister::tools
