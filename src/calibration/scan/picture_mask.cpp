// SPDX-License-Identifier: Apache-2.0
#include "calibration/scan/picture_mask.h"

#include <opencv2/imgproc.hpp>

namespace omnister::calibration {
namespace {

/// Grey levels that noise makes a smoothed pixel wander.
constexpr double kStillLevels = 10.0;
/// A corner that is still by chance (a plain wall) is no surround: that is this much darker than
/// the image on average.
constexpr double kDarkShare = 0.4;

}  // namespace

cv::Mat1b outsidePicture(const std::vector<StageScan>& scans, int margin_px) {
  cv::Mat lowest, highest;
  double sum = 0.0;
  int images = 0;
  for (const StageScan& scan : scans) {
    for (const cv::Mat& image : scan.images) {
      cv::Mat gray = image;
      if (image.channels() == 3) cv::cvtColor(image, gray, cv::COLOR_BGR2GRAY);
      cv::Mat smooth;
      cv::boxFilter(gray, smooth, CV_8U, cv::Size(3, 3));
      sum += cv::mean(smooth)[0];
      if (images++ == 0) {
        lowest = smooth;
        highest = smooth.clone();
      } else {
        cv::min(lowest, smooth, lowest);
        cv::max(highest, smooth, highest);
      }
    }
  }
  cv::Mat1b outside(lowest.size(), uchar{0});
  const double darkest = kDarkShare * sum / images;
  cv::Mat1b still = (highest - lowest <= kStillLevels) & (highest <= darkest);
  const cv::Point corners[] = {
      {0, 0}, {still.cols - 1, 0}, {0, still.rows - 1}, {still.cols - 1, still.rows - 1}};
  for (const cv::Point& corner : corners) {
    if (still(corner) != 255) continue;
    cv::floodFill(still, corner, cv::Scalar(128), nullptr, cv::Scalar(0), cv::Scalar(0), 8);
  }
  outside = still == 128;
  if (margin_px > 0 && cv::countNonZero(outside) > 0) {
    const int side = 2 * margin_px + 1;
    cv::dilate(outside, outside,
               cv::getStructuringElement(cv::MORPH_ELLIPSE, cv::Size(side, side)));
  }
  return outside;
}

}  // namespace omnister::calibration
