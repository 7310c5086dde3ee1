// SPDX-License-Identifier: Apache-2.0
#include "omnister/common/numbers.h"

#include <array>
#include <charconv>

namespace omnister {

std::optional<double> parseNumber(std::string_view text) {
  if (!text.empty() && text.front() == '+') text.remove_prefix(1);
  if (text.empty() || text.front() == '+') return std::nullopt;
  double value = 0.0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (error != std::errc() || end != text.data() + text.size()) return std::nullopt;
  return value;
}

std::optional<std::vector<double>> parseNumbers(std::string_view text) {
  static constexpr std::string_view kSeparators = " \t\r\n,";
  std::vector<double> numbers;
  for (;;) {
    const std::size_t begin = text.find_first_not_of(kSeparators);
    if (begin == std::string_view::npos) return numbers;
    const std::size_t end = text.find_first_of(kSeparators, begin);
    const auto number = parseNumber(text.substr(begin, end - begin));
    if (!number) return std::nullopt;
    numbers.push_back(*number);
    if (end == std::string_view::npos) return numbers;
    text.remove_prefix(end);
  }
}

std::string formatNumber(double value) {
  std::array<char, 32> text{};
  const auto [end, error] = std::to_chars(text.data(), text.data() + text.size(), value);
  return std::string(text.data(), end);
}

}  // namespace omnister
