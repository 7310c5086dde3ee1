// SPDX-License-Identifier: Apache-2.0
#include "tools/report/html_plot.h"

#include <cairo-svg.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <opencv2/imgcodecs.hpp>

#include "omnister/common/error.h"
#include "omnister/common/text.h"

namespace omnister::tools {
namespace {

constexpr double kPi = 3.14159265358979323846;

cairo_status_t append(void* text, const unsigned char* bytes, unsigned int length) {
  static_cast<std::string*>(text)->append(reinterpret_cast<const char*>(bytes), length);
  return CAIRO_STATUS_SUCCESS;
}

std::string base64(const unsigned char* bytes, std::size_t size) {
  static constexpr char kDigits[] =
      "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string text;
  text.reserve(size * 4 / 3 + 4);
  for (std::size_t i = 0; i < size; i += 3) {
    unsigned bits = 0;
    for (std::size_t k = 0; k < 3; ++k) bits = bits << 8 | (i + k < size ? bytes[i + k] : 0u);
    for (std::size_t k = 0; k < 4; ++k) {
      text += i + k <= size ? kDigits[bits >> (18 - 6 * k) & 63u] : '=';
    }
  }
  return text;
}

}  // namespace

std::string fixed(double value, int digits) {
  return std::isfinite(value) ? formatFixed(value, digits) : "-";
}

std::string escaped(const std::string& text) {
  std::string safe;
  for (const char c : printable(text, 1000)) {
    switch (c) {
      case '<':
        safe += "&lt;";
        break;
      case '>':
        safe += "&gt;";
        break;
      case '&':
        safe += "&amp;";
        break;
      case '"':
        safe += "&quot;";
        break;
      default:
        safe += c;
    }
  }
  return safe;
}

std::string row(const std::vector<std::string>& cells, const char* tag) {
  std::string text = "<tr>";
  for (const std::string& cell : cells) {
    text += std::string("<") + tag + ">" + cell + "</" + tag + ">";
  }
  return text + "</tr>\n";
}

std::string pageHead(const std::string& title) {
  return "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>" +
         escaped(title) +
         "</title>\n<style>body{font-family:sans-serif;max-width:1100px;margin:1em auto}"
         "table{border-collapse:collapse}td,th{border:1px solid #bbb;padding:2px 8px;"
         "text-align:left}figure{display:inline-block;margin:8px;vertical-align:top}"
         "figcaption{max-width:520px}tr.chosen{background:#dfd}</style></head><body>\n<h1>" +
         escaped(title) + "</h1>\n";
}

std::string asImage(const std::string& svg) {
  return "<img alt=\"\" src=\"data:image/svg+xml;base64," +
         base64(reinterpret_cast<const unsigned char*>(svg.data()), svg.size()) + "\">";
}

std::string asImage(const cv::Mat& image, int width_px) {
  std::vector<unsigned char> png;
  if (!cv::imencode(".png", image, png)) throw Error("a picture of the report cannot be encoded");
  return "<img alt=\"\" width=\"" + std::to_string(width_px) + "\" src=\"data:image/png;base64," +
         base64(png.data(), png.size()) + "\">";
}

std::string figure(const std::string& image, const std::string& caption) {
  return "<figure>" + image + "<figcaption>" + caption + "</figcaption></figure>\n";
}

Plot::Plot(double width, double height, double x0, double x1, double y0, double y1)
    : width_(width), height_(height), x0_(x0), x1_(x1), y0_(y0), y1_(y1) {
  surface_.reset(cairo_svg_surface_create_for_stream(&append, &svg_, width, height));
  cairo_.reset(cairo_create(surface_.get()));
  cairo_select_font_face(cairo_.get(), "sans-serif", CAIRO_FONT_SLANT_NORMAL,
                         CAIRO_FONT_WEIGHT_NORMAL);
  cairo_set_font_size(cairo_.get(), 11);
}

void Plot::dot(double px, double py, double radius) {
  cairo_arc(cairo_.get(), x(px), y(py), radius, 0, 2 * kPi);
  cairo_fill(cairo_.get());
}

void Plot::line(double ax, double ay, double bx, double by) {
  cairo_set_line_width(cairo_.get(), 1.0);
  cairo_move_to(cairo_.get(), x(ax), y(ay));
  cairo_line_to(cairo_.get(), x(bx), y(by));
  cairo_stroke(cairo_.get());
}

void Plot::box(double ax, double ay, double bx, double by) {
  cairo_rectangle(cairo_.get(), std::min(x(ax), x(bx)), std::min(y(ay), y(by)),
                  std::abs(x(bx) - x(ax)), std::abs(y(by) - y(ay)));
  cairo_fill(cairo_.get());
}

void Plot::errorCell(double ax, double ay, double bx, double by, double level) {
  level = std::clamp(level, -1.0, 1.0);
  color(level > 0 ? 1.0 : 1.0 + level, 1.0 - std::abs(level), level < 0 ? 1.0 : 1.0 - level);
  box(ax, ay, bx, by);
  color(0.6, 0.6, 0.6);
  dot(0.5 * (ax + bx), 0.5 * (ay + by), 0.7);
}

void Plot::text(double px, double py, const std::string& words) {
  cairo_move_to(cairo_.get(), px, py);
  cairo_show_text(cairo_.get(), words.c_str());
}

void Plot::ticks(double low, double high,
                 const std::function<void(double, const std::string&)>& put) {
  // Steps of 1, 2 or 5 times a power of ten, four to nine of them.
  const double rough = std::abs(high - low) / 5.0;
  if (!(rough > 0.0) || !std::isfinite(rough)) return;
  const double power = std::pow(10.0, std::floor(std::log10(rough)));
  const double step = power * (rough < 1.5 * power   ? 1.0
                               : rough < 3.5 * power ? 2.0
                               : rough < 7.5 * power ? 5.0
                                                     : 10.0);
  const int digits = std::max(0, static_cast<int>(-std::floor(std::log10(step) + 1e-9)));
  const double first = std::ceil(std::min(low, high) / step - 1e-9);
  const double last = std::floor(std::max(low, high) / step + 1e-9);
  // Added to zero, minus zero becomes zero.
  for (double i = first; i <= last; i += 1.0) put(i * step + 0.0, fixed(i * step + 0.0, digits));
}

std::string Plot::finish(const std::string& x_name, const std::string& y_name) {
  const auto width = [this](const std::string& words) {
    cairo_text_extents_t extents;
    cairo_text_extents(cairo_.get(), words.c_str(), &extents);
    return extents.x_advance;
  };
  const double bottom = height_ - kBottom;
  color(0, 0, 0);
  cairo_set_line_width(cairo_.get(), 1.0);
  cairo_rectangle(cairo_.get(), kLeft, kTop, width_ - kLeft - kRight, bottom - kTop);
  cairo_stroke(cairo_.get());
  ticks(x0_, x1_, [&](double value, const std::string& number) {
    cairo_move_to(cairo_.get(), x(value), bottom);
    cairo_line_to(cairo_.get(), x(value), bottom - 4);
    cairo_stroke(cairo_.get());
    text(x(value) - 0.5 * width(number), bottom + 14, number);
  });
  ticks(y0_, y1_, [&](double value, const std::string& number) {
    cairo_move_to(cairo_.get(), kLeft, y(value));
    cairo_line_to(cairo_.get(), kLeft + 4, y(value));
    cairo_stroke(cairo_.get());
    text(kLeft - 4 - width(number), y(value) + 4, number);
  });
  text(0.5 * (kLeft + width_ - kRight - width(x_name)), height_ - 4, x_name);
  text(2, 11, y_name);
  cairo_.reset();
  cairo_surface_finish(surface_.get());
  return svg_;
}

}  // namespace omnister::tools
