// SPDX-License-Identifier: Apache-2.0
#include "omnister/view/epipolar_overlay.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <opencv2/imgproc.hpp>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/stereo/epipolar.h"
#include "omnister/stereo/matching_limits.h"

namespace omnister {
namespace {

constexpr std::size_t kMostPixels = 64;
constexpr int kFractionBits = 4;  // of coordinates handed to the drawing functions

cv::Scalar colourOf(std::size_t number) {
  static const cv::Scalar colours[] = {{60, 220, 255}, {90, 255, 90},  {255, 190, 60},
                                       {200, 90, 255}, {80, 140, 255}, {255, 255, 120}};
  return colours[number % (sizeof colours / sizeof *colours)];
}

cv::Point fixed(const Eigen::Vector2d& pixel, int offset_x) {
  const auto scaled = [](double x) {
    return static_cast<int>(std::lround(std::clamp(x, -1e5, 1e5) * (1 << kFractionBits)));
  };
  return {scaled(pixel.x() + offset_x), scaled(pixel.y())};
}

void drawCurve(cv::Mat& picture, const std::vector<EpipolarPoint>& curve, int offset_x,
               const cv::Rect& area, const cv::Scalar& colour, int thickness) {
  for (std::size_t i = 1; i < curve.size(); ++i) {
    const Eigen::Vector2d& a = curve[i - 1].pixel;
    const Eigen::Vector2d& b = curve[i].pixel;
    // A gap is where the path leaves the field.
    if ((a - b).norm() > 6.0) continue;
    const cv::Rect_<double> inside(-0.5, -0.5, area.width, area.height);
    if (!inside.contains(cv::Point2d(a.x(), a.y())) || !inside.contains(cv::Point2d(b.x(), b.y())))
      continue;
    cv::line(picture, fixed(a, offset_x), fixed(b, offset_x), colour, thickness, cv::LINE_AA,
             kFractionBits);
  }
}

void drawCircle(cv::Mat& picture, const Eigen::Vector2d& pixel, int offset_x, int radius,
                const cv::Scalar& colour) {
  cv::circle(picture, fixed(pixel, offset_x), radius << kFractionBits, colour, 2, cv::LINE_AA,
             kFractionBits);
}

void drawCross(cv::Mat& picture, const Eigen::Vector2d& pixel, int offset_x, int radius,
               const cv::Scalar& colour) {
  for (const int sign : {-1, 1}) {
    const Eigen::Vector2d arm(radius, sign * radius);
    cv::line(picture, fixed(pixel - arm, offset_x), fixed(pixel + arm, offset_x), colour, 2,
             cv::LINE_AA, kFractionBits);
  }
}

void write(cv::Mat& picture, const std::string& text, cv::Point at, const cv::Scalar& colour) {
  const double scale = std::clamp(picture.rows / 1200.0, 0.35, 1.0);
  int below = 0;
  const cv::Size size = cv::getTextSize(text, cv::FONT_HERSHEY_SIMPLEX, scale, 1, &below);
  at.x = std::clamp(at.x, 0, std::max(0, picture.cols / 2 - size.width));
  at.y = std::clamp(at.y, size.height, std::max(size.height, picture.rows - below));
  cv::putText(picture, text, at, cv::FONT_HERSHEY_SIMPLEX, scale, cv::Scalar::all(0), 3,
              cv::LINE_AA);
  cv::putText(picture, text, at, cv::FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv::LINE_AA);
}

void check(const cv::Mat& image, cv::Size expected, const char* which) {
  if (image.size() != expected || image.type() != CV_8UC3)
    throw Error(std::string(which) + " image is " + std::to_string(image.cols) + "x" +
                std::to_string(image.rows) + ", expected 8-bit colour of " +
                std::to_string(expected.width) + "x" + std::to_string(expected.height));
}

}  // namespace

std::vector<cv::Point2d> parsePixels(const std::string& text, const std::string& source) {
  std::vector<cv::Point2d> pixels;
  std::size_t begin = 0;
  while (begin <= text.size()) {
    const std::size_t end = std::min(text.find(';', begin), text.size());
    const std::string part = text.substr(begin, end - begin);
    begin = end + 1;
    if (part.find_first_not_of(" \t\n") == std::string::npos) continue;
    const auto numbers = parseNumbers(part);
    if (!numbers || numbers->size() != 2 || !std::isfinite((*numbers)[0]) ||
        !std::isfinite((*numbers)[1]))
      throw InputError(source, "", "is '" + printable(text) + "', expected pixels \"u v; u v; …\"");
    pixels.emplace_back((*numbers)[0], (*numbers)[1]);
    if (pixels.size() > kMostPixels)
      throw InputError(source, "", "has more than " + std::to_string(kMostPixels) + " pixels");
  }
  return pixels;
}

std::vector<cv::Point2d> defaultPixels(cv::Size size) {
  const double w = size.width - 1;
  const double h = size.height - 1;
  return {{0.5 * w, 0.5 * h},
          {0.22 * w, 0.4 * h},
          {0.6 * w, 0.6 * h},
          {0.5 * w, 0.2 * h},
          {0.5 * w, 0.8 * h}};
}

cv::Mat drawEpipolarOverlay(const cv::Mat& reference, const cv::Mat& displaced,
                            const StereoGeometry& geometry, const MatcherOptions& options,
                            const MatchResult& result, const std::vector<cv::Point2d>& pixels) {
  const MatchingLimits limits = checkMatching(geometry, options);
  const StereoGeometry::Displaced& other = geometry.displaced.front();
  check(reference, geometry.reference_size, "reference");
  check(displaced, other.size, "displaced");
  if (result.range.size() != geometry.reference_size)
    throw Error("the range image does not have the size of the reference image");
  cv::Mat picture(std::max(reference.rows, displaced.rows), reference.cols + displaced.cols,
                  CV_8UC3, cv::Scalar::all(0));
  const cv::Rect left({0, 0}, reference.size());
  const cv::Rect right({reference.cols, 0}, displaced.size());
  reference.copyTo(picture(left));
  displaced.copyTo(picture(right));
  const Pose T_disp_ref = other.T_ref_disp.inverse();
  const int radius = std::clamp(picture.rows / 120, 3, 16);

  for (std::size_t i = 0; i < pixels.size(); ++i) {
    const cv::Scalar colour = colourOf(i);
    const Eigen::Vector2d pixel(pixels[i].x, pixels[i].y);
    const cv::Point at(static_cast<int>(std::lround(std::clamp(pixel.x(), -1e5, 1e5))),
                       static_cast<int>(std::lround(std::clamp(pixel.y(), -1e5, 1e5))));
    std::string label = std::to_string(i + 1) + ": ";
    const auto ray = left.contains(at) ? geometry.reference_lens->unproject(pixel) : std::nullopt;
    if (!ray) {
      write(picture, label + "outside the field", at + cv::Point(2 * radius, 0), colour);
      continue;
    }
    drawCircle(picture, pixel, 0, radius, colour);
    const EpipolarCurve path(*ray, other.T_ref_disp, *other.lens);
    // Past the parallax that range 0 would have there is no path.
    const double nearest =
        std::min(limits.maxInverseRange(), path.inverseRange(0.999 * path.maxParallax()));
    const std::vector<EpipolarPoint> curve =
        path.sample(limits.minInverseRange(), std::max(nearest, limits.minInverseRange()), 2.0);
    drawCurve(picture, curve, right.x, cv::Rect({0, 0}, right.size()), colour, 1);
    const auto in_right = [&](const Eigen::Vector2d& p) {
      return p.x() >= 0 && p.y() >= 0 && p.x() < right.width && p.y() < right.height;
    };
    if (!curve.empty() && in_right(curve.front().pixel))
      drawCircle(picture, curve.front().pixel, right.x, radius / 2 + 1, colour);
    if (!curve.empty() && in_right(curve.back().pixel)) {
      const Eigen::Vector2d half(radius / 2 + 1, radius / 2 + 1);
      cv::rectangle(picture, fixed(curve.back().pixel - half, right.x),
                    fixed(curve.back().pixel + half, right.x), colour, 2, cv::LINE_AA,
                    kFractionBits);
    }
    const float range = result.range.at<float>(at);
    if (std::isnan(range)) {
      label += "no match";
    } else {
      char text[80];
      std::snprintf(text, sizeof text, "%.3g m +- %.2g, score %.2f", range,
                    result.sigma.at<float>(at), result.score.at<float>(at));
      label += text;
      const Eigen::Vector3d seen = path.bearing(1.0 / range);
      if (const auto match = other.lens->project(seen)) {
        if (in_right(*match)) drawCross(picture, *match, right.x, radius, colour);
        const EpipolarCurve back(seen.normalized(), T_disp_ref, *geometry.reference_lens);
        const double back_nearest =
            std::min(limits.maxInverseRange(), back.inverseRange(0.999 * back.maxParallax()));
        drawCurve(picture,
                  back.sample(limits.minInverseRange(),
                              std::max(back_nearest, limits.minInverseRange()), 2.0),
                  0, left, colour, 1);
      }
    }
    write(picture, label, at + cv::Point(2 * radius, -radius), colour);
  }
  return picture;
}

}  // namespace omnister
