// SPDX-License-Identifier: Apache-2.0
/// @file Text to numbers, whatever the locale.
#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace omnister {

/// A whole text as one number ("1e-3", "nan", "-inf" included); nullopt for anything else.
std::optional<double> parseNumber(std::string_view text);

/// Numbers separated by blanks or commas; nullopt when any part is not a number.
std::optional<std::vector<double>> parseNumbers(std::string_view text);

/// Shortest text that reads back as the same double; "nan", "inf", "-inf" for those.
std::string formatNumber(double value);

}  // namespace omnister
