// SPDX-License-Identifier: Apache-2.0
/// @file What a person looks at first: is the calibration good, why, what to do; and the pictures
/// with what was found in them.
#pragma once

#include <functional>
#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

#include "omnister/calibration/calibrate.h"
#include "omnister/calibration/next_views.h"
#include "omnister/calibration/picture_survey.h"
#include "omnister/calibration/uncertainty.h"

namespace omnister::tools {

struct ReportPictures {
  std::function<cv::Mat(const std::string&)> read = {};  ///< grey picture of a view, or nothing
  std::vector<LeftOut> left_out = {};
  std::vector<NextView> next = {};
};

/// "good", "usable" or "not good", why, and what to do, in plain words.
struct Verdict {
  std::string word;
  std::vector<std::string> why;
  std::vector<std::string> advice;
};
Verdict verdictOn(const CalibrationResult& result, const ReportPictures& pictures);

/// The verdict as the first section of a page.
std::string verdictSection(const CalibrationResult& result, const ReportPictures& pictures);

/// A map in pixels over a picture of the camera, with its colour scale; over grey without pictures.
std::string mapOverPicture(const ProjectionField& field, const Detections& detections,
                           const ReportPictures& pictures, const std::string& caption);

/// Every view's picture, small, with its corners and what is off of them; empty without pictures.
std::string thumbnails(const Detections& detections, const CalibrationResult& result,
                       const ReportPictures& pictures);

}  // namespace omnister::tools
