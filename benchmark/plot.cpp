// SPDX-License-Identifier: Apache-2.0
#include "plot.h"

#include <algorithm>
#include <cmath>
#include <cstdarg>
#include <cstdio>

namespace omnister::bench {
namespace {

constexpr double kWidth = 340, kHeight = 260, kLeft = 62, kRight = 16, kTop = 16, kBottom = 48;

__attribute__((format(printf, 1, 2))) std::string text(const char* format, ...) {
  char buffer[512];
  va_list arguments;
  va_start(arguments, format);
  std::vsnprintf(buffer, sizeof buffer, format, arguments);
  va_end(arguments);
  return buffer;
}

/// A step of 1, 2 or 5 times a power of ten that divides [0, most] into about five.
double tickStep(double most) {
  const double raw = most / 5.0;
  const double power = std::pow(10.0, std::floor(std::log10(raw)));
  for (const double factor : {1.0, 2.0, 5.0}) {
    if (factor * power >= raw * 0.999) return factor * power;
  }
  return 10.0 * power;
}

}  // namespace

std::string drawCharts(const std::vector<Series>& charts) {
  std::string svg = text(
      "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"%.0f\" height=\"%.0f\" "
      "font-family=\"sans-serif\" font-size=\"11\">\n"
      "<rect width=\"100%%\" height=\"100%%\" fill=\"white\"/>\n",
      kWidth * static_cast<double>(charts.size()), kHeight);
  for (std::size_t i = 0; i < charts.size(); ++i) {
    const Series& series = charts[i];
    double x_most = 0.0;
    double y_most = 0.0;
    for (const auto& [x, y] : series.points) {
      x_most = std::max(x_most, x);
      y_most = std::max(y_most, y);
    }
    if (!(x_most > 0.0 && y_most > 0.0)) continue;
    const double x_step = tickStep(x_most);
    const double y_step = tickStep(y_most);
    x_most = std::ceil(x_most / x_step - 1e-9) * x_step;
    y_most = std::ceil(y_most / y_step - 1e-9) * y_step;
    const double left = kWidth * static_cast<double>(i) + kLeft;
    const auto px = [&](double x) { return left + x / x_most * (kWidth - kLeft - kRight); };
    const auto py = [&](double y) {
      return kHeight - kBottom - y / y_most * (kHeight - kTop - kBottom);
    };
    for (double x = 0.0; x <= x_most * 1.001; x += x_step) {
      svg += text(
          "<line x1=\"%.1f\" y1=\"%.1f\" x2=\"%.1f\" y2=\"%.1f\" stroke=\"#ddd\"/>\n"
          "<text x=\"%.1f\" y=\"%.1f\" text-anchor=\"middle\">%g</text>\n",
          px(x), py(0), px(x), py(y_most), px(x), py(0) + 15, x);
    }
    for (double y = 0.0; y <= y_most * 1.001; y += y_step) {
      svg += text(
          "<line x1=\"%.1f\" y1=\"%.1f\" x2=\"%.1f\" y2=\"%.1f\" stroke=\"#ddd\"/>\n"
          "<text x=\"%.1f\" y=\"%.1f\" text-anchor=\"end\">%g</text>\n",
          px(0), py(y), px(x_most), py(y), px(0) - 5, py(y) + 4, y);
    }
    svg += "<polyline fill=\"none\" stroke=\"#1565c0\" stroke-width=\"2\" points=\"";
    for (const auto& [x, y] : series.points) svg += text("%.1f,%.1f ", px(x), py(y));
    svg += "\"/>\n";
    for (const auto& [x, y] : series.points) {
      svg += text("<circle cx=\"%.1f\" cy=\"%.1f\" r=\"3\" fill=\"#1565c0\"/>\n", px(x), py(y));
    }
    svg += text("<text x=\"%.1f\" y=\"%.1f\" text-anchor=\"middle\">%s</text>\n",
                0.5 * (px(0) + px(x_most)), kHeight - 12, series.x_label.c_str());
    svg += text(
        "<text x=\"%.1f\" y=\"%.1f\" text-anchor=\"middle\" transform=\"rotate(-90 %.1f "
        "%.1f)\">%s</text>\n",
        left - 46, 0.5 * (py(0) + py(y_most)), left - 46, 0.5 * (py(0) + py(y_most)),
        series.y_label.c_str());
  }
  return svg + "</svg>\n";
}

}  // namespace omnister::bench
