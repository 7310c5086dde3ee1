// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/target.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>

#include "calibration/target/kalibr_target.h"
#include "calibration/target/tag_families.h"
#include "calibration/target/target_keys.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"
#include "omnister/common/yaml_text.h"

namespace omnister {
namespace {

constexpr int kMaxSide = 100;
constexpr double kMinLength = 1e-6;
constexpr double kMaxLength = 1e6;
constexpr std::size_t kMaxFile = 64 << 10;

constexpr std::array<std::pair<TargetType, std::string_view>, 4> kTypes{{
    {TargetType::kCheckerboard, "checkerboard"},
    {TargetType::kCircles, "circles"},
    {TargetType::kCharuco, "charuco"},
    {TargetType::kAprilGrid, "aprilgrid"},
}};

void checkCount(int value, int low, int high, std::string_view source, std::string_view key) {
  if (value < low || value > high) {
    throw InputError(source, key,
                     "is " + std::to_string(value) + ", expected a whole number from " +
                         std::to_string(low) + " to " + std::to_string(high));
  }
}

void checkLength(double value, std::string_view source, std::string_view key) {
  if (!(value >= kMinLength && value <= kMaxLength)) {
    throw InputError(source, key,
                     "is " + formatNumber(value) + ", expected a length above 0, in metres");
  }
}

// The two legends of a grid of points: a half turn, and for a square grid the quarter turns.
int turned(int id, int quarter_turns, int cols, int rows) {
  int x = id % cols;
  int y = id / cols;
  for (int turn = 0; turn < quarter_turns; ++turn) {
    const int old_x = x;
    x = rows - 1 - y;
    y = old_x;
    std::swap(cols, rows);
  }
  return y * cols + x;
}

void addMarker(const cv::Mat& bits, double x, double y, double side, TargetArtwork& artwork) {
  const double cell = side / bits.cols;
  for (int row = 0; row < bits.rows; ++row) {
    // Neighbouring black cells of a row as one rectangle, so that no hairline shows between them.
    for (int col = 0; col < bits.cols; ++col) {
      if (bits.at<uchar>(row, col) != 0) continue;
      const int first = col;
      while (col + 1 < bits.cols && bits.at<uchar>(row, col + 1) == 0) ++col;
      artwork.rectangles.push_back(
          {x + first * cell, y + row * cell, (col + 1 - first) * cell, cell});
    }
  }
}

}  // namespace

std::string_view targetTypeName(TargetType type) {
  return std::find_if(kTypes.begin(), kTypes.end(), [&](const auto& t) { return t.first == type; })
      ->second;
}

void checkTarget(const Target& target, std::string_view source) {
  checkLength(target.square_m, source, "square_m");
  switch (target.type) {
    case TargetType::kCheckerboard:
      checkCount(target.cols, 3, kMaxSide, source, "cols");
      checkCount(target.rows, 3, kMaxSide, source, "rows");
      break;
    case TargetType::kCircles: {
      checkCount(target.cols, 2, kMaxSide, source, "cols");
      checkCount(target.rows, 2, kMaxSide, source, "rows");
      const double nearest = target.square_m * (target.asymmetric ? std::sqrt(2.0) : 1.0);
      if (target.dot_m != 0.0) checkLength(target.dot_m, source, "dot_m");
      if (target.dot_m >= nearest) {
        throw InputError(source, "dot_m",
                         "is " + formatNumber(target.dot_m) +
                             ", expected less than the distance of neighbouring dots, " +
                             formatNumber(nearest));
      }
      break;
    }
    case TargetType::kCharuco: {
      checkCount(target.cols, 2, kMaxSide, source, "cols");
      checkCount(target.rows, 2, kMaxSide, source, "rows");
      if (target.cols * target.rows < 6) {
        throw InputError(source, "rows", "and cols are 2, expected 3 or more for one of them");
      }
      checkLength(target.marker_m, source, "marker_m");
      if (target.marker_m >= target.square_m) {
        throw InputError(source, "marker_m",
                         "is " + formatNumber(target.marker_m) + ", expected less than square_m, " +
                             formatNumber(target.square_m));
      }
      const auto dictionary = tags::arucoDictionary(target.dictionary);
      if (!dictionary) {
        throw InputError(source, "dictionary",
                         "is " + inQuotes(target.dictionary) + ", expected one of " +
                             tags::arucoDictionaryNames());
      }
      const int markers = static_cast<int>(tags::charucoMarkers(target).size());
      if (markers > dictionary->bytesList.rows) {
        throw InputError(source, "dictionary",
                         "has " + std::to_string(dictionary->bytesList.rows) +
                             " markers, but the board needs " + std::to_string(markers));
      }
      break;
    }
    case TargetType::kAprilGrid: {
      checkCount(target.cols, 1, kMaxSide, source, "cols");
      checkCount(target.rows, 1, kMaxSide, source, "rows");
      if (!(target.spacing > 0.0 && target.spacing <= 10.0)) {
        throw InputError(source, "spacing",
                         "is " + formatNumber(target.spacing) +
                             ", expected the gap as a share of the tag, above 0 and at most 10");
      }
      const auto family = tags::aprilFamily(target.dictionary);
      if (!family) {
        throw InputError(
            source, "dictionary",
            "is " + inQuotes(target.dictionary) + ", expected one of " + tags::aprilFamilyNames());
      }
      if (target.cols * target.rows > static_cast<int>(family->ncodes)) {
        throw InputError(source, "dictionary",
                         "has " + std::to_string(family->ncodes) + " tags, but the board needs " +
                             std::to_string(target.cols * target.rows));
      }
      if (target.border_bits < 0 || target.border_bits > 2) {
        throw InputError(source, "border_bits",
                         "is " + std::to_string(target.border_bits) +
                             ", expected 1 or 2 (Kalibr's): the width of a tag's black border");
      }
      break;
    }
  }
}

Target parseTarget(std::string_view text, std::string_view source) {
  const YAML::Node root = readYaml(text, source, [](const YAML::Node& node) { return node; });
  if (!root.IsMap()) {
    throw InputError(
        source, "",
        "expected a target such as {type: checkerboard, cols: 8, rows: 6, square_m: 0.0244}");
  }
  if (isKalibrTarget(root)) {
    const Target target = parseKalibrTarget(root, source);
    checkTarget(target, source);
    return target;
  }
  TargetKeys keys(root, source);
  const std::string name = keys.required("type", "checkerboard, circles, charuco or aprilgrid");
  const auto type =
      std::find_if(kTypes.begin(), kTypes.end(), [&](const auto& t) { return t.second == name; });
  if (type == kTypes.end()) {
    throw InputError(
        source, "type",
        "is " + inQuotes(name) + ", expected checkerboard, circles, charuco or aprilgrid");
  }
  Target target;
  target.type = type->first;
  target.cols = keys.integer("cols");
  target.rows = keys.integer("rows");
  target.square_m = keys.number("square_m");
  switch (target.type) {
    case TargetType::kCheckerboard:
      break;
    case TargetType::kCircles:
      target.asymmetric = keys.flag("asymmetric");
      target.dot_m = keys.number("dot_m", 0.0);
      break;
    case TargetType::kCharuco:
      target.marker_m = keys.number("marker_m");
      target.dictionary = keys.required("dictionary", "one of " + tags::arucoDictionaryNames());
      target.legacy = keys.flag("legacy");
      break;
    case TargetType::kAprilGrid:
      target.spacing = keys.number("spacing");
      target.dictionary = keys.text("dictionary").value_or("tag36h11");
      target.joining_squares = keys.flag("joining_squares");
      if (keys.has("border_bits")) {
        target.border_bits = keys.integer("border_bits");
        checkCount(target.border_bits, 1, 2, source, "border_bits");
      }
      break;
  }
  keys.finish(name);
  checkTarget(target, source);
  return target;
}

Target readTarget(const std::filesystem::path& path) {
  return parseTarget(readFile(path, kMaxFile), path.string());
}

std::string formatTarget(const Target& target) {
  std::string text = "{type: " + std::string(targetTypeName(target.type)) +
                     ", cols: " + std::to_string(target.cols) +
                     ", rows: " + std::to_string(target.rows) +
                     ", square_m: " + formatNumber(target.square_m);
  switch (target.type) {
    case TargetType::kCheckerboard:
      break;
    case TargetType::kCircles:
      if (target.asymmetric) text += ", asymmetric: true";
      if (target.dot_m > 0.0) text += ", dot_m: " + formatNumber(target.dot_m);
      break;
    case TargetType::kCharuco:
      text += ", marker_m: " + formatNumber(target.marker_m) + ", dictionary: " + target.dictionary;
      if (target.legacy) text += ", legacy: true";
      break;
    case TargetType::kAprilGrid:
      text += ", spacing: " + formatNumber(target.spacing) + ", dictionary: " + target.dictionary;
      if (target.joining_squares) text += ", joining_squares: true";
      if (target.border_bits > 0) text += ", border_bits: " + std::to_string(target.border_bits);
      break;
  }
  return text + "}\n";
}

Eigen::Vector2i targetGrid(const Target& target) {
  switch (target.type) {
    case TargetType::kCharuco:
      return {target.cols - 1, target.rows - 1};
    case TargetType::kAprilGrid:
      return {2 * target.cols, 2 * target.rows};
    default:
      return {target.cols, target.rows};
  }
}

std::vector<Eigen::Vector3d> targetPoints(const Target& target) {
  const Eigen::Vector2i grid = targetGrid(target);
  const double side = target.square_m;
  std::vector<Eigen::Vector3d> points;
  points.reserve(grid.prod());
  for (int row = 0; row < grid.y(); ++row) {
    for (int col = 0; col < grid.x(); ++col) {
      if (target.type == TargetType::kAprilGrid) {
        const double pitch = 1.0 + target.spacing;
        const int across = col / 2, down = row / 2;  // tags, of two corners a side
        points.emplace_back(side * (across * pitch + col % 2), side * (down * pitch + row % 2),
                            0.0);
      } else if (target.asymmetric) {
        points.emplace_back(side * (2 * col + row % 2), side * row, 0.0);
      } else {
        points.emplace_back(side * col, side * row, 0.0);
      }
    }
  }
  return points;
}

std::vector<std::vector<int>> targetSymmetries(const Target& target) {
  const int cols = target.cols;
  const int rows = target.rows;
  const Eigen::Vector2i grid = targetGrid(target);
  std::vector<int> turns{0};
  if (target.type == TargetType::kCheckerboard) {
    // Turned by a half, the first square is the one across the board; by a quarter, at its other
    // corner.
    if ((cols + rows) % 2 == 0) turns.push_back(2);
    if (cols == rows && cols % 2 == 0) turns = {0, 1, 2, 3};
  } else if (target.type == TargetType::kCircles) {
    if (!target.asymmetric) turns.push_back(2);
    if (!target.asymmetric && cols == rows) turns = {0, 1, 2, 3};
    // Rows shifted right and left alternate: the half turn needs the last row to be shifted.
    if (target.asymmetric && rows % 2 == 0) turns.push_back(2);
  }
  std::vector<std::vector<int>> orders;
  for (const int turn : turns) {
    std::vector<int> order(grid.prod());
    for (int id = 0; id < grid.prod(); ++id) order[id] = turned(id, turn, grid.x(), grid.y());
    orders.push_back(std::move(order));
  }
  return orders;
}

TargetArtwork targetArtwork(const Target& target) {
  checkTarget(target, "target");
  TargetArtwork artwork;
  const double side = target.square_m;
  switch (target.type) {
    case TargetType::kCheckerboard:
      artwork.min = {-side, -side};
      artwork.max = {target.cols * side, target.rows * side};
      artwork.margin = 0.5 * side;
      for (int row = -1; row < target.rows; ++row) {
        for (int col = -1; col < target.cols; ++col) {
          if ((row + col) % 2 == 0)
            artwork.rectangles.push_back({col * side, row * side, side, side});
        }
      }
      break;
    case TargetType::kCircles: {
      const double nearest = side * (target.asymmetric ? std::sqrt(2.0) : 1.0);
      const double radius = 0.5 * (target.dot_m > 0.0 ? target.dot_m : 0.5 * nearest);
      artwork.min.setConstant(-radius);
      artwork.max.setConstant(radius);
      for (const Eigen::Vector3d& point : targetPoints(target)) {
        artwork.dots.push_back({point.x(), point.y(), radius});
        artwork.max = artwork.max.cwiseMax(point.head<2>() + Eigen::Vector2d::Constant(radius));
      }
      artwork.margin = nearest - radius;
      break;
    }
    case TargetType::kCharuco: {
      artwork.min = {-side, -side};
      artwork.max = {(target.cols - 1) * side, (target.rows - 1) * side};
      artwork.margin = 0.5 * side;
      for (int row = 0; row < target.rows; ++row) {
        for (int col = 0; col < target.cols; ++col) {
          if (tags::charucoBlack(target, col, row)) {
            artwork.rectangles.push_back({(col - 1) * side, (row - 1) * side, side, side});
          }
        }
      }
      const double inset = 0.5 * (side - target.marker_m);
      const auto markers = tags::charucoMarkers(target);
      for (std::size_t id = 0; id < markers.size(); ++id) {
        addMarker(tags::arucoBits(target.dictionary, static_cast<int>(id)),
                  (markers[id].x() - 1) * side + inset, (markers[id].y() - 1) * side + inset,
                  target.marker_m, artwork);
      }
      break;
    }
    case TargetType::kAprilGrid: {
      const double gap = target.spacing * side;
      const double pitch = side + gap;
      const double rim = target.joining_squares ? gap : 0.0;
      artwork.min = {-rim, -rim};
      artwork.max = {target.cols * pitch - gap + rim, target.rows * pitch - gap + rim};
      artwork.margin = gap;
      for (int row = 0; row < target.rows; ++row) {
        for (int col = 0; col < target.cols; ++col) {
          const int id = (target.rows - 1 - row) * target.cols + col;
          addMarker(tags::aprilBits(target.dictionary, id, std::max(1, target.border_bits)),
                    col * pitch, row * pitch, side, artwork);
        }
      }
      if (target.joining_squares) {
        for (int row = 0; row <= target.rows; ++row) {
          for (int col = 0; col <= target.cols; ++col) {
            artwork.rectangles.push_back({col * pitch - gap, row * pitch - gap, gap, gap});
          }
        }
      }
      break;
    }
  }
  return artwork;
}

}  // namespace omnister
