// SPDX-License-Identifier: Apache-2.0
/// @file Drawing calibration targets at true scale.
#pragma once

#include <opencv2/core/mat.hpp>
#include <string>

#include "omnister/calibration/target.h"

namespace omnister::tools {

/// Size of paper as it will lie [mm].
struct Page {
  std::string name;
  double width_mm = 0.0;
  double height_mm = 0.0;
};

/// "a4" (and a0 to a3), "letter", "legal", "tabloid", or "WxH" in millimetres.
/// @throws InputError
Page parsePage(const std::string& text);

/// A target on a page: in the middle, over a bar of 100 mm (shorter on narrow pages) and a line
/// that says what it is.
struct Layout {
  Target target;
  Page page;             ///< turned to landscape where that is what it takes
  double left_mm = 0.0;  ///< corner of the pattern on the page
  double top_mm = 0.0;
  double width_mm = 0.0;  ///< of the pattern, without its white margin
  double height_mm = 0.0;
  double bar_mm = 0.0;
};

/// @throws InputError when it does not fit, saying which page or which size of square would
Layout layOut(const Target& target, const Page& page);

std::string drawPdf(const Layout& layout);
std::string drawSvg(const Layout& layout);
/// The same page as a picture, CV_8UC1; tests detect the board in it.
cv::Mat drawImage(const Layout& layout, double pixels_per_mm);

}  // namespace omnister::tools
