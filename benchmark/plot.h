// SPDX-License-Identifier: Apache-2.0
/// @file Small line charts as SVG.
#pragma once

#include <string>
#include <utility>
#include <vector>

namespace omnister::bench {

struct Series {
  std::string x_label, y_label;
  std::vector<std::pair<double, double>> points;
};

/// One chart a series, side by side, axes from zero.
std::string drawCharts(const std::vector<Series>& charts);

}  // namespace omnister::bench
