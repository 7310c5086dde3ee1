// SPDX-License-Identifier: Apache-2.0
/// @file Parts of reports: HTML pages that need no other file, with their drawings inside.
#pragma once

#include <cairo.h>

#include <algorithm>
#include <functional>
#include <memory>
#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

namespace omnister::tools {

/// "-" for what is not finite.
std::string fixed(double value, int digits);

/// Safe within HTML.
std::string escaped(const std::string& text);

/// One row of a table; cells are HTML.
std::string row(const std::vector<std::string>& cells, const char* tag = "td");

/// From the doctype to the main heading.
std::string pageHead(const std::string& title);

/// An SVG as an image of its own: drawings inside one page would share the names of their glyphs.
std::string asImage(const std::string& svg);

/// A picture, as a PNG inside the page. @param width_px shown
std::string asImage(const cv::Mat& image, int width_px);

/// A figure with its caption (HTML).
std::string figure(const std::string& image, const std::string& caption);

/// What an axis has to hold.
struct Range {
  double low = 1e300, high = -1e300;
  void add(double value) {
    low = std::min(low, value);
    high = std::max(high, value);
  }
  /// @param share of the length added at either end
  void widen(double share = 0.05) {
    const double room = std::max(1e-9, high - low) * share;
    low -= room;
    high += room;
  }
};

/// A drawing of one plot: data coordinates inside a frame with a few numbers along its axes.
class Plot {
 public:
  Plot(double width, double height, double x0, double x1, double y0, double y1);

  double x(double value) const {
    return kLeft + (value - x0_) / (x1_ - x0_) * (width_ - kLeft - kRight);
  }
  double y(double value) const {
    return height_ - kBottom - (value - y0_) / (y1_ - y0_) * (height_ - kBottom - kTop);
  }

  void color(double red, double green, double blue) {
    cairo_set_source_rgb(cairo_.get(), red, green, blue);
  }
  void dot(double px, double py, double radius = 1.3);
  void line(double ax, double ay, double bx, double by);
  void box(double ax, double ay, double bx, double by);
  /// A part of an image and its error: white at level 0, red at 1, blue at -1, with a dot in its
  /// middle that tells it from what is empty.
  void errorCell(double ax, double ay, double bx, double by, double level);
  /// @param px, py in the drawing, not in the data
  void text(double px, double py, const std::string& words);

  /// Frame, numbers and names of the axes; closes the drawing. @return the SVG element
  std::string finish(const std::string& x_name, const std::string& y_name);

 private:
  /// Round numbers between the two, as they are written.
  static void ticks(double low, double high,
                    const std::function<void(double, const std::string&)>& put);

  static constexpr double kLeft = 48;
  static constexpr double kRight = 20;
  static constexpr double kTop = 22;
  static constexpr double kBottom = 34;

  struct Release {
    void operator()(cairo_surface_t* surface) const { cairo_surface_destroy(surface); }
    void operator()(cairo_t* cairo) const { cairo_destroy(cairo); }
  };
  double width_, height_, x0_, x1_, y0_, y1_;
  std::string svg_;
  std::unique_ptr<cairo_surface_t, Release> surface_;
  std::unique_ptr<cairo_t, Release> cairo_;
};

}  // namespace omnister::tools
