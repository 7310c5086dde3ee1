// SPDX-License-Identifier: Apache-2.0
#include "stereo/sweep/grid/geometry.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <opencv2/core.hpp>
#include <optional>
#include <tuple>
#include <utility>

#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "stereo/sweep/kernels/kernels.h"

namespace omnister::sweep {
namespace {

constexpr double kPi = 3.141592653589793;
constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr int kNodeStep = 16;  ///< pixels or cells between exact evaluations of the lens
constexpr int kRun = 8;        ///< cells of a run

/// Weights of the cubic through four equally spaced values, at t in [0, 1) between the middle two.
std::array<float, 4> cubicWeights(double t) {
  return {static_cast<float>(-t * (t - 1) * (t - 2) / 6),
          static_cast<float>((t + 1) * (t - 1) * (t - 2) / 2),
          static_cast<float>(-(t + 1) * t * (t - 2) / 2),
          static_cast<float>((t + 1) * t * (t - 1) / 6)};
}

/// atan2 without branches, so that loops over it become vector code; error below 2e-7 rad.
inline float smoothAtan2(float y, float x) {
  const float ax = std::fabs(x), ay = std::fabs(y);
  const float large = ax > ay ? ax : ay, small = ax > ay ? ay : ax;
  const bool far = small > 0.41421356f * large;
  const float numerator = far ? small - large : small;
  const float denominator = far ? small + large : large;
  const float r = numerator / (denominator + 1e-30f);
  const float s = r * r;
  float angle = (((8.05374449538e-2f * s - 1.38776856032e-1f) * s + 1.99777106478e-1f) * s -
                 3.33329491539e-1f) *
                    s * r +
                r;
  angle += far ? 0.78539816f : 0.0f;
  angle = ay > ax ? 1.57079633f - angle : angle;
  angle = x < 0 ? 3.14159265f - angle : angle;
  return y < 0 ? -angle : angle;
}

}  // namespace

EpipolarFrame makeEpipolarFrame(const Eigen::Vector3d& t) {
  EpipolarFrame frame;
  frame.baseline = t.norm();
  if (!(frame.baseline > 0) || !std::isfinite(frame.baseline))
    throw Error(
        "the displaced camera stands where the reference does: no baseline, so no parallax");
  const Eigen::Vector3d e = t / frame.baseline;
  Eigen::Vector3d m = Eigen::Vector3d::UnitZ() - e.z() * e;
  if (m.norm() < 0.1) m = Eigen::Vector3d::UnitY() - e.y() * e;
  m.normalize();
  frame.basis.row(0) = e;
  frame.basis.row(1) = m;
  frame.basis.row(2) = e.cross(m);
  return frame;
}

WideLens widen(const LensPtr& lens) {
  WideLens wide{lens, std::cos(lens->maxTheta())};
  for (const double factor : {1.12, 1.06, 1.03}) {
    const double field = lens->maxTheta() * factor;
    if (field >= kPi - 0.01) continue;
    if (LensPtr wider = lens->withParameters(lens->parameters(), field)) {
      wide.lens = wider;
      break;
    }
  }
  return wide;
}

namespace {

/// What a pixel is made from: rays at the corners of cells, and the lens where there are none.
struct RayNodes {
  const WideLens& lens;
  const EpipolarFrame& frame;
  int scale;
  int nodes_x;
  Eigen::Vector3f axis_z;
  std::vector<Eigen::Vector3f> nodes = {};  ///< (e, m, n), NaN where the lens has none

  std::optional<Eigen::Vector3d> lensRay(int x, int y) const {
    const auto ray =
        lens.lens->unproject(Eigen::Vector2d((x + 0.5) * scale - 0.5, (y + 0.5) * scale - 0.5));
    if (!ray) return std::nullopt;
    return Eigen::Vector3d(frame.basis * *ray);
  }

  /// Between the corners of a cell; NaN where one of the sixteen is.
  Eigen::Vector3f between(int cell_x, int cell_y, const float* wx, const float* wy) const {
    Eigen::Vector3f sum = Eigen::Vector3f::Zero();
    for (int j = 0; j < 4; ++j) {
      const Eigen::Vector3f* row = &nodes[static_cast<std::size_t>(cell_y + j) * nodes_x + cell_x];
      sum += wy[j] * (wx[0] * row[0] + wx[1] * row[1] + wx[2] * row[2] + wx[3] * row[3]);
    }
    return sum;
  }

  float depth(const Eigen::Vector3f& ray) const { return axis_z.dot(ray); }

