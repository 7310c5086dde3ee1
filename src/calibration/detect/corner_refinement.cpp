// SPDX-License-Identifier: Apache-2.0
#include "calibration/detect/corner_refinement.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <opencv2/imgproc.hpp>

namespace omnister::detect {
namespace {

constexpr double kMinHalfWindow = 2.0;
constexpr double kMaxHalfWindow = 15.0;
constexpr double kShareOfClear = 0.25;

// Grey levels between which a deep image carries its picture; single hot or dead pixels left out.
std::pair<double, double> pictureRange(const cv::Mat& image) {
  std::vector<float> samples;
  const int step = std::max(1, static_cast<int>(std::sqrt(image.total() / 40000.0)));
  for (int row = 0; row < image.rows; row += step) {
    for (int col = 0; col < image.cols; col += step) samples.push_back(image.at<float>(row, col));
  }
  const auto at = [&](double share) {
    const auto place = samples.begin() + static_cast<std::ptrdiff_t>(share * (samples.size() - 1));
    std::nth_element(samples.begin(), place, samples.end());
    return static_cast<double>(*place);
  };
  return {at(0.002), at(0.998)};
}

}  // namespace

GrayImage toGray(const cv::Mat& image) {
  GrayImage gray;
  if (image.empty() || image.dims != 2) return gray;
  cv::Mat plain = image;
  // cvtColor knows 8 and 16 bit unsigned and float.
  if (plain.depth() != CV_8U && plain.depth() != CV_16U) plain.convertTo(plain, CV_32F);
  if (plain.channels() == 3) {
    cv::cvtColor(plain, plain, cv::COLOR_BGR2GRAY);
  } else if (plain.channels() == 4) {
    cv::cvtColor(plain, plain, cv::COLOR_BGRA2GRAY);
  } else if (plain.channels() != 1) {
    cv::extractChannel(plain, plain, 0);
  }
  if (plain.depth() == CV_8U) {
    gray.eight_bit = gray.fine = plain;
    return gray;
  }
  plain.convertTo(gray.fine, CV_32F);
  cv::patchNaNs(gray.fine, 0.0);
  gray.fine = cv::min(cv::max(gray.fine, -1e9), 1e9);
  const auto [low, high] = pictureRange(gray.fine);
  const double gain = high > low ? 255.0 / (high - low) : 1.0;
  gray.fine.convertTo(gray.fine, CV_32F, gain, -gain * low);
  gray.fine.convertTo(gray.eight_bit, CV_8U);
  return gray;
}

double halfWindow(double clear) {
  return std::clamp(kShareOfClear * clear, kMinHalfWindow, kMaxHalfWindow);
}

std::vector<bool> refineCorners(const cv::Mat& fine, const std::vector<double>& half_windows,
                                std::vector<cv::Point2f>& corners) {
  std::vector<bool> stayed(corners.size(), false);
  for (std::size_t i = 0; i < corners.size(); ++i) {
    const int half = static_cast<int>(std::lround(half_windows[i]));
    const cv::Point2f start = corners[i];
    // cornerSubPix asserts that the start is inside and that the window fits into the image.
    if (!(start.x >= 0 && start.y >= 0 && start.x < fine.cols && start.y < fine.rows) ||
        fine.cols < 2 * half + 5 || fine.rows < 2 * half + 5) {
      continue;
    }
    std::vector<cv::Point2f> corner{start};
    cv::cornerSubPix(fine, corner, {half, half}, {-1, -1},
                     {cv::TermCriteria::EPS | cv::TermCriteria::COUNT, 60, 1e-4});
    stayed[i] = std::max(std::abs(corner[0].x - start.x), std::abs(corner[0].y - start.y)) < half &&
                corner[0].x >= 0 && corner[0].y >= 0 && corner[0].x <= fine.cols - 1 &&
                corner[0].y <= fine.rows - 1;
    if (stayed[i]) corners[i] = corner[0];
  }
  return stayed;
}

std::optional<double> grayAt(const cv::Mat& fine, const Eigen::Vector2d& pixel) {
  const double x = pixel.x();
  const double y = pixel.y();
  if (!(x >= 0 && y >= 0 && x <= fine.cols - 1 && y <= fine.rows - 1)) return std::nullopt;
  const int col = std::min(static_cast<int>(x), std::max(0, fine.cols - 2));
  const int row = std::min(static_cast<int>(y), std::max(0, fine.rows - 2));
  const int right = std::min(col + 1, fine.cols - 1);
  const int below = std::min(row + 1, fine.rows - 1);
  const auto value = [&](int r, int c) {
    return fine.depth() == CV_8U ? double{static_cast<double>(fine.at<uchar>(r, c))}
                                 : static_cast<double>(fine.at<float>(r, c));
  };
  const double a = x - col;
  const double b = y - row;
  return (1 - b) * ((1 - a) * value(row, col) + a * value(row, right)) +
         b * ((1 - a) * value(below, col) + a * value(below, right));
}

double cornerContrast(const cv::Mat& fine, const LocalFrame& frame, unsigned dark, double reach) {
  // Away from the edges themselves, where blur makes everything grey.
  static constexpr std::array<std::array<double, 2>, 4> kPlaces{
      {{0.45, 0.45}, {0.9, 0.5}, {0.5, 0.9}, {0.85, 0.85}}};
  static constexpr std::array<std::array<double, 2>, 4> kSigns{
      {{1, 1}, {-1, 1}, {-1, -1}, {1, -1}}};
  double sum[2] = {0, 0};
  double square[2] = {0, 0};
  int count[2] = {0, 0};
  for (std::size_t quadrant = 0; quadrant < kSigns.size(); ++quadrant) {
    const int is_dark = (dark >> quadrant & 1u) != 0 ? 1 : 0;
    for (const auto& place : kPlaces) {
      const Eigen::Vector2d offset(kSigns[quadrant][0] * place[0], kSigns[quadrant][1] * place[1]);
      const auto gray = grayAt(fine, frame.pixel + reach * (frame.jacobian * offset));
      if (!gray) return 0.0;
      sum[is_dark] += *gray;
      square[is_dark] += *gray * *gray;
      ++count[is_dark];
    }
  }
  if (count[0] == 0 || count[1] == 0) return 0.0;
  double mean[2];
  double variance = 0.0;
  for (int side = 0; side < 2; ++side) {
    mean[side] = sum[side] / count[side];
    variance += std::max(0.0, square[side] / count[side] - mean[side] * mean[side]) / 2.0;
  }
  // Two grey levels of noise at least, so that a flat picture's rounding is no contrast.
  return (mean[0] - mean[1]) / std::sqrt(variance + 4.0);
}

}  // namespace omnister::detect
