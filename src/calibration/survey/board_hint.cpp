// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/board_hint.h"

#include <algorithm>
#include <array>
#include <vector>

#include "calibration/detect/board_detectors.h"
#include "calibration/target/tag_families.h"
#include "omnister/calibration/detector.h"

namespace omnister {
namespace {

using detect::Budget;
using detect::GrayImage;
using detect::Marker;

constexpr std::size_t kFewestMarkers = 4;

std::size_t cornersOf(const cv::Mat& image, const Target& target, double seconds) {
  DetectorOptions options;
  options.threads = 1;
  options.seconds_per_image = seconds;
  const auto view = detectTarget(image, target, options);
  return view ? view->pixels.size() : 0;
}

bool isCoded(const Target& target) {
  return target.type == TargetType::kCharuco || target.type == TargetType::kAprilGrid;
}

/// Both eyes of a stereo camera in one picture, beside or above each other.
std::optional<std::string> shownTwice(const cv::Mat& image, const Target& asked) {
  const bool wide = image.cols >= 1.6 * image.rows;
  const bool high = image.rows >= 1.2 * image.cols;
  if (!wide && !high) return std::nullopt;
  const cv::Size half(wide ? image.cols / 2 : image.cols, wide ? image.rows : image.rows / 2);
  const cv::Point second(wide ? image.cols - half.width : 0, wide ? 0 : image.rows - half.height);
  const std::size_t enough = targetPoints(asked).size() / 2;
  for (const cv::Point& corner : {cv::Point(0, 0), second}) {
    const std::size_t found = cornersOf(image(cv::Rect(corner, half)).clone(), asked, 1.5);
    if (found < std::max<std::size_t>(enough, 4)) return std::nullopt;
  }
  return std::string("shows the board twice, once in either half: two cameras' pictures ") +
         (wide ? "side by side" : "above each other") +
         " in one file; split them, and calibrate each camera with its own (" +
         (wide ? "left and right" : "upper and lower") + " halves)";
}

/// Markers that lie on a board as its numbers say.
std::size_t fittingMarkers(const GrayImage& image, const Target& target) {
  const Budget budget(1.5);
  const auto decoded = target.type == TargetType::kCharuco
                           ? detect::decodeCharuco(image, target, budget)
                           : detect::decodeAprilGrid(image, target, budget);
  const auto placed = target.type == TargetType::kCharuco ? detect::placeCharuco(decoded, target)
                                                          : detect::placeAprilGrid(decoded, target);
  return detect::consistentMarkers(placed).size();
}

std::optional<std::string> anotherLayout(const cv::Mat& image, const Target& asked,
                                         std::size_t found) {
  // The layouts differ for an even number of rows alone.
  if (asked.type != TargetType::kCharuco || asked.rows % 2 != 0) return std::nullopt;
  Target other = asked;
  other.legacy = !asked.legacy;
  // With an odd number of columns the wrong one finds the board too, a column off and a column
  // less.
  const std::size_t there = cornersOf(image, other, 2.0);
  if (there < 4 || 10 * there < 11 * found) return std::nullopt;
  return std::string("shows the layout of OpenCV ") + (other.legacy
                                                           ? "before 4.6.0, expected legacy: true"
                                                           : "since 4.6.0, expected legacy: false");
}

std::optional<std::string> anotherBorder(const cv::Mat& image, const Target& asked,
                                         std::size_t found) {
  if (asked.type != TargetType::kAprilGrid || asked.border_bits == 0) return std::nullopt;
  Target other = asked;
  other.border_bits = 3 - asked.border_bits;
  const std::size_t there = cornersOf(image, other, 2.0);
  if (there < 4 || 2 * there < 3 * found) return std::nullopt;
  return "shows tags with a black border of " + std::to_string(other.border_bits) +
         " bits, expected border_bits: " + std::to_string(other.border_bits);
}

std::vector<std::string> otherDictionaries(const Target& asked) {
  if (asked.type == TargetType::kAprilGrid) return {"tag36h11", "tag36h10", "tag25h9", "tag16h5"};
  std::vector<std::string> names;
  // The small ones first: larger ones of the same bits begin with the same markers.
  for (const char* count : {"50", "100", "250", "1000"}) {
    for (const char* bits : {"4X4", "5X5", "6X6", "7X7"}) {
      names.push_back(std::string("DICT_") + bits + "_" + count);
    }
  }
  for (const char* name : {"DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9",
                           "DICT_APRILTAG_36h10", "DICT_APRILTAG_36h11"}) {
    names.emplace_back(name);
  }
  return names;
}

bool fitsInto(const Target& target) {
  try {
    checkTarget(target, "target");
    return true;
  } catch (const std::exception&) {
    return false;
  }
}

std::optional<std::string> anotherDictionary(const GrayImage& image, const Target& asked) {
  if (!isCoded(asked)) return std::nullopt;
  const std::size_t as_asked = fittingMarkers(image, asked);
  std::size_t most = std::max(kFewestMarkers, 2 * as_asked + 1);
  std::string best;
  for (const std::string& name : otherDictionaries(asked)) {
    Target other = asked;
    other.dictionary = name;
    if (name == asked.dictionary || !fitsInto(other)) continue;
    const std::size_t count = fittingMarkers(image, other);
    // Of dictionaries that fit alike, the first.
    if (count < most || (!best.empty() && count == most)) continue;
    most = count;
    best = name;
  }
  if (best.empty()) return std::nullopt;
  return "shows " + std::to_string(most) + " markers of " + best +
         ", expected dictionary: " + best + " in place of " + asked.dictionary;
}

std::optional<std::string> otherSymmetry(const cv::Mat& image, const GrayImage& gray,
                                         const Target& asked) {
  if (asked.type != TargetType::kCircles) return std::nullopt;
  Target other = asked;
  other.asymmetric = !asked.asymmetric;
  other.dot_m = 0.0;
  std::optional<cv::Size> size;
  if (cornersOf(image, other, 2.0) > 0) {
    size = cv::Size(asked.cols, asked.rows);
  } else {
    size = detect::circlesSize(gray, other, Budget(2.0));
  }
  if (!size) return std::nullopt;
  return std::string("shows ") +
         (other.asymmetric ? "dots whose rows are shifted" : "dots in a plain grid") +
         ", expected asymmetric: " + (other.asymmetric ? "true" : "false") + " with " +
         std::to_string(size->width) + " x " + std::to_string(size->height) + " dots";
}

const char* countedIn(TargetType type) {
  switch (type) {
    case TargetType::kCheckerboard:
      return "inner corners";
    case TargetType::kCircles:
      return "dots";
    case TargetType::kCharuco:
      return "squares";
    case TargetType::kAprilGrid:
      return "tags";
  }
  return "";
}

/// The size of a coded board whose markers are known, as otherBoardSize() finds it.
std::optional<cv::Size> codedSize(const cv::Mat& image, Target target) {
  // Any size but the real one, which it would keep to itself.
  for (const int cols : {2, 3}) {
    target.cols = cols;
    target.rows = 2;
    if (target.type == TargetType::kCharuco) target.rows = 3;
    if (const auto size = otherBoardSize(image, target)) return size;
  }
  return std::nullopt;
}

}  // namespace

std::optional<Target> boardSeen(const cv::Mat& image) {
  const GrayImage gray = detect::toGray(image);
  if (gray.eight_bit.empty()) return std::nullopt;
  Target tags;
  tags.type = TargetType::kAprilGrid;
  tags.square_m = 1.0;
  tags.spacing = 0.3;
  tags.dictionary = "tag36h11";
  tags.cols = tags.rows = 20;
  const auto decoded = detect::decodeAprilGrid(gray, tags, Budget(1.5));
  if (decoded.size() >= kFewestMarkers) {
    if (const auto size = codedSize(image, tags)) {
      tags.cols = size->width;
      tags.rows = size->height;
      const auto wide = std::count_if(decoded.begin(), decoded.end(),
                                      [](const Marker& marker) { return marker.border_bits == 2; });
      tags.border_bits = 2 * static_cast<std::size_t>(wide) > decoded.size() ? 2 : 1;
      return tags;
    }
  }
  Target charuco;
  charuco.type = TargetType::kCharuco;
  charuco.square_m = 1.0;
  charuco.marker_m = 0.75;
  std::size_t most = kFewestMarkers - 1;
  std::string dictionary;
  for (const std::string& name : otherDictionaries(charuco)) {
    charuco.dictionary = name;
    charuco.cols = charuco.rows = 9;
    const std::size_t count = detect::decodeCharuco(gray, charuco, Budget(0.5)).size();
    if (count <= most) continue;
    most = count;
    dictionary = name;
  }
  if (!dictionary.empty()) {
    charuco.dictionary = dictionary;
    if (const auto size = codedSize(image, charuco)) {
      charuco.cols = size->width;
      charuco.rows = size->height;
      return charuco;
    }
  }
  Target plain;
  plain.square_m = 1.0;
  if (const auto size = detect::checkerboardSize(gray)) {
    plain.cols = size->width;
    plain.rows = size->height;
    return plain;
  }
  plain.type = TargetType::kCircles;
  for (const bool asymmetric : {false, true}) {
    plain.asymmetric = asymmetric;
    if (const auto size = detect::circlesSize(gray, plain, Budget(3.0))) {
      plain.cols = size->width;
      plain.rows = size->height;
      return plain;
    }
  }
  return std::nullopt;
}

std::optional<std::string> boardHint(const cv::Mat& image, const Target& asked) {
  if (auto hint = shownTwice(image, asked)) return hint;
  const std::size_t found = cornersOf(image, asked, 3.0);
  if (auto hint = anotherLayout(image, asked, found)) return hint;
  // What is there is there.
  if (3 * found >= 2 * targetPoints(asked).size()) return std::nullopt;
  const GrayImage gray = detect::toGray(image);
  if (auto hint = anotherBorder(image, asked, found)) return hint;
  if (auto hint = anotherDictionary(gray, asked)) return hint;
  if (found > 0) return std::nullopt;
  if (auto hint = otherSymmetry(image, gray, asked)) return hint;
  const auto seen = boardSeen(image);
  if (!seen || seen->type == asked.type) return std::nullopt;
  return "shows a board of type " + std::string(targetTypeName(seen->type)) + " with " +
         std::to_string(seen->cols) + " x " + std::to_string(seen->rows) + " " +
         countedIn(seen->type) + ", expected type: " + std::string(targetTypeName(seen->type));
}

}  // namespace omnister
