// SPDX-License-Identifier: Apache-2.0
// `project` and `unproject`: rays to pixels and back, a line at a time.
#include <array>
#include <cmath>
#include <iostream>
#include <limits>
#include <memory>
#include <string>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_file.h"
#include "tools/cli/commands.h"

namespace omnister::tools {
namespace {

constexpr std::size_t kMaxLine = 4096;

/// The next line of standard input; of one that is too long as much as shows that, so that input
/// without end is refused before it fills the memory.
bool readLine(std::string& line) {
  std::array<char, kMaxLine + 2> text;
  std::cin.getline(text.data(), text.size());
  auto count = static_cast<std::size_t>(std::cin.gcount());
  if (count == 0) return false;
  if (std::cin.good()) --count;  // the line feed
  line.assign(text.data(), count);
  return true;
}

template <std::size_t N>
std::array<double, N> readNumbers(const std::string& line, std::size_t line_number,
                                  const char* expected) {
  static constexpr const char* kBlanks = " \t\r,";
  std::array<double, N> out{};
  std::size_t count = 0;
  std::size_t begin = line.find_first_not_of(kBlanks);
  bool good = line.size() <= kMaxLine;
  while (good && begin != std::string::npos) {
    const std::size_t end = std::min(line.find_first_of(kBlanks, begin), line.size());
    const auto number = parseNumber(std::string_view(line).substr(begin, end - begin));
    good = number && count < N;
    if (good) out[count++] = *number;
    begin = line.find_first_not_of(kBlanks, end);
  }
  if (!good || count != N) {
    throw InputError("standard input", "line " + std::to_string(line_number),
                     "is \"" + printable(line, 60) + "\", expected " + expected);
  }
  return out;
}

/// Writes rows of numbers as they come, or collects them for --json.
template <std::size_t N>
class Rows {
 public:
  Rows(bool json, const char* key) : json_(json), key_(key) {}

  void add(const std::array<double, N>& row) {
    if (json_) {
      if (std::isnan(row[0])) {
        rows_.push_back(nullptr);
      } else {
        rows_.push_back(row);
      }
      return;
    }
    for (std::size_t i = 0; i < N; ++i) {
      if (i > 0) text_ += ' ';
      text_ += formatNumber(row[i]);
    }
    text_ += '\n';
    // Answer at once when a person or a program waits for it.
    if (text_.size() > (1u << 16) || std::cin.rdbuf()->in_avail() <= 0) flush();
  }
  void flush() {
    std::cout.write(text_.data(), static_cast<std::streamsize>(text_.size()));
    std::cout.flush();
    text_.clear();
    if (!std::cout) throw Error("cannot write to standard output");
  }
  void finish() {
    if (json_) {
      nlohmann::ordered_json result;
      result[key_] = std::move(rows_);
      printResult(true, result);
    } else {
      flush();
    }
  }

 private:
  bool json_;
  const char* key_;
  std::string text_;
  nlohmann::ordered_json rows_ = nlohmann::ordered_json::array();
};

template <std::size_t In, std::size_t Out, typename Convert>
void convertLines(bool json, const char* key, const char* expected, const Convert& convert) {
  std::ios::sync_with_stdio(false);
  std::cin.tie(nullptr);
  Rows<Out> rows(json, key);
  std::string line;
  for (std::size_t number = 1; readLine(line); ++number) {
    std::array<double, In> values;
    try {
      values = readNumbers<In>(line, number, expected);
    } catch (const InputError&) {
      if (!json) rows.flush();
      throw;
    }
    rows.add(convert(values));
  }
  if (std::cin.bad()) throw Error("cannot read standard input");
  rows.finish();
}

struct Options {
  std::string lens;
};

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

}  // namespace

void addProject(CLI::App& app) {
  CLI::App* command = app.add_subcommand("project", "Rays to pixels, a line at a time");
  const auto options = std::make_shared<Options>();
  command->footer(
      "Reads lines of `x y z` (optical frame: x right, y down, z forward; any length) from "
      "standard\n"
      "input and writes one line of `u v` [px] for each, `nan nan` outside the lens' field. "
      "Pixels\n"
      "outside the image, but inside the field, are not clipped.");
  command->add_option("--lens", options->lens, "Lens file")->required();
  const bool& json = addJsonFlag(*command);
  command->callback([options, &json] {
    const LensFile file = readLensFile(options->lens);
    convertLines<3, 2>(json, "pixels", "three numbers: x y z",
                       [&](const std::array<double, 3>& ray) -> std::array<double, 2> {
                         const auto pixel = file.lens->project({ray[0], ray[1], ray[2]});
                         if (!pixel) return {kNaN, kNaN};
                         return {pixel->x(), pixel->y()};
                       });
  });
}

void addUnproject(CLI::App& app) {
  CLI::App* command = app.add_subcommand("unproject", "Pixels to rays, a line at a time");
  const auto options = std::make_shared<Options>();
  command->footer(
      "Reads lines of `u v` [px] from standard input and writes one line of `x y z` for each: the "
      "unit\n"
      "ray in the optical frame (x right, y down, z forward), `nan nan nan` outside the lens' "
      "field.");
  command->add_option("--lens", options->lens, "Lens file")->required();
  const bool& json = addJsonFlag(*command);
  command->callback([options, &json] {
    const LensFile file = readLensFile(options->lens);
    convertLines<2, 3>(json, "rays", "two numbers: u v",
                       [&](const std::array<double, 2>& pixel) -> std::array<double, 3> {
                         const auto ray = file.lens->unproject({pixel[0], pixel[1]});
                         if (!ray) return {kNaN, kNaN, kNaN};
                         return {ray->x(), ray->y(), ray->z()};
                       });
  });
}

}  // namespace omnister::tools
