// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/detections.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <set>
#include <tuple>
#include <unordered_map>

#include "calibration/data/csv_fields.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"

namespace omnister {

namespace {

using namespace calibration;

constexpr std::array<std::string_view, 6> kColumns = {"view", "u_px", "v_px", "x_m", "y_m", "z_m"};
constexpr std::string_view kHeader = "view,u_px,v_px,x_m,y_m,z_m";
constexpr double kLargestCoordinate = 1e9;
constexpr std::size_t kLongestName = 4096;

class DetectionsParser {
 public:
  DetectionsParser(std::string_view text, std::string_view source, cv::Size image_size)
      : text_(text), source_(source) {
    detections_.image_size = image_size;
  }

  Detections parse() {
    if (detections_.image_size.width <= 0 || detections_.image_size.height <= 0) {
      throw InputError(source_, "", "needs an image size of at least 1x1 pixels");
    }
    parseHeader();
    while (!text_.empty()) {
      ++line_number_;
      const std::string_view line = trimmed(takeLine(text_));
      if (!line.empty()) parseRow(line);
    }
    if (detections_.views.empty())
      throw InputError(source_, "", "holds no corner below its header");
    return std::move(detections_);
  }

 private:
  [[noreturn]] void refuse(std::string_view column, const std::string& problem) const {
    std::string place = "line " + std::to_string(line_number_);
    if (!column.empty()) place += ", column " + std::string(column);
    throw InputError(source_, place, problem);
  }

  void parseHeader() {
    line_number_ = 1;
    const std::string header = takeHeader(text_);
    if (header != kHeader) {
      refuse("", "is " + inQuotes(header) + ", expected the header " + std::string(kHeader));
    }
  }

  double number(std::string_view field, std::size_t column) const {
    const auto value = parseNumber(field);
    if (!value || !std::isfinite(*value)) {
      refuse(kColumns[column], "is " + inQuotes(field) + ", expected a finite number");
    }
    if (std::abs(*value) > kLargestCoordinate) {
      refuse(kColumns[column], "is " + inQuotes(field) + ", expected at most 1e9 either way");
    }
    return *value;
  }

  void parseRow(std::string_view line) {
    const std::vector<std::string_view> fields = fieldsOf(line);
    if (fields.size() != kColumns.size()) {
      refuse("", "has " + std::to_string(fields.size()) +
                     " fields, expected 6: " + std::string(kHeader));
    }
    if (fields[0].empty()) refuse(kColumns[0], "is empty, expected the name of a view");
    if (fields[0].size() > kLongestName) refuse(kColumns[0], "is longer than 4096 characters");

    const Eigen::Vector2d pixel(number(fields[1], 1), number(fields[2], 2));
    const Eigen::Vector3d point(number(fields[3], 3), number(fields[4], 4), number(fields[5], 5));
    const cv::Size size = detections_.image_size;
    const std::array<int, 2> extent = {size.width, size.height};
    for (int axis = 0; axis < 2; ++axis) {
      if (pixel[axis] < -0.5 || pixel[axis] > extent[axis] - 0.5) {
        refuse(kColumns[1 + axis], "is " + formatNumber(pixel[axis]) + ", outside the image of " +
                                       std::to_string(size.width) + "x" +
                                       std::to_string(size.height) + " pixels");
      }
    }

    const auto [entry, is_new] =
        index_.try_emplace(std::string(fields[0]), detections_.views.size());
    if (is_new) {
      detections_.views.emplace_back().name = fields[0];
      seen_.emplace_back();
    }
    ViewDetections& view = detections_.views[entry->second];
    if (!seen_[entry->second].insert({point.x(), point.y(), point.z()}).second) {
      refuse("", "repeats a board point of view " + inQuotes(fields[0]) +
                     ", expected each point once in a view");
    }
    view.pixels.push_back(pixel);
    view.points.push_back(point);
  }

  std::string_view text_;
  std::string_view source_;
  std::size_t line_number_ = 0;
  Detections detections_;
  std::unordered_map<std::string, std::size_t> index_;
  std::vector<std::set<std::tuple<double, double, double>>> seen_;
};

}  // namespace

Detections parseDetections(std::string_view text, std::string_view source, cv::Size image_size) {
  return DetectionsParser(text, source, image_size).parse();
}

Detections readDetections(const std::filesystem::path& path, cv::Size image_size) {
  return parseDetections(readFile(path), path.string(), image_size);
}

std::string formatDetections(const Detections& detections) {
  std::string text(kHeader);
  text += '\n';
  for (const ViewDetections& view : detections.views) {
    std::string name = view.name;
    // A comma or a line end in a file name would break the row.
    std::replace_if(
        name.begin(), name.end(), [](char c) { return c == ',' || c == '\n' || c == '\r'; }, '_');
    for (std::size_t i = 0; i < view.pixels.size(); ++i) {
      text += name;
      for (const double value : {view.pixels[i].x(), view.pixels[i].y(), view.points[i].x(),
                                 view.points[i].y(), view.points[i].z()}) {
        text += ',';
        text += formatNumber(value);
      }
      text += '\n';
    }
  }
  return text;
}

}  // namespace omnister
