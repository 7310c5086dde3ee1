// SPDX-License-Identifier: Apache-2.0
#include "tools/calibrate/report_pictures.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <opencv2/imgproc.hpp>

#include "omnister/common/error.h"
#include "omnister/common/text.h"
#include "tools/report/html_plot.h"

namespace omnister::tools {
namespace {

constexpr int kMapWidth = 520;    // [px]
constexpr int kThumbWidth = 240;  // [px]
constexpr std::size_t kMostThumbs = 80;
constexpr double kGoodPx = 0.2;    // uncertainty of a good calibration, over the image
constexpr double kUsablePx = 1.0;  // and of one that serves at all
constexpr int kGoodViews = 10;

int usedViews(const CalibrationResult& result) {
  return static_cast<int>(std::count_if(result.views.begin(), result.views.end(),
                                        [](const ViewResult& view) { return view.used; }));
}

/// White over yellow to red.
cv::Scalar heat(double level) {
  level = std::clamp(level, 0.0, 1.0);
  return {255.0 * std::max(0.0, 1.0 - 2.0 * level), 255.0 * std::min(1.0, 2.0 - 2.0 * level),
          255.0};
}

cv::Mat smallColor(const cv::Mat& gray, int width) {
  cv::Mat plain;
  if (gray.depth() == CV_8U) {
    plain = gray;
  } else {
    double least = 0.0;
    double most = 1.0;
    cv::minMaxLoc(gray, &least, &most);
    gray.convertTo(plain, CV_8U, 255.0 / std::max(1e-9, most - least),
                   -255.0 * least / std::max(1e-9, most - least));
  }
  cv::Mat small, color;
  const int height = std::max(
      1, static_cast<int>(std::lround(static_cast<double>(plain.rows) * width / plain.cols)));
  cv::resize(plain, small, {width, height}, 0, 0, cv::INTER_AREA);
  cv::cvtColor(small, color, cv::COLOR_GRAY2BGR);
  return color;
}

/// The first picture that can be read, small; grey without.
cv::Mat background(const Detections& detections, const ReportPictures& pictures,
                   const cv::Size& size) {
  if (pictures.read) {
    for (const ViewDetections& view : detections.views) {
      const cv::Mat image = pictures.read(view.name);
      if (!image.empty()) return smallColor(image, kMapWidth);
    }
  }
  const int height = std::max(
      1, static_cast<int>(std::lround(static_cast<double>(size.height) * kMapWidth / size.width)));
  return cv::Mat(height, kMapWidth, CV_8UC3, cv::Scalar::all(150));
}

cv::Point placeOf(const Eigen::Vector2d& pixel, double scale) {
  constexpr double kSixteenths = 16.0;
  return {static_cast<int>(std::lround(kSixteenths * ((pixel.x() + 0.5) * scale - 0.5))),
          static_cast<int>(std::lround(kSixteenths * ((pixel.y() + 0.5) * scale - 0.5)))};
}

cv::Mat withScale(const cv::Mat& map, double most, const std::string& unit) {
  constexpr int kBar = 34;
  cv::Mat page(map.rows + kBar, map.cols, CV_8UC3, cv::Scalar::all(255));
  map.copyTo(page(cv::Rect(0, 0, map.cols, map.rows)));
  const int left = 10;
  const int right = map.cols - 10;
  for (int x = left; x < right; ++x) {
    cv::line(page, {x, map.rows + 6}, {x, map.rows + 16},
             heat(static_cast<double>(x - left) / (right - left)));
  }
  for (int tick = 0; tick <= 4; ++tick) {
    const std::string text =
        formatFixed(0.25 * tick * most, most < 0.4 ? 3 : 2) + (tick == 4 ? unit : "");
    const int x = left + tick * (right - left) / 4;
    const cv::Size size = cv::getTextSize(text, cv::FONT_HERSHEY_SIMPLEX, 0.38, 1, nullptr);
    const int at = std::clamp(x - size.width / 2, 2, map.cols - size.width - 2);
    cv::putText(page, text, {at, map.rows + 29}, cv::FONT_HERSHEY_SIMPLEX, 0.38, cv::Scalar::all(0),
                1, cv::LINE_AA);
  }
  return page;
}

}  // namespace

Verdict verdictOn(const CalibrationResult& result, const ReportPictures& pictures) {
  Verdict verdict;
  const int used = usedViews(result);
  const double uncertain = result.uncertainty_rms_px;
  bool good = true;
  bool usable = true;
  verdict.why.push_back("corners lie " + fixed(result.rms_px, 2) +
                        " px from where the lens puts them (RMS), in " + std::to_string(used) +
                        " pictures");
  verdict.why.push_back("directions are known to " + fixed(uncertain, 2) +
                        " px over the image (RMS), " + fixed(result.uncertainty_max_px, 2) +
                        " px where they are known worst");
  if (!(uncertain <= kGoodPx)) good = false;
  if (!(uncertain <= kUsablePx)) usable = false;
  if (used < kGoodViews) {
    good = false;
    verdict.advice.push_back("take more pictures: 15 to 30, these are " + std::to_string(used));
  }
  for (const std::string& warning : result.warnings) {
    if (warning.find("no corner lies in the outer image") != std::string::npos) {
      good = false;
      verdict.why.push_back(warning);
      verdict.advice.push_back("hold the board near the edge of the image there");
    } else if (warning.find("bias exceeds") != std::string::npos) {
      good = false;
      verdict.why.push_back(warning);
    } else if (warning.find("contradict") != std::string::npos) {
      good = false;
      verdict.why.push_back(warning);
      verdict.advice.push_back("sort the pictures: one camera, one focus, none turned");
    }
  }
  if (!pictures.left_out.empty()) {
    verdict.why.push_back(std::to_string(pictures.left_out.size()) +
                          " pictures could not be used, see below");
  }
  for (const NextView& view : pictures.next) {
    if (good && view.uncertainty_px > 0.8 * uncertain) break;
    verdict.advice.push_back("hold the board " + view.where + ": known to " +
                             fixed(view.uncertainty_px, 2) + " px with it");
  }
  if (verdict.advice.empty()) verdict.advice.push_back("nothing: use it");
  verdict.word = !usable ? "not good" : good ? "good" : "usable";
  return verdict;
}

std::string verdictSection(const CalibrationResult& result, const ReportPictures& pictures) {
  const Verdict verdict = verdictOn(result, pictures);
  const char* color = verdict.word == "good" ? "#cec" : verdict.word == "usable" ? "#ffc" : "#fcc";
  std::string html = std::string("<div style=\"background:") + color +
                     ";padding:6px 16px\"><h2>This calibration is " + verdict.word +
                     "</h2>\n<p>Why:</p><ul>\n";
  for (const std::string& line : verdict.why) html += "<li>" + escaped(line) + "</li>\n";
  html += "</ul><p>What to do:</p><ul>\n";
  for (const std::string& line : verdict.advice) html += "<li>" + escaped(line) + "</li>\n";
  html += "</ul></div>\n";
  if (pictures.left_out.empty()) return html;
  html += "<h2>Pictures left out</h2>\n<table>\n" + row({"picture", "why"}, "th");
  for (const LeftOut& one : pictures.left_out)
    html += row({escaped(one.image), escaped(one.reason)});
  return html + "</table>\n";
}

std::string mapOverPicture(const ProjectionField& field, const Detections& detections,
                           const ReportPictures& pictures, const std::string& caption) {
  cv::Mat map = background(detections, pictures, field.image_size);
  cv::Mat colors = map.clone();
  for (int y = 0; y < field.rows; ++y) {
    for (int x = 0; x < field.cols; ++x) {
      const double value = field.at(x, y);
      if (std::isnan(value)) continue;
      const cv::Point from(x * map.cols / field.cols, y * map.rows / field.rows);
      const cv::Point to((x + 1) * map.cols / field.cols - 1, (y + 1) * map.rows / field.rows - 1);
      cv::rectangle(colors, from, to, heat(value / std::max(field.max_px, 1e-12)), cv::FILLED);
    }
  }
  cv::addWeighted(colors, 0.55, map, 0.45, 0.0, map);
  const double scale = static_cast<double>(map.cols) / field.image_size.width;
  int number = 0;
  for (const NextView& view : pictures.next) {
    ++number;
    for (std::size_t i = 0; i < view.outline.size(); ++i) {
      cv::line(map, placeOf(view.outline[i], scale),
               placeOf(view.outline[(i + 1) % view.outline.size()], scale), cv::Scalar(255, 60, 0),
               2, cv::LINE_AA, 4);
    }
    if (!view.outline.empty()) {
      const cv::Point at = placeOf(view.outline[0], scale) / 16;
      cv::putText(map, std::to_string(number), at + cv::Point(4, 16), cv::FONT_HERSHEY_SIMPLEX, 0.5,
                  cv::Scalar(255, 60, 0), 2, cv::LINE_AA);
    }
  }
  return figure(asImage(withScale(map, field.max_px, " px"), kMapWidth), caption);
}

std::string thumbnails(const Detections& detections, const CalibrationResult& result,
                       const ReportPictures& pictures) {
  if (!pictures.read) return "";
  std::string html;
  std::size_t shown = 0;
  for (std::size_t v = 0; v < result.views.size() && v < detections.views.size(); ++v) {
    if (shown == kMostThumbs) break;
    const cv::Mat image = pictures.read(detections.views[v].name);
    if (image.empty()) continue;
    ++shown;
    cv::Mat thumb = smallColor(image, kThumbWidth);
    const double scale = static_cast<double>(thumb.cols) / image.cols;
    const ViewResult& view = result.views[v];
    const auto& pixels = detections.views[v].pixels;
    for (std::size_t i = 0; i < pixels.size(); ++i) {
      const bool off = i < view.residuals.size() && view.residuals[i].norm() > 4.0 * result.rms_px;
      cv::circle(thumb, placeOf(pixels[i], scale), 24,
                 !view.used || off ? cv::Scalar(0, 0, 255) : cv::Scalar(0, 200, 0), cv::FILLED,
                 cv::LINE_AA, 4);
    }
    const std::string name = view.name.substr(view.name.find_last_of('/') + 1);
    html +=
        figure(asImage(thumb, kThumbWidth),
               escaped(name) + (view.used ? ": " + fixed(view.rms_px, 3) + " px" : ": not used"));
  }
  return html.empty() ? html : "<h2>Pictures and their corners</h2>\n" + html;
}

}  // namespace omnister::tools