  /// phi [1 / kPhiUnits rad] and theta [rad].
  std::pair<float, float> coordinates(const Eigen::Vector3f& ray) const {
    const float radius = std::sqrt(ray.y() * ray.y() + ray.z() * ray.z());
    const float angle = smoothAtan2(ray.z(), ray.y());
    return {(angle + static_cast<float>(kPi)) * static_cast<float>(kPhiUnits),
            smoothAtan2(radius, ray.x())};
  }
};

/// All, none or some of the mask's pixels under a cell.
int maskOf(const cv::Mat& mask, const cv::Rect& pixels, int scale) {
  if (mask.empty()) return 1;
  bool some = false, all = true;
  for (int y = pixels.y; y < pixels.br().y; ++y) {
    for (int x = pixels.x; x < pixels.br().x; ++x) {
      const cv::Rect under(x * scale, y * scale, scale, scale);
      const bool seen = cv::countNonZero(mask(under & cv::Rect(cv::Point(), mask.size()))) > 0;
      some = some || seen;
      all = all && seen;
    }
  }
  return all ? 1 : some ? 0 : -1;
}

}  // namespace

ReferenceMap makeReferenceMap(const WideLens& lens, cv::Size full_size, int level,
                              const EpipolarFrame& frame, const cv::Mat& mask, int threads) {
  constexpr int kCell = ReferenceMap::kCell;
  const int scale = 1 << level;
  ReferenceMap map;
  map.size =
      cv::Size((full_size.width + scale - 1) / scale, (full_size.height + scale - 1) / scale);
  map.cells = cv::Size((map.size.width + kCell - 1) / kCell, (map.size.height + kCell - 1) / kCell);
  const int nodes_x = map.cells.width + 3, nodes_y = map.cells.height + 3;
  RayNodes rays{lens, frame, scale, nodes_x, frame.basis.col(2).cast<float>()};
  rays.nodes.resize(static_cast<std::size_t>(nodes_x) * nodes_y);
  map.node_phi.assign(rays.nodes.size() + 64, kNaN);
  map.node_a.assign(rays.nodes.size() + 64, kNaN);
  parallelFor(0, nodes_y, threads, [&](std::size_t j) {
    for (int i = 0; i < nodes_x; ++i) {
      const std::size_t n = j * nodes_x + i;
      const auto ray = rays.lensRay((i - 1) * kCell, (static_cast<int>(j) - 1) * kCell);
      rays.nodes[n] = ray ? Eigen::Vector3f(ray->cast<float>()) : Eigen::Vector3f::Constant(kNaN);
      if (ray) std::tie(map.node_phi[n], map.node_a[n]) = rays.coordinates(rays.nodes[n]);
    }
  });

  std::array<std::array<float, 4>, kCell> weights;
  for (int i = 0; i < kCell; ++i) weights[i] = cubicWeights(i / double(kCell));
  const float cos_max = static_cast<float>(lens.cos_max_theta);
  const auto pixelsOf = [&](int i, int j) {
    return cv::Rect(i * kCell, j * kCell, kCell, kCell) & cv::Rect(cv::Point(), map.size);
  };
  map.exact.assign(map.cells.area(), 0);
  parallelFor(0, map.cells.height, threads, [&](std::size_t row) {
    const int j = static_cast<int>(row);
    for (int i = 0; i < map.cells.width; ++i) {
      std::int32_t& kind = map.exact[row * map.cells.width + i];
      const int masked = maskOf(mask, pixelsOf(i, j), scale);
      int deep = 0, seen = 0;
      bool finite = true;
      for (int k = 0; k < 16; ++k) {
        const Eigen::Vector3f& node =
            rays.nodes[static_cast<std::size_t>(j + k / 4) * nodes_x + i + k % 4];
        finite = finite && node.allFinite();
        seen += rays.depth(node) >= cos_max;  // false for NaN
        const bool corner = (k / 4 == 1 || k / 4 == 2) && (k % 4 == 1 || k % 4 == 2);
        deep += corner && rays.depth(node) >= cos_max + 1e-4f;
      }
      // A field that hides between the corners is a small one.
      if (masked < 0 || (seen == 0 && map.cells.area() > 64)) {
        kind = ReferenceMap::kNothing;
        continue;
      }
      if (!finite || deep < 4 || masked == 0) continue;
      bool smooth = true;
      for (const auto& [u, v] : {std::pair(8, 8), std::pair(4, 8), std::pair(12, 8),
                                 std::pair(8, 4), std::pair(8, 12)}) {
        const float *wx = weights[u].data(), *wy = weights[v].data();
        const Eigen::Vector3f ray = rays.between(i, j, wx, wy);
        const auto [phi, a] = rays.coordinates(ray);
        float phi_between = 0, a_between = 0;
        for (int k = 0; k < 16; ++k) {
          const std::size_t n = static_cast<std::size_t>(j + k / 4) * nodes_x + i + k % 4;
          phi_between += wy[k / 4] * wx[k % 4] * map.node_phi[n];
          a_between += wy[k / 4] * wx[k % 4] * map.node_a[n];
        }
        // Both as angles between rays.
        const float enough = 2e-5f * static_cast<float>(scale);
        const float sine = std::sqrt(ray.y() * ray.y() + ray.z() * ray.z()) / ray.norm();
        smooth = smooth && std::fabs(a - a_between) < enough &&
                 std::fabs(phi - phi_between) * sine < enough * static_cast<float>(kPhiUnits);
      }
      if (smooth) kind = ReferenceMap::kInterpolated;
    }
  });
  std::int32_t count = 0;
  std::vector<std::int32_t> cells;
  for (std::int32_t cell = 0; cell < map.cells.area(); ++cell) {
    if (map.exact[cell] == 0) {
      map.exact[cell] = count++;
      cells.push_back(cell);
    } else if (map.exact[cell] == ReferenceMap::kInterpolated) {
      map.field += pixelsOf(cell % map.cells.width, cell / map.cells.width).area();
    }
  }
  map.exact_phi.assign(static_cast<std::size_t>(count) * kCell * kCell, kNoRay);
  map.exact_a.assign(map.exact_phi.size(), 0.0f);
  parallelFor(0, cells.size(), threads, [&](std::size_t c) {
    const int i = cells[c] % map.cells.width, j = cells[c] / map.cells.width;
    const cv::Rect pixels = pixelsOf(i, j);
    for (int y = 0; y < pixels.height; ++y) {
      for (int x = 0; x < pixels.width; ++x) {
        const cv::Rect pixel(pixels.x + x, pixels.y + y, 1, 1);
        if (maskOf(mask, pixel, scale) < 0) continue;
        Eigen::Vector3f ray = rays.between(i, j, weights[x].data(), weights[y].data());
        if (!ray.allFinite()) {
          // Beyond what the lens can be widened to; ask it pixel by pixel.
          const auto exact = rays.lensRay(pixel.x, pixel.y);
          if (!exact) continue;
          ray = exact->cast<float>();
        }
        if (!(rays.depth(ray) >= cos_max)) continue;
        const std::size_t n = c * kCell * kCell + y * kCell + x;
        const auto [phi, a] = rays.coordinates(ray);
        map.exact_phi[n] = static_cast<std::uint16_t>(std::lround(phi));
        map.exact_a[n] = a;
      }
    }
  });
  map.field +=
      map.exact_phi.size() - std::count(map.exact_phi.begin(), map.exact_phi.end(), kNoRay);
  return map;
}

void viewMap(const ReferenceMap& map, const cv::Rect& rect, MapView* view) {
  constexpr int kCell = ReferenceMap::kCell;
  const int first = std::max(rect.x, 0) / kCell;
  const int last = (std::min(rect.br().x, map.size.width) - 1) / kCell;
  view->size = map.size;
  view->rect = rect;
  view->left = std::min(first * kCell, rect.x);
  view->stride = std::max((last + 1) * kCell, rect.br().x) - view->left + kCell;
  const std::size_t room = static_cast<std::size_t>(view->stride) * rect.height + kCell;
  if (view->phi.size() < room) {
    view->phi.resize(room);
    view->a.resize(room);
  }
  MapCellsJob job;
  job.node_stride = map.cells.width + 3;
  job.cells = last - first + 1;
  const int from = first * kCell - view->left;
  for (int y = rect.y; y < rect.br().y; ++y) {
    const int v = std::clamp(y, 0, map.size.height - 1);
    const int j = v / kCell;
    const std::size_t row = static_cast<std::size_t>(y - rect.y) * view->stride;
    std::uint16_t* phi = &view->phi[row];
    float* a = &view->a[row];
    const std::size_t node = static_cast<std::size_t>(j) * job.node_stride + first;
    job.node_phi = &map.node_phi[node];
    job.node_a = &map.node_a[node];
    job.row = v % kCell;
    job.phi = phi + from;
    job.a = a + from;
    mapCells(job);
    for (int i = first; i <= last; ++i) {
      const std::int32_t kind = map.exact[static_cast<std::size_t>(j) * map.cells.width + i];
      if (kind == ReferenceMap::kInterpolated) continue;
      const int x = from + (i - first) * kCell;
      if (kind == ReferenceMap::kNothing) {
        std::fill_n(phi + x, kCell, kNoRay);
        std::fill_n(a + x, kCell, 0.0f);
      } else {
        const std::size_t n = (static_cast<std::size_t>(kind) * kCell + job.row) * kCell;
        std::copy_n(&map.exact_phi[n], kCell, phi + x);
        std::copy_n(&map.exact_a[n], kCell, a + x);
      }
    }
    for (int x = view->left; x < 0; ++x) {
      phi[x - view->left] = phi[-view->left];
      a[x - view->left] = a[-view->left];
    }
    const int end = map.size.width - view->left;
    for (int x = end; x < view->stride; ++x) {
      phi[x] = phi[end - 1];
      a[x] = a[end - 1];
    }
  }
}

void hypothesisRange(const HypothesisLimits& limits, double theta, double* least, double* most) {
  const double b = limits.baseline, sine = std::max(std::sin(theta), 1e-6);
  const auto at = [&](double range) {
    return std::atan2(range * sine, range * std::cos(theta) - b) - theta;
  };
  *least = limits.max_range > 0 ? at(limits.max_range) : 0.0;
  *most = limits.min_range > 0 ? at(limits.min_range) : std::atan(0.25);
  *most = std::min(*most, kPi - theta);
  *most = std::max(*most, *least);
}

bool localFrame(const MapView& view, int x, int y, Eigen::Vector2f* d_phi, Eigen::Vector2f* d_a) {
  constexpr int kReach = 4;
  const auto at = [&](int u, int v, float* phi, float* a) {
    const cv::Point p(u, v);
    if (!view.rect.contains(p) || !cv::Rect(cv::Point(), view.size).contains(p)) return false;
    const std::size_t i = view.at(u, v);
    *phi = view.phi[i];
    *a = view.a[i];
    return view.phi[i] != kNoRay;
  };
  // Derivative along (dx, dy): central where both neighbours have rays, else to one side.
  const auto derivative = [&](int dx, int dy, float* phi, float* a) {
    float phi0 = 0, a0 = 0, phi1 = 0, a1 = 0;
    for (const auto& ends : {std::pair(-kReach, kReach), std::pair(0, kReach),
                             std::pair(-kReach, 0), std::pair(0, 1), std::pair(-1, 0)}) {
      if (!at(x + ends.first * dx, y + ends.first * dy, &phi0, &a0)) continue;
      if (!at(x + ends.second * dx, y + ends.second * dy, &phi1, &a1)) continue;
      float step = phi1 - phi0;
      if (step > 32767) step -= 65534;
      if (step < -32767) step += 65534;
      *phi = step / static_cast<float>(kPhiUnits) / (ends.second - ends.first);
      *a = (a1 - a0) / (ends.second - ends.first);
      return true;
    }
    return false;
  };
  float phi_x, a_x, phi_y, a_y;
  if (!derivative(1, 0, &phi_x, &a_x) || !derivative(0, 1, &phi_y, &a_y)) return false;
  const float determinant = phi_x * a_y - phi_y * a_x;
  if (!(std::fabs(determinant) > 1e-12f)) return false;
  *d_phi = Eigen::Vector2f(a_y, -a_x) / determinant;
  *d_a = Eigen::Vector2f(-phi_y, phi_x) / determinant;
  return d_phi->allFinite() && d_a->allFinite();
}

Layout makeLayout(const ReferenceMap& map, const HypothesisLimits& limits, cv::Size tile_size) {
  Layout layout;
  MapView view;
  struct Scale {
    double phi = 0, a = 0;  ///< pixels per radian of phi and per unit of a
    bool left = false;      ///< theta below 90 degrees
  };
  std::vector<Scale> scales;
  std::vector<double> all_phi, all_a;
  layout.tiles_x = (map.size.width + tile_size.width - 1) / tile_size.width;
  for (int y = 0; y < map.size.height; y += tile_size.height) {
    for (int x = 0; x < map.size.width; x += tile_size.width) {
      Tile tile;
      tile.rect = cv::Rect(x, y, std::min(tile_size.width, map.size.width - x),
                           std::min(tile_size.height, map.size.height - y));
      viewMap(map,
              tile.rect + cv::Size(2 * kViewHalo, 2 * kViewHalo) - cv::Point(kViewHalo, kViewHalo),
              &view);
      Scale scale;
      std::vector<double> phi, a;
      for (int v = tile.rect.y; v < tile.rect.br().y; v += 6) {
        for (int u = tile.rect.x; u < tile.rect.br().x; u += 6) {
          Eigen::Vector2f d_phi, d_a;
          if (view.phi[view.at(u, v)] == kNoRay) continue;
          if (!localFrame(view, u, v, &d_phi, &d_a)) continue;
          phi.push_back(d_phi.norm());
          a.push_back(d_a.norm());
        }
      }
      float a_min = std::numeric_limits<float>::max(), a_max = -a_min;
      std::uint16_t phi_min = kNoRay, phi_max = 0;
      for (int v = tile.rect.y; v < tile.rect.br().y; ++v) {
        const std::size_t row = view.at(tile.rect.x, v);
        // Without branches.
        for (int u = 0; u < tile.rect.width; ++u) {
          const std::uint16_t phi = view.phi[row + u];
          const float a = view.a[row + u];
          const bool seen = phi != kNoRay;
          const float low = seen ? a : a_min, high = seen ? a : a_max;
          a_min = low < a_min ? low : a_min;
          a_max = high > a_max ? high : a_max;
          phi_min = std::min(phi_min, phi);
          phi_max = std::max(phi_max, seen ? phi : phi_max);
        }
      }
      if (!phi.empty() && a_min <= a_max) {
        const auto middle = [](std::vector<double>& v) {
          std::nth_element(v.begin(), v.begin() + v.size() / 2, v.end());
          return v[v.size() / 2];
        };
        scale.phi = middle(phi);
        scale.a = middle(a);
        tile.a_min = a_min;
        tile.a_max = a_max;
        tile.phi_min = phi_min;
        tile.phi_max = phi_max;
        const double theta_min = a_min, theta_max = a_max;
        scale.left = theta_min + theta_max < kPi;
        double h_min = std::numeric_limits<double>::max(), h_max = 0;
        for (int i = 0; i <= 4; ++i) {
          double least, most;
          hypothesisRange(limits, theta_min + (theta_max - theta_min) * i / 4, &least, &most);
          h_min = std::min(h_min, least);
          h_max = std::max(h_max, most);
        }
        tile.h_min = static_cast<float>(h_min);
        tile.h_max = static_cast<float>(h_max);
        tile.band = 0;
        all_phi.push_back(scale.phi);
        all_a.push_back(scale.a);
      }
      layout.tiles.push_back(tile);
      scales.push_back(scale);
    }
  }
  if (all_phi.empty()) return layout;
  std::sort(all_phi.begin(), all_phi.end());
  std::sort(all_a.begin(), all_a.end());
  // A row is 0.7 to 1.4 pixels everywhere; a column one pixel where most pixels are.
  const double phi_reference = all_phi.back(), a_reference = all_a[all_a.size() * 6 / 10];
  std::map<std::tuple<int, int, bool>, int> keys;
  for (std::size_t i = 0; i < layout.tiles.size(); ++i) {
    Tile& tile = layout.tiles[i];
    if (tile.band < 0) continue;
    const int p =
        std::clamp<int>(std::lround(std::log2(phi_reference / scales[i].phi) - 0.4), 0, 8);
    const int q = std::clamp<int>(std::lround(std::log2(a_reference / scales[i].a)), -4, 8);
    const auto key = std::tuple(p, q, (p > 0 || q != 0) && scales[i].left);
    const auto [found, fresh] = keys.try_emplace(key, static_cast<int>(layout.bands.size()));
    if (fresh) {
      Band band;
      band.step_phi = std::exp2(p) / phi_reference;
      band.step_h = std::exp2(q) / a_reference;
      layout.bands.push_back(band);
    }
    tile.band = found->second;
  }
  if (limits.hypotheses > 0) {
    std::vector<double> columns(layout.bands.size(), 0.0);
    for (const Tile& tile : layout.tiles) {
      if (tile.band < 0) continue;
      columns[tile.band] = std::max<double>(
          columns[tile.band], (tile.h_max - tile.h_min) / layout.bands[tile.band].step_h);
    }
    for (std::size_t i = 0; i < columns.size(); ++i)
      layout.bands[i].step_h *= std::max(1.0, columns[i] / limits.hypotheses);
  }
  return layout;
}

Grid makeGrid(Layout* layout, const ReferenceMap& map, const EpipolarFrame& frame,
              const WideLens& lens, cv::Size full_size, int level,
              const Eigen::Matrix3d& R_ref_disp, int halo, int threads) {
  Grid grid;
  grid.bands = layout->bands;
  const int scale = 1 << level;
  const int width = (full_size.width + scale - 1) / scale;
  const int height = (full_size.height + scale - 1) / scale;
  constexpr int kSample = 4;   // pixels between those that are asked where they fall
  constexpr int kMargin = 10;  // rows and columns kept around them

  // Rows and columns that the tiles can reach.
  struct Reach {
    int band, row, first, last;
  };
  std::vector<Reach> reaches;
  std::vector<std::pair<int, int>> row_range(
      grid.bands.size(), {std::numeric_limits<int>::max(), std::numeric_limits<int>::min()});
  MapView view;
  // Rounding by a cast, which is not a call.
  const auto floorOf = [](double x) {
    const int whole = static_cast<int>(x);
    return whole - (x < whole ? 1 : 0);
  };
  for (const Tile& tile : layout->tiles) {
    if (tile.band < 0) continue;
    const Band& band = grid.bands[tile.band];
    const double to_row = 1.0 / (kPhiUnits * band.step_phi), row0 = -kPi / band.step_phi;
    const double to_column = 1.0 / band.step_h;
    const double least = tile.h_min / band.step_h, most = tile.h_max / band.step_h;
    auto& [first_row, last_row] = row_range[tile.band];
    const cv::Rect rect = tile.rect;
    for (int v = rect.y - halo;; v = std::min(v + kSample, rect.br().y + halo - 1)) {
      const int y = std::clamp(v, 0, map.size.height - 1);
      viewMap(map, cv::Rect(rect.x - halo, y, rect.width + 2 * halo, 1), &view);
      for (int u = rect.x - halo;; u = std::min(u + kSample, rect.br().x + halo - 1)) {
        const int x = std::clamp(u, 0, map.size.width - 1);
        const std::size_t i = view.at(x, y);
        if (view.phi[i] != kNoRay) {
          const int row = floorOf(view.phi[i] * to_row + row0 + 0.5);
          const double column = view.a[i] * to_column;
          first_row = std::min(first_row, row);
          last_row = std::max(last_row, row);
          reaches.push_back({tile.band, row, floorOf(column + least), floorOf(column + most) + 1});
        }
        if (u == rect.br().x + halo - 1) break;
      }
      if (v == rect.br().y + halo - 1) break;
    }
  }
  std::vector<std::vector<std::pair<int, int>>> spans(grid.bands.size());
  for (std::size_t b = 0; b < grid.bands.size(); ++b) {
    Band& band = grid.bands[b];
    if (row_range[b].first > row_range[b].second) continue;
    band.rows = row_range[b].second - row_range[b].first + 1 + 2 * kMargin;
    const int row0 = row_range[b].first - kMargin;
    band.row_scale = 1.0 / (kPhiUnits * band.step_phi);
    band.row_offset = -kPi / band.step_phi - row0;
    spans[b].assign(band.rows, {std::numeric_limits<int>::max(), std::numeric_limits<int>::min()});
  }
  for (const Reach& reach : reaches) {
    auto& span = spans[reach.band][reach.row - (row_range[reach.band].first - kMargin)];
    span.first = std::min(span.first, reach.first);
    span.second = std::max(span.second, reach.last);
  }
  reaches = {};

  std::int64_t cells = 0, nodes = 0;
  for (std::size_t b = 0; b < grid.bands.size(); ++b) {
    Band& band = grid.bands[b];
    band.begin.assign(band.rows, 0);
    band.runs.assign(band.rows, 0);
    band.origin.assign(band.rows, 0);
    band.node.assign(band.rows, 0);
    for (int r = 0; r < band.rows; ++r) {
      int lo = std::numeric_limits<int>::max(), hi = std::numeric_limits<int>::min();
      for (int s = std::max(0, r - kMargin); s <= std::min(band.rows - 1, r + kMargin); ++s) {
        lo = std::min(lo, spans[b][s].first);
        hi = std::max(hi, spans[b][s].second);
      }
      if (lo > hi) continue;
      lo -= kMargin;
      hi += kMargin;
      // Runs start at multiples of eight columns, so that neighbouring rows' runs align.
      band.begin[r] = (lo >= 0 ? lo / kRun : -((-lo + kRun - 1) / kRun)) * kRun;
      band.runs[r] = (hi - band.begin[r] + kRun) / kRun;
      band.origin[r] = static_cast<std::int32_t>(cells - band.begin[r]);
      band.node[r] = static_cast<std::int32_t>(nodes);
      cells += static_cast<std::int64_t>(band.runs[r]) * kRun;
      nodes += band.runs[r] + 1;
      if (cells > (std::int64_t{1} << 29))
        throw Error(
            "the sweep needs more than 2^29 cells: raise the least range, or lower the hypotheses");
    }
  }
  grid.cells = static_cast<std::int32_t>(cells);
  grid.x.assign(nodes, kNaN);
  grid.y.assign(nodes, kNaN);
  grid.mask.assign((cells + kCellSlack) / kRun, 0);

  // Where the ray (phi, a) falls in the displaced image, and how deep inside its field it is.
  const Eigen::Matrix3d turned =
      R_ref_disp.transpose() * frame.basis.transpose();  // columns e, m, n
  const auto rayOf = [&](const Band& band, double row, double column) {
    const double phi = (row - band.row_offset) * band.step_phi - kPi;
    const double theta = column * band.step_h;
    return Eigen::Vector3d(turned * Eigen::Vector3d(std::cos(theta),
                                                    std::sin(theta) * std::cos(phi),
                                                    std::sin(theta) * std::sin(phi)));
  };
  const auto legal = [&](const Band& band, double column) {
    const double theta = column * band.step_h;
    return theta >= -0.05 && theta <= kPi + 0.05;
  };
  const auto project = [&](const Band& band, double row, double column) {
    Eigen::Vector2f pixel = Eigen::Vector2f::Constant(kNaN);
    if (legal(band, column)) {
      if (const auto p = lens.lens->project(rayOf(band, row, column)))
        pixel = (((p->array() + 0.5) / scale) - 0.5).matrix().cast<float>();
    }
    return pixel;
  };

  for (Band& band : grid.bands) {
    int lo = std::numeric_limits<int>::max(), hi = std::numeric_limits<int>::min();
    for (int r = 0; r < band.rows; ++r) {
      if (band.runs[r] == 0) continue;
      lo = std::min(lo, band.begin[r]);
      hi = std::max(hi, band.begin[r] + band.runs[r] * kRun);
    }
    if (lo > hi) continue;
    const int lattice_begin = (lo >= 0 ? lo / kNodeStep : -((-lo + kNodeStep - 1) / kNodeStep)) - 1;
    const int lattice_x = hi / kNodeStep - lattice_begin + 4;
    const int lattice_y = band.rows / kNodeStep + 4;
    std::vector<Eigen::Vector2f> lattice(static_cast<std::size_t>(lattice_x) * lattice_y,
                                         Eigen::Vector2f::Constant(kNaN));
    parallelFor(0, lattice_y, threads, [&](std::size_t j) {
      const int row = (static_cast<int>(j) - 1) * kNodeStep;
      int from = std::numeric_limits<int>::max(), to = std::numeric_limits<int>::min();
      for (int r = std::max(0, row - 2 * kNodeStep);
           r < std::min(band.rows, row + 2 * kNodeStep + 1); ++r) {
        if (band.runs[r] == 0) continue;
        from = std::min(from, band.begin[r]);
        to = std::max(to, band.begin[r] + band.runs[r] * kRun);
      }
      for (int i = 0; i < lattice_x; ++i) {
        const int column = (lattice_begin + i) * kNodeStep;
        if (column < from - 2 * kNodeStep || column > to + 2 * kNodeStep) continue;
        lattice[j * lattice_x + i] = project(band, row, column);
      }
    });
    std::vector<std::pair<double, double>> circle(hi - lo + 1);
    for (int column = lo; column <= hi; ++column) {
      const double theta = column * band.step_h;
      circle[column - lo] = {std::cos(theta), std::sin(theta)};
    }
    parallelFor(0, band.rows, threads, [&](std::size_t r) {
      if (band.runs[r] == 0) return;
      const int row = static_cast<int>(r);
      const auto wy = cubicWeights((row % kNodeStep) / double(kNodeStep));
      const Eigen::Vector2f* base = &lattice[static_cast<std::size_t>(row / kNodeStep) * lattice_x];
      const auto atLattice = [&](int i) {
        return Eigen::Vector2f(wy[0] * base[i] + wy[1] * base[lattice_x + i] +
                               wy[2] * base[2 * lattice_x + i] + wy[3] * base[3 * lattice_x + i]);
      };
      float* x = &grid.x[band.node[r]];
      float* y = &grid.y[band.node[r]];
      for (int n = 0; n <= band.runs[r]; ++n) {
        const int column = band.begin[r] + n * kRun;
        const int i = (column - (lattice_begin * kNodeStep)) / kNodeStep;
        Eigen::Vector2f pixel;
        if ((column & (kNodeStep - 1)) == 0) {
          pixel = atLattice(i);
        } else {
          pixel = 0.5625f * (atLattice(i) + atLattice(i + 1)) -
                  0.0625f * (atLattice(i - 1) + atLattice(i + 2));
        }
        if (!pixel.allFinite()) pixel = project(band, row, column);
        x[n] = pixel.x();
        y[n] = pixel.y();
      }
      std::uint8_t* mask = &grid.mask[(band.origin[r] + band.begin[r]) / kRun];
      const auto insideImage = [&](float u, float v, float margin) {
        return u >= margin - 0.49f && v >= margin - 0.49f && u <= width - 0.51f - margin &&
               v <= height - 0.51f - margin;
      };
      // Depth along the optical axis is linear in the cosine and the sine of theta.
      const double phi = (row - band.row_offset) * band.step_phi - kPi;
      const double along = turned(2, 0);
      const double across = turned(2, 1) * std::cos(phi) + turned(2, 2) * std::sin(phi);
      const auto depth = [&](int column) {
        if (!legal(band, column)) return -2.0;
        const auto& [cosine, sine] = circle[column - lo];
        return along * cosine + across * sine - lens.cos_max_theta;
      };
      double depth0 = depth(band.begin[r]);
      for (int n = 0; n < band.runs[r]; ++n) {
        const int column = band.begin[r] + n * kRun;
        const double depth1 = depth(column + kRun);
        if (std::isfinite(x[n]) && std::isfinite(x[n + 1]) && insideImage(x[n], y[n], 1.0f) &&
            insideImage(x[n + 1], y[n + 1], 1.0f) && depth0 > 0.01 && depth1 > 0.01) {
          mask[n] = 0xFF;
        } else if (std::isfinite(x[n]) && std::isfinite(x[n + 1]) && depth0 > 0.01 &&
                   depth1 > 0.01) {
          // Well inside the field: the cells lie where they will be sampled.
          std::uint8_t bits = 0;
          for (int i = 0; i < kRun; ++i) {
            const float t = static_cast<float>(i) / kRun;
            if (insideImage(x[n] + t * (x[n + 1] - x[n]), y[n] + t * (y[n + 1] - y[n]), 0.0f))
              bits |= static_cast<std::uint8_t>(1u << i);
          }
          mask[n] = bits;
        } else if (depth0 < -0.1 && depth1 < -0.1) {
          mask[n] = 0;
        } else {
          std::uint8_t bits = 0;
          Eigen::Vector2f first, last;
          int first_cell = -1, last_cell = -1;
          for (int i = 0; i < kRun; ++i) {
            if (depth(column + i) < 0) continue;
            const Eigen::Vector2f p = project(band, row, column + i);
            if (!p.allFinite() || !insideImage(p.x(), p.y(), 0.0f)) continue;
            bits |= static_cast<std::uint8_t>(1u << i);
            if (first_cell < 0) first = p, first_cell = i;
            last = p, last_cell = i;
          }
          // A node outside the lens: the run's line is carried on from the cells inside.
          if (bits && (!std::isfinite(x[n]) || !std::isfinite(x[n + 1]))) {
            if (last_cell > first_cell) {
              const Eigen::Vector2f slope = (last - first) / float(last_cell - first_cell);
              if (!std::isfinite(x[n])) {
                x[n] = first.x() - slope.x() * first_cell;
                y[n] = first.y() - slope.y() * first_cell;
              }
              if (!std::isfinite(x[n + 1])) {
                x[n + 1] = last.x() + slope.x() * (kRun - last_cell);
                y[n + 1] = last.y() + slope.y() * (kRun - last_cell);
              }
            } else {
              bits = 0;
            }
          }
          mask[n] = bits;
        }
        depth0 = depth1;
      }
    });
  }
  // Most tiles see nothing but image, and need not ask.
  parallelFor(0, layout->tiles.size(), threads, [&](std::size_t t) {
    Tile& tile = layout->tiles[t];
    if (tile.band < 0) return;
    const Band& band = grid.bands[tile.band];
    const auto rowOf = [&](std::uint16_t phi) {
      return static_cast<int>(std::lround(phi * band.row_scale + band.row_offset));
    };
    const int first_row = rowOf(tile.phi_min), last_row = rowOf(tile.phi_max);
    const double lowest = tile.a_min / band.step_h + tile.h_min / band.step_h - 2;
    const double highest = tile.a_max / band.step_h + tile.h_max / band.step_h + 2;
    bool clear = first_row >= 0 && last_row < band.rows;
    for (int r = first_row; clear && r <= last_row; ++r) {
      const int from = static_cast<int>(std::floor(lowest)) - band.begin[r];
      const int to = static_cast<int>(std::ceil(highest)) - band.begin[r];
      clear = from >= 0 && to < band.runs[r] * kRun;
      const std::uint8_t* mask = &grid.mask[(band.origin[r] + band.begin[r]) / kRun];
      for (int n = from / kRun; clear && n <= to / kRun; ++n) clear = mask[n] == 0xFF;
    }
    tile.clear = clear;
  });
  return grid;
}

}  // namespace omnister::sweep
