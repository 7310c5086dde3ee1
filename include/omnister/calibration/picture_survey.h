// SPDX-License-Identifier: Apache-2.0
/// @file Which pictures of a folder can serve a calibration, and why the others cannot.
#pragma once

#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

#include "omnister/calibration/detections.h"
#include "omnister/calibration/target.h"

namespace omnister {

/// A picture that is not used.
struct LeftOut {
  std::string image;
  std::string reason;  ///< in plain words, e.g. "is the same picture as a.png"
};

/// Files as they are named, folders by the pictures in them (by extension, 2.png before 10.png; not
/// in folders within).
/// @throws InputError for a folder without pictures
std::vector<std::string> picturesIn(const std::vector<std::string>& files_and_folders);

/// What was found before any board was looked for.
struct PictureSurvey {
  std::vector<std::string> images;  ///< those of use, in order
  std::vector<LeftOut> left_out;
  /// What the grey levels say of each of `images` where no board is found in it; may be empty.
  std::vector<std::string> doubts;
};

/// Reads every picture: damaged ones, those of another size than most, and copies are left out.
/// Where not most, and at least three, are of one size, none is left out for its size.
/// @throws what readImage() says of the first where none can be read
PictureSurvey surveyPictures(const std::vector<std::string>& images, int threads);

/// Width of the edges between dark and light beside the board's points: the contrast over the
/// steepest slope across them [px], the wider of the board's two directions. About 2 for a sharp
/// picture. NaN where there are too few.
double edgeWidth(const cv::Mat& image, const Target& target, const ViewDetections& view);

/// Views that had better not be used: their pictures much more blurred than most, or nearly the
/// same as another. At most a third of all are left out for blur. Removes them from `detections`.
/// @throws InputError for an unreadable picture
std::vector<LeftOut> leaveOutPoorViews(const Target& target, int threads, Detections& detections);

}  // namespace omnister
