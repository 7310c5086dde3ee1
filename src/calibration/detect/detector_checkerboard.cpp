// SPDX-License-Identifier: Apache-2.0
// Plain checkerboards, by OpenCV's two detectors. Neither finds all that the other does, both miss
// what a change of scale or contrast lets them find, and the classic one may search for half a
// minute in a large image: small copies first, the costly attempts only while the time lasts.
#include <algorithm>
#include <cmath>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgproc.hpp>

#include "calibration/detect/board_detectors.h"
#include "calibration/detect/point_refinement.h"

namespace omnister::detect {
namespace {

enum class Method { kSectors, kQuads };

struct Attempt {
  Method method;
  double pixels;  ///< of the copy that is searched, about
  bool enlarge;   ///< smaller images are enlarged to that, instead of taken as they are
  bool equalize;  ///< local contrast
};

constexpr Attempt kAttempts[] = {
    {Method::kSectors, 0.4e6, false, false}, {Method::kQuads, 0.4e6, false, false},
    {Method::kQuads, 1.3e6, false, false},   {Method::kSectors, 1.3e6, false, false},
    {Method::kQuads, 0.4e6, false, true},    {Method::kSectors, 0.4e6, false, true},
    {Method::kQuads, 1.6e6, true, false},    {Method::kQuads, 1.3e6, false, true},
    {Method::kSectors, 1.3e6, false, true},  {Method::kQuads, 0.12e6, false, false},
    {Method::kSectors, 3.0e6, false, false}, {Method::kSectors, 1.6e6, true, false},
};

// The scales that differ too little from one already tried bring nothing.
constexpr double kSameScale = 1.15;
constexpr double kMaxEnlargement = 2.0;

double scaleFor(const Attempt& attempt, const cv::Mat& image) {
  const double fitting = std::sqrt(attempt.pixels / static_cast<double>(image.total()));
  return std::min(fitting, attempt.enlarge ? kMaxEnlargement : 1.0);
}

std::optional<std::vector<cv::Point2f>> search(const cv::Mat& image, const Target& target,
                                               Method method) {
  const cv::Size pattern(target.cols, target.rows);
  std::vector<cv::Point2f> corners;
  bool found = false;
  try {
    if (method == Method::kSectors) {
      found = cv::findChessboardCornersSB(image, pattern, corners,
                                          cv::CALIB_CB_NORMALIZE_IMAGE | cv::CALIB_CB_EXHAUSTIVE);
    } else {
      found = cv::findChessboardCorners(
          image, pattern, corners, cv::CALIB_CB_ADAPTIVE_THRESH | cv::CALIB_CB_NORMALIZE_IMAGE);
    }
  } catch (const cv::Exception&) {
    // Both assert inside on odd images (too small for their filters, for one): no board there.
    return std::nullopt;
  }
  if (!found || corners.size() != static_cast<std::size_t>(pattern.area())) return std::nullopt;
  return corners;
}

// Half the corners may have been off by a few pixels of the small copy; one that jumped away from
// what its neighbours say was drawn to something else.
bool refine(const cv::Mat& fine, int cols, int rows, std::vector<cv::Point2f>& corners) {
  const std::vector<double> spacing = gridSpacing(corners, cols, rows);
  std::vector<double> windows(spacing.size());
  std::transform(spacing.begin(), spacing.end(), windows.begin(), halfWindow);
  const std::vector<bool> stayed = refineCorners(fine, windows, corners);
  const auto lost = std::count(stayed.begin(), stayed.end(), false);
  return lost * 10 <= static_cast<std::ptrdiff_t>(corners.size());
}

// Whether the pattern goes on beyond one of its sides: then it is not the board that was asked for,
// and which part of it was found is chance.
bool goesOn(const cv::Mat& fine, const Target& target, const Expected& frames,
            bool first_square_dark) {
  const double side = target.square_m;
  const int cols = target.cols;
  const int rows = target.rows;
  for (const Eigen::Vector2i& out : {Eigen::Vector2i(1, 0), Eigen::Vector2i(-1, 0),
                                     Eigen::Vector2i(0, 1), Eigen::Vector2i(0, -1)}) {
    const int length = out.x() != 0 ? rows : cols;
    int corners = 0;
    for (int i = 0; i < length; ++i) {
      const int col = out.x() == 0 ? i : (out.x() > 0 ? cols - 1 : 0);
      const int row = out.y() == 0 ? i : (out.y() > 0 ? rows - 1 : 0);
      const auto& frame = frames[row * cols + col];
      if (!frame) continue;
      // One square further, where the squares' colours are swapped.
      LocalFrame next = *frame;
      next.pixel += next.jacobian * (side * out.cast<double>());
      std::vector<cv::Point2f> corner{
          {static_cast<float>(next.pixel.x()), static_cast<float>(next.pixel.y())}};
      const double spacing =
          side * std::min(next.jacobian.col(0).norm(), next.jacobian.col(1).norm());
      refineCorners(fine, {halfWindow(spacing)}, corner);
      next.pixel = {corner[0].x, corner[0].y};
      const bool dark = ((col + out.x() + row + out.y()) % 2 == 0) == first_square_dark;
      const unsigned quadrants = dark ? kPlusPlus | kMinusMinus : kMinusPlus | kPlusMinus;
      corners += cornerContrast(fine, next, quadrants, 0.4 * side) > 2.0;
    }
    if (10 * corners >= 8 * length) return true;
  }
  return false;
}

}  // namespace

std::optional<cv::Size> checkerboardSize(const GrayImage& image) {
  constexpr double kPixels = 0.8e6;
  const double total = static_cast<double>(image.eight_bit.total());
  const ScaledImage copy = scaled(image.eight_bit, std::min(1.0, std::sqrt(kPixels / total)));
  std::vector<cv::Point2f> corners;
  cv::Mat meta;
  try {
    const int flags = cv::CALIB_CB_NORMALIZE_IMAGE | cv::CALIB_CB_EXHAUSTIVE | cv::CALIB_CB_LARGER;
    if (!cv::findChessboardCornersSB(copy.image, {3, 3}, corners, flags, meta)) return std::nullopt;
  } catch (const cv::Exception&) {
    return std::nullopt;
  }
  return cv::Size(std::max(meta.cols, meta.rows), std::min(meta.cols, meta.rows));
}

std::vector<Corner> detectCheckerboard(const GrayImage& image, const Target& target,
                                       const Budget& budget) {
  std::vector<Attempt> done;
  std::vector<double> done_scales;
  double cost_of_pixel[2] = {0.0, 0.0};  // [s], of each method
  for (const Attempt& attempt : kAttempts) {
    if (budget.spent()) break;
    const double scale = scaleFor(attempt, image.eight_bit);
    bool repeated = attempt.enlarge && scale < kSameScale;
    for (std::size_t i = 0; i < done.size(); ++i) {
      repeated =
          repeated || (done[i].method == attempt.method && done[i].equalize == attempt.equalize &&
                       std::abs(std::log(scale / done_scales[i])) < std::log(kSameScale));
    }
    if (repeated) continue;
    // What the same search took in a smaller copy tells what it will take at least.
    const double pixels = scale * scale * static_cast<double>(image.eight_bit.total());
    double& cost = cost_of_pixel[attempt.method == Method::kQuads ? 1 : 0];
    if (cost * pixels > budget.left()) continue;
    done.push_back(attempt);
    done_scales.push_back(scale);

    ScaledImage copy = scaled(image.eight_bit, scale);
    if (attempt.equalize) {
      cv::Mat even;
      cv::createCLAHE(4.0, {8, 8})->apply(copy.image, even);
      copy.image = even;
    }
    const double before = budget.left();
    auto corners = search(copy.image, target, attempt.method);
    cost = std::max(cost, (before - budget.left()) / pixels);
    if (!corners) continue;
    for (cv::Point2f& corner : *corners) corner = copy.toOriginal(corner);
    auto ordered = orderGrid(*corners, target, &image.fine);
    if (!ordered || !refine(image.fine, target.cols, target.rows, *ordered)) continue;
    // Again, for the refinement may have crossed a line over.
    if (!orderGrid(*ordered, target, &image.fine)) continue;
    Measured coarse;
    for (const cv::Point2f& corner : *ordered)
      coarse.emplace_back(Eigen::Vector2d(corner.x, corner.y));
    const Expected frames = framesFromGrid(coarse, target);
    const bool first_square_dark = firstSquareContrast(image.fine, target, frames) >= 0.0;
    if (goesOn(image.fine, target, frames, first_square_dark)) return {};
    const Measured measured = measurePoints(image.fine, target, frames, first_square_dark);
    std::vector<Corner> result;
    for (std::size_t i = 0; i < ordered->size(); ++i) {
      // Under a highlight or a finger edge a corner may fail the test and still be the detector's.
      result.push_back({static_cast<int>(i), measured[i].value_or(*coarse[i])});
    }
    return result;
  }
  return {};
}

}  // namespace omnister::detect
