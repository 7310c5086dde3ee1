// SPDX-License-Identifier: Apache-2.0
#include "tools/target/target_print.h"

#include <cairo-pdf.h>
#include <cairo-svg.h>
#include <cairo.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <memory>
#include <new>
#include <opencv2/core.hpp>
#include <opencv2/imgproc.hpp>
#include <optional>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"

namespace omnister::tools {
namespace {

constexpr double kPointsPerMm = 72.0 / 25.4;
constexpr double kUnprintable = 5.0;    // rim that printers leave white [mm]
constexpr double kEnoughMargin = 10.0;  // white around a pattern of any size [mm]
constexpr double kFooter = 11.0;        // bar and line of text [mm]
constexpr double kMaxPage = 5000.0;     // what PDF can say [mm]

struct NamedPage {
  const char* name;
  double width_mm;
  double height_mm;
};
constexpr std::array<NamedPage, 8> kPages{{{"letter", 215.9, 279.4},
                                           {"a4", 210, 297},
                                           {"legal", 215.9, 355.6},
                                           {"tabloid", 279.4, 431.8},
                                           {"a3", 297, 420},
                                           {"a2", 420, 594},
                                           {"a1", 594, 841},
                                           {"a0", 841, 1189}}};

std::string millimetres(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.5g", value);
  return text;
}

std::optional<Layout> tryLayout(const Target& target, const Page& page) {
  const TargetArtwork art = targetArtwork(target);
  Layout layout;
  layout.target = target;
  layout.width_mm = 1e3 * (art.max.x() - art.min.x());
  layout.height_mm = 1e3 * (art.max.y() - art.min.y());
  // The paper is the margin; it must not end, and the footer not begin, before the margin does.
  const double rim = std::clamp(1e3 * art.margin, kUnprintable, kEnoughMargin);
  constexpr double kRounding = 1e-6;
  for (const bool turned : {false, true}) {
    layout.page = page;
    if (turned) std::swap(layout.page.width_mm, layout.page.height_mm);
    const double free_width = layout.page.width_mm - layout.width_mm - 2 * rim;
    const double free_height =
        layout.page.height_mm - layout.height_mm - 2 * rim - kFooter - kUnprintable;
    if (free_width < -kRounding || free_height < -kRounding) continue;
    layout.left_mm = rim + 0.5 * free_width;
    layout.top_mm = rim + 0.5 * free_height;
    layout.bar_mm = 100.0;
    while (layout.bar_mm > layout.page.width_mm - 4 * kUnprintable && layout.bar_mm > 10.0) {
      layout.bar_mm -= 10.0;
    }
    return layout;
  }
  return std::nullopt;
}

Target scaledTarget(Target target, double scale) {
  target.square_m *= scale;
  target.marker_m *= scale;
  target.dot_m *= scale;
  return target;
}

std::string describe(const Target& target) {
  const std::string size = std::to_string(target.cols) + " x " + std::to_string(target.rows);
  const std::string square = millimetres(1e3 * target.square_m) + " mm";
  switch (target.type) {
    case TargetType::kCheckerboard:
      return "checkerboard, " + size + " inner corners, squares " + square;
    case TargetType::kCircles:
      return target.asymmetric ? "circles, " + size + " asymmetric, rows " + square + " apart"
                               : "circles, " + size + ", " + square + " apart";
    case TargetType::kCharuco:
      return "charuco, " + size + " squares of " + square + ", markers " +
             millimetres(1e3 * target.marker_m) + " mm, " + target.dictionary +
             (target.legacy ? ", legacy" : "");
    case TargetType::kAprilGrid:
      return "aprilgrid, " + size + " tags of " + square + ", gap " +
             millimetres(1e3 * target.square_m * target.spacing) + " mm, " + target.dictionary +
             ", border of " + std::to_string(std::max(1, target.border_bits)) + " bit" +
             (target.border_bits == 2 ? "s (Kalibr's)" : "");
  }
  return "";
}

using Surface = std::unique_ptr<cairo_surface_t, void (*)(cairo_surface_t*)>;

void check(cairo_status_t status) {
  if (status == CAIRO_STATUS_NO_MEMORY) throw std::bad_alloc();
  if (status != CAIRO_STATUS_SUCCESS) {
    throw Error(std::string("cannot draw the target: ") + cairo_status_to_string(status));
  }
}

// Draws in units of `scale` per millimetre.
void draw(cairo_surface_t* surface, const Layout& layout, double scale) {
  const std::unique_ptr<cairo_t, void (*)(cairo_t*)> context(cairo_create(surface), cairo_destroy);
  cairo_t* cr = context.get();
  check(cairo_status(cr));
  cairo_scale(cr, scale, scale);
  cairo_set_source_rgb(cr, 1, 1, 1);
  cairo_paint(cr);
  cairo_set_source_rgb(cr, 0, 0, 0);

  const TargetArtwork art = targetArtwork(layout.target);
  const double x0 = layout.left_mm - 1e3 * art.min.x();
  const double y0 = layout.top_mm - 1e3 * art.min.y();
  // One path, so that rectangles side by side leave no hairline between them.
  for (const auto& r : art.rectangles) {
    cairo_rectangle(cr, x0 + 1e3 * r.x, y0 + 1e3 * r.y, 1e3 * r.width, 1e3 * r.height);
  }
  for (const auto& dot : art.dots) {
    cairo_new_sub_path(cr);
    cairo_arc(cr, x0 + 1e3 * dot.x, y0 + 1e3 * dot.y, 1e3 * dot.radius, 0, 2 * M_PI);
  }
  cairo_fill(cr);

  // The bar: someone with a ruler can tell whether the printer kept the scale.
  const double bottom = layout.page.height_mm - kUnprintable;
  const double left = 2 * kUnprintable;
  const double bar = bottom - 6.0;
  cairo_set_line_width(cr, 0.25);
  cairo_move_to(cr, left, bar);
  cairo_line_to(cr, left + layout.bar_mm, bar);
  for (double tick = 0; tick <= layout.bar_mm; tick += 10) {
    const bool end = tick == 0 || tick == layout.bar_mm;
    cairo_move_to(cr, left + tick, bar - (end ? 2.0 : 1.0));
    cairo_line_to(cr, left + tick, bar + (end ? 1.0 : 0.0));
  }
  cairo_stroke(cr);
  cairo_select_font_face(cr, "sans-serif", CAIRO_FONT_SLANT_NORMAL, CAIRO_FONT_WEIGHT_NORMAL);
  const std::string text = millimetres(layout.bar_mm) + " mm when printed without scaling   |   " +
                           describe(layout.target);
  double size = 3.0;
  cairo_text_extents_t extents;
  for (;; size *= 0.9) {
    cairo_set_font_size(cr, size);
    cairo_text_extents(cr, text.c_str(), &extents);
    if (size < 1.0 || extents.width <= layout.page.width_mm - 4 * kUnprintable) break;
  }
  cairo_move_to(cr, left, bottom - 1.0);
  cairo_show_text(cr, text.c_str());
  cairo_show_page(cr);
  check(cairo_status(cr));
}

cairo_status_t append(void* bytes, const unsigned char* data, unsigned int length) {
  try {
    static_cast<std::string*>(bytes)->append(reinterpret_cast<const char*>(data), length);
    return CAIRO_STATUS_SUCCESS;
  } catch (const std::bad_alloc&) {
    return CAIRO_STATUS_NO_MEMORY;
  }
}

template <typename Create>
std::string drawTo(const Layout& layout, Create create) {
  std::string bytes;
  {
    const Surface surface(create(append, &bytes, layout.page.width_mm * kPointsPerMm,
                                 layout.page.height_mm * kPointsPerMm),
                          cairo_surface_destroy);
    check(cairo_surface_status(surface.get()));
    draw(surface.get(), layout, kPointsPerMm);
    cairo_surface_finish(surface.get());
    check(cairo_surface_status(surface.get()));
  }
  return bytes;
}

}  // namespace

Page parsePage(const std::string& text) {
  for (const NamedPage& page : kPages) {
    if (text == page.name) return {text, page.width_mm, page.height_mm};
  }
  const std::size_t cross = text.find('x');
  if (cross != std::string::npos) {
    const auto width = parseNumber(text.substr(0, cross));
    const auto height = parseNumber(text.substr(cross + 1));
    if (width && height && *width >= 20 && *height >= 20 && *width <= kMaxPage &&
        *height <= kMaxPage) {
      return {text, *width, *height};
    }
  }
  throw InputError("--page", "",
                   "is '" + printable(text, 40) +
                       "', expected a0 to a4, letter, legal, tabloid, or WxH from 20 to 5000 mm");
}

Layout layOut(const Target& target, const Page& page) {
  if (const auto layout = tryLayout(target, page)) return *layout;
  const TargetArtwork art = targetArtwork(target);
  std::string larger;
  for (const NamedPage& named : kPages) {
    if (tryLayout(target, {named.name, named.width_mm, named.height_mm})) {
      larger = "--page " + std::string(named.name) + " or ";
      break;
    }
  }
  double fits = 0.0;
  double too_large = 1.0;
  for (int round = 0; round < 40; ++round) {
    const double middle = 0.5 * (fits + too_large);
    (middle * target.square_m > 1e-5 && tryLayout(scaledTarget(target, middle), page) ? fits
                                                                                      : too_large) =
        middle;
  }
  std::string smaller = "fewer columns or rows";
  const double square_mm = std::floor(1e4 * fits * target.square_m) / 10.0;
  if (square_mm > 0.0) smaller = "--square-mm " + millimetres(square_mm) + " or less";
  throw InputError("--page", "",
                   "the board is " + millimetres(1e3 * (art.max.x() - art.min.x())) + " x " +
                       millimetres(1e3 * (art.max.y() - art.min.y())) + " mm and does not fit on " +
                       page.name + " (" + millimetres(page.width_mm) + " x " +
                       millimetres(page.height_mm) + " mm) with its white margin, expected " +
                       larger + smaller);
}

std::string drawPdf(const Layout& layout) {
  return drawTo(layout, cairo_pdf_surface_create_for_stream);
}

std::string drawSvg(const Layout& layout) {
  return drawTo(layout, cairo_svg_surface_create_for_stream);
}

cv::Mat drawImage(const Layout& layout, double pixels_per_mm) {
  const int width = static_cast<int>(std::lround(layout.page.width_mm * pixels_per_mm));
  const int height = static_cast<int>(std::lround(layout.page.height_mm * pixels_per_mm));
  const Surface surface(cairo_image_surface_create(CAIRO_FORMAT_RGB24, width, height),
                        cairo_surface_destroy);
  check(cairo_surface_status(surface.get()));
  draw(surface.get(), layout, pixels_per_mm);
  cairo_surface_flush(surface.get());
  const cv::Mat page(height, width, CV_8UC4, cairo_image_surface_get_data(surface.get()),
                     cairo_image_surface_get_stride(surface.get()));
  cv::Mat gray;
  cv::extractChannel(page, gray, 0);
  return gray;
}

}  // namespace omnister::tools
