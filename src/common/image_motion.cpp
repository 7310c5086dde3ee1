// SPDX-License-Identifier: Apache-2.0
#include "omnister/common/image_motion.h"

#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>
#include <opencv2/video/tracking.hpp>
#include <vector>

namespace omnister {
namespace {

constexpr int kFeatures = 150;
constexpr std::size_t kEnough = 12;
// Tracked there and back, a feature must come to where it was [px].
constexpr double kThereAndBack = 0.5;
// Larger images are looked at this wide: what matters is not a hundredth of a pixel.
constexpr int kWidth = 1280;

}  // namespace

std::optional<double> imageMotion(const cv::Mat& before, const cv::Mat& after) {
  if (before.empty() || before.size() != after.size()) return std::nullopt;
  cv::Mat images[2] = {before, after};
  const double scale = std::max(1.0, static_cast<double>(before.cols) / kWidth);
  if (scale > 1.0) {
    for (cv::Mat& image : images) {
      cv::resize(image, image, cv::Size(), 1.0 / scale, 1.0 / scale, cv::INTER_AREA);
    }
  }
  std::vector<cv::Point2f> from, to, back;
  cv::goodFeaturesToTrack(images[0], from, kFeatures, 0.02, 12.0);
  if (from.size() < kEnough) return std::nullopt;
  std::vector<unsigned char> found, found_back;
  std::vector<float> error;
  cv::calcOpticalFlowPyrLK(images[0], images[1], from, to, found, error);
  cv::calcOpticalFlowPyrLK(images[1], images[0], to, back, found_back, error);
  std::vector<double> distances;
  std::size_t far = 0;
  for (std::size_t i = 0; i < from.size(); ++i) {
    if (!found[i] || !found_back[i] || cv::norm(back[i] - from[i]) > kThereAndBack) {
      ++far;
      continue;
    }
    distances.push_back(cv::norm(to[i] - from[i]) * scale);
  }
  // Features that are not found again moved out of reach.
  if (distances.size() < far) return static_cast<double>(before.cols);
  const auto middle = distances.begin() + static_cast<std::ptrdiff_t>(distances.size() / 2);
  std::nth_element(distances.begin(), middle, distances.end());
  return *middle;
}

}  // namespace omnister
