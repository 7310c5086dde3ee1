// SPDX-License-Identifier: Apache-2.0
/// @file Rendered pairs with their truth, small so that tests are quick.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <opencv2/core.hpp>
#include <string>
#include <vector>

#include "omnister/lens/lens_file.h"
#include "omnister/lens/lens_models.h"
#include "omnister/sim/renderer.h"

namespace omnister::test {

constexpr double kBaseline = 0.2;

/// A fisheye of about 180 degrees; small, so that tests are quick.
inline LensFile lensFile() {
  LensFile file;
  file.image_size = {400, 300};
  LensStructure structure;
  structure.model = "conic";
  file.lens = makeLens(structure, {201.3, 148.2}, 400.0 / 3.1, 1.6);
  return file;
}

/// The room as a camera sees it that stands `x` metres to the right.
inline sim::Rendering roomFrom(double x, const LensFile& lens = lensFile()) {
  const sim::ScenePtr scene =
      sim::readScene(std::string(OMNISTER_SOURCE_DIR) + "/config/scenes/room.yaml");
  sim::RenderOptions options;
  options.adaptive = true;
  return sim::Renderer(*lens.lens, lens.image_size)
      .render(*scene, Pose(Eigen::Translation3d(x, 0, 0)), options);
}

/// Two rendered views of the room, a step to the right apart, and the truth of the second.
struct Views {
  LensFile lens = lensFile();
  cv::Mat left;
  cv::Mat right;  // CV_8UC3
  cv::Mat right_range;

  Views() {
    left = roomFrom(0.0, lens).image;
    const sim::Rendering rendering = roomFrom(kBaseline, lens);
    right = rendering.image;
    right_range = rendering.range;
  }
};

inline const Views& views() {
  static const Views instance;
  return instance;
}

/// Median relative error of ranges where both are known. @param share of the truth that has a range
inline double medianError(const cv::Mat& range, const cv::Mat& truth, double* share) {
  std::vector<double> errors;
  int known = 0;
  for (int v = 0; v < truth.rows; ++v)
    for (int u = 0; u < truth.cols; ++u) {
      if (std::isnan(truth.at<float>(v, u))) continue;
      ++known;
      if (std::isnan(range.at<float>(v, u))) continue;
      errors.push_back(std::abs(range.at<float>(v, u) / truth.at<float>(v, u) - 1.0));
    }
  *share = known > 0 ? static_cast<double>(errors.size()) / known : 0.0;
  if (errors.empty()) return std::numeric_limits<double>::infinity();
  std::nth_element(errors.begin(), errors.begin() + errors.size() / 2, errors.end());
  return errors[errors.size() / 2];
}

}  // namespace omnister::test
