// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/input_region.h"

#include <cmath>
#include <opencv2/imgproc.hpp>
#include <sstream>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"

namespace omnister {

cv::Rect parseRegion(std::string_view text, cv::Size size, const std::string& source) {
  if (text.empty()) return {};
  std::vector<double> numbers;
  std::istringstream stream{std::string(text)};
  std::string field;
  while (std::getline(stream, field, ',')) {
    const auto number = parseNumber(field);
    if (!number || *number != std::floor(*number) || std::abs(*number) > 1e6) break;
    numbers.push_back(*number);
  }
  if (numbers.size() == 4 && stream.eof() && numbers[0] >= 0 && numbers[1] >= 0 &&
      numbers[2] >= 1 && numbers[3] >= 1 && numbers[0] + numbers[2] <= size.width &&
      numbers[1] + numbers[3] <= size.height) {
    return {static_cast<int>(numbers[0]), static_cast<int>(numbers[1]),
            static_cast<int>(numbers[2]), static_cast<int>(numbers[3])};
  }
  throw Error(source + " is '" + printable(text) + "', expected x,y,width,height inside the " +
              std::to_string(size.width) + "x" + std::to_string(size.height) + " reference image");
}

cv::Mat reducedImage(const cv::Mat& image, int factor) {
  if (factor == 1) return image;
  cv::Mat small;
  const cv::Size size = image.size() / factor;
  cv::resize(image(cv::Rect(cv::Point(), size * factor)), small, size, 0, 0, cv::INTER_AREA);
  return small;
}

cv::Mat matchingMask(const cv::Mat& mask, const cv::Rect& region, cv::Size size, int factor) {
  if (mask.empty() && region.empty()) return {};
  cv::Mat all = mask.empty() ? cv::Mat(size, CV_8UC1, cv::Scalar(255)) : cv::Mat(mask != 0);
  if (!region.empty()) {
    cv::Mat inside(size, CV_8UC1, cv::Scalar(0));
    inside(region).setTo(255);
    all &= inside;
  }
  if (factor == 1) return all;
  return reducedImage(all, factor) == 255;
}

}  // namespace omnister
