// SPDX-License-Identifier: Apache-2.0
// Which board an image shows when it is not the one that was asked for.
#include <algorithm>

#include "calibration/detect/board_detectors.h"
#include "omnister/calibration/detector.h"

namespace omnister {
namespace {

using detect::Marker;
using Place = std::vector<Marker> (*)(const std::vector<Marker>&, const Target&);

/// Numbers run along the rows: with the right number of columns neighbours on the board are
/// neighbours in the picture.
std::optional<cv::Size> sizeOfMarkers(const std::vector<Marker>& decoded, const Target& asked,
                                      Place place) {
  constexpr std::size_t kLeast = 4;
  constexpr int kMostCols = 40;
  struct Fitting {
    std::size_t count = 0;
    int rows = 0;
  };
  const auto fitting = [&](int cols, int most_rows) {
    Target candidate = asked;
    candidate.cols = cols;
    candidate.rows = most_rows;
    Fitting found;
    int low = most_rows;
    int high = -1;
    for (const Marker& marker : detect::consistentMarkers(place(decoded, candidate))) {
      ++found.count;
      low = std::min(low, marker.cell.y());
      high = std::max(high, marker.cell.y());
    }
    // ChArUco boards count their rows from the top, AprilGrids from the bottom.
    found.rows = asked.type == TargetType::kCharuco ? high + 1 : most_rows - low;
    return found;
  };
  int largest = -1;
  for (const Marker& marker : decoded) largest = std::max(largest, marker.id);
  // Every other square of a ChArUco board has a marker; patterns of either parity are tried, since
  // the older one depends on it.
  const auto rowsFor = [&](int cols) {
    return std::max(2, (asked.type == TargetType::kCharuco ? 2 : 1) * (largest + 1) / cols + 2);
  };
  const std::size_t as_asked = fitting(asked.cols, asked.rows).count;
  Fitting best;
  int best_cols = 0;
  for (int cols = 2; cols <= kMostCols; ++cols) {
    for (const int more : {0, 1}) {
      const Fitting found = fitting(cols, rowsFor(cols) + more);
      if (found.count <= best.count) continue;
      best = found;
      best_cols = cols;
    }
  }
  if (best.count < kLeast || 2 * best.count < 3 * as_asked || best_cols == asked.cols) {
    return std::nullopt;
  }
  return cv::Size(best_cols, best.rows);
}

}  // namespace

std::optional<cv::Size> otherBoardSize(const cv::Mat& image, const Target& asked) {
  const detect::GrayImage gray = detect::toGray(image);
  if (gray.eight_bit.empty()) return std::nullopt;
  const detect::Budget budget(5.0);
  std::optional<cv::Size> seen;
  switch (asked.type) {
    case TargetType::kCheckerboard:
      seen = detect::checkerboardSize(gray);
      break;
    case TargetType::kCircles:
      seen = detect::circlesSize(gray, asked, budget);
      break;
    case TargetType::kCharuco:
      return sizeOfMarkers(detect::decodeCharuco(gray, asked, budget), asked, detect::placeCharuco);
    case TargetType::kAprilGrid:
      return sizeOfMarkers(detect::decodeAprilGrid(gray, asked, budget), asked,
                           detect::placeAprilGrid);
  }
  if (!seen || *seen == cv::Size(asked.cols, asked.rows)) return std::nullopt;
  // The same board turned by a quarter.
  const bool turned = *seen == cv::Size(asked.rows, asked.cols);
  if (turned && !(asked.type == TargetType::kCircles && asked.asymmetric)) return std::nullopt;
  return seen;
}

}  // namespace omnister
