// SPDX-License-Identifier: Apache-2.0
// What all boards with a grid of points share.
#include <time.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>

#include "calibration/detect/board_detectors.h"

namespace omnister::detect {
namespace {

double threadSeconds() {
  timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

double cross(const cv::Point2f& a, const cv::Point2f& b) {
  return double{a.x} * b.y - double{a.y} * b.x;
}

struct Grid {
  int cols;
  int rows;
  std::vector<cv::Point2f> points;

  const cv::Point2f& at(int col, int row) const { return points[row * cols + col]; }
};

Grid mirrored(const Grid& grid) {
  Grid out = grid;
  for (int row = 0; row < grid.rows; ++row) {
    std::reverse(out.points.begin() + row * grid.cols, out.points.begin() + (row + 1) * grid.cols);
  }
  return out;
}

Grid quarterTurned(const Grid& grid) {
  Grid out{grid.rows, grid.cols, std::vector<cv::Point2f>(grid.points.size())};
  for (int row = 0; row < out.rows; ++row) {
    for (int col = 0; col < out.cols; ++col) {
      out.points[row * out.cols + col] = grid.at(row, grid.rows - 1 - col);
    }
  }
  return out;
}

// Twice the area of each cell, signed: above 0 with x to y turning as in the image.
bool cellsAre(const Grid& grid, double sign) {
  for (int row = 0; row + 1 < grid.rows; ++row) {
    for (int col = 0; col + 1 < grid.cols; ++col) {
      const cv::Point2f a = grid.at(col, row);
      const cv::Point2f b = grid.at(col + 1, row);
      const cv::Point2f c = grid.at(col + 1, row + 1);
      const cv::Point2f d = grid.at(col, row + 1);
      for (const double turn :
           {cross(b - a, d - a), cross(c - b, a - b), cross(d - c, b - c), cross(a - d, c - d)}) {
        if (!(sign * turn > 0.0)) return false;
      }
    }
  }
  return true;
}

// Whether squares alternate: +1 with the first one light, -1 dark, 0 when they do not.
int firstSquare(const Grid& grid, const cv::Mat& fine) {
  std::vector<double> gray;
  for (int row = 0; row + 1 < grid.rows; ++row) {
    for (int col = 0; col + 1 < grid.cols; ++col) {
      const cv::Point2f sum = grid.at(col, row) + grid.at(col + 1, row) + grid.at(col, row + 1) +
                              grid.at(col + 1, row + 1);
      gray.push_back(grayAt(fine, {0.25 * sum.x, 0.25 * sum.y}).value_or(0.0));
    }
  }
  const int cols = grid.cols - 1;
  int pairs = 0;
  int lighter = 0;
  int darker = 0;
  for (int i = 0; i < static_cast<int>(gray.size()); ++i) {
    for (const int j : {i % cols + 1 < cols ? i + 1 : -1, i + cols}) {
      if (j < 0 || j >= static_cast<int>(gray.size())) continue;
      const double step = gray[i] - gray[j];
      const bool even = (i / cols + i % cols) % 2 == 0;
      ++pairs;
      lighter += (even ? step : -step) > 0.0;
      darker += (even ? step : -step) < 0.0;
    }
  }
  // A highlight or a shadow may swallow a square or two.
  if (lighter * 10 >= pairs * 9) return 1;
  if (darker * 10 >= pairs * 9) return -1;
  return 0;
}

}  // namespace

Budget::Budget(double seconds) : end_(threadSeconds() + seconds) {}

double Budget::left() const { return end_ - threadSeconds(); }

ScaledImage scaled(const cv::Mat& image, double scale) {
  ScaledImage copy;
  if (scale == 1.0) {
    copy.image = image;
    return copy;
  }
  const cv::Size size(std::max(1, static_cast<int>(std::lround(image.cols * scale))),
                      std::max(1, static_cast<int>(std::lround(image.rows * scale))));
  cv::resize(image, copy.image, size, 0, 0, scale < 1.0 ? cv::INTER_AREA : cv::INTER_CUBIC);
  copy.scale_x = static_cast<double>(size.width) / image.cols;
  copy.scale_y = static_cast<double>(size.height) / image.rows;
  return copy;
}

std::vector<double> gridSpacing(const std::vector<cv::Point2f>& points, int cols, int rows) {
  std::vector<double> spacing(points.size(), std::numeric_limits<double>::infinity());
  const auto join = [&](int a, int b) {
    const double distance = cv::norm(points[a] - points[b]);
    spacing[a] = std::min(spacing[a], distance);
    spacing[b] = std::min(spacing[b], distance);
  };
  for (int row = 0; row < rows; ++row) {
    for (int col = 0; col < cols; ++col) {
      const int id = row * cols + col;
      if (col + 1 < cols) join(id, id + 1);
      if (row + 1 < rows) join(id, id + cols);
    }
  }
  return spacing;
}

std::optional<std::vector<cv::Point2f>> orderGrid(const std::vector<cv::Point2f>& points,
                                                  const Target& target, const cv::Mat* fine) {
  Grid grid{target.cols, target.rows, points};
  if (!cellsAre(grid, 1.0)) {
    grid = mirrored(grid);
    if (!cellsAre(grid, 1.0)) return std::nullopt;
  }
  // Every way to turn the grid that keeps its shape.
  std::vector<Grid> turns{grid};
  for (int turn = 1; turn < 4; ++turn) turns.push_back(quarterTurned(turns.back()));
  const Grid* best = nullptr;
  double best_score = 0.0;
  int best_square = 0;
  for (const Grid& candidate : turns) {
    if (candidate.cols != target.cols || candidate.rows != target.rows) continue;
    const int square = fine != nullptr ? firstSquare(candidate, *fine) : -1;
    if (square == 0) return std::nullopt;
    cv::Point2f direction(0, 0);
    for (int row = 0; row < grid.rows; ++row) {
      const cv::Point2f along = candidate.at(target.cols - 1, row) - candidate.at(0, row);
      direction += along / std::max(1e-9, cv::norm(along));
    }
    // Of orders that look alike, the one with x to the right or down; boards held straight or on
    // their side are well away from where this flips, so two cameras of a rig agree.
    const double score = 0.9 * direction.x + 0.436 * direction.y;
    const bool better =
        best == nullptr || square < best_square || (square == best_square && score > best_score);
    if (better) {
      best = &candidate;
      best_score = score;
      best_square = square;
    }
  }
  if (best == nullptr) return std::nullopt;
  return best->points;
}

}  // namespace omnister::detect
