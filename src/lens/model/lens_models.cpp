// SPDX-License-Identifier: Apache-2.0
#include "omnister/lens/lens_models.h"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <type_traits>

#include "lens/model/surfaces.h"
#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_fit.h"

namespace omnister {
namespace {

using detail::AsphereProfile;
using detail::ConicProfile;
using detail::QuadricSurface;
using detail::RadialSurface;
using detail::SphericalProfile;
using detail::SplineProfile;

constexpr double kPi = 3.14159265358979323846;
// A field reaches at most this far: the ray straight back has no azimuth.
constexpr double kLargestField = kPi - 1e-3;
constexpr double kMaxCenter = 1e7;  // [px]
constexpr int kLeastGrid = 4;
constexpr int kLargestGrid = 12;
// The grid reaches a little beyond the field that is asked for.
constexpr double kGridMargin = 1.06;
// A ray at exactly maxTheta() is inside whatever its rounding.
constexpr double kCosSlack = 1e-12;
constexpr double kFieldSlack = 1e-8;  // [rad]

// With m = tan(theta / 2) e and a = theta e, e being the azimuth, decentring turns the angle vector
// a into a + (1 + |m|^2) T(m), T being Brown's tangential terms and 1 + |m|^2 = 2 |dm/da|. Radii of
// wide lenses are about proportional to theta, so that this is a shift on the sensor that gathers
// at the rim: measured on real lenses past 90 degrees, T(m) alone leaves a tenth more error.
//
// With e = (d2, d1) and T's two parts growing apart as d3 and d4 say, the shift is
//     2 (m . e) m (1 + (1 + d3) |m|^2) + |m|^2 e (1 + (1 + d4) |m|^2)
// which for d3 = d4 = 0 is (1 + |m|^2) T(m) with
//     T(m) = (2 d1 x y + d2 (|m|^2 + 2 x^2), d1 (|m|^2 + 2 y^2) + 2 d2 x y).
struct Decentring {
  Eigen::Vector2d e = Eigen::Vector2d::Zero();
  double d3 = 0.0;
  double d4 = 0.0;

  Eigen::Vector2d shift(const Eigen::Vector2d& m) const {
    const double mm = m.squaredNorm();
    return (2.0 * m.dot(e) * (1.0 + (1.0 + d3) * mm)) * m + (mm * (1.0 + (1.0 + d4) * mm)) * e;
  }
  // d(shift)/dm
  Eigen::Matrix2d jacobian(const Eigen::Vector2d& m) const {
    const double mm = m.squaredNorm();
    const double me = 2.0 * m.dot(e);
    const double k = 1.0 + (1.0 + d3) * mm;
    Eigen::Matrix2d out = (2.0 * k) * m * e.transpose() +
                          (2.0 * me * (1.0 + d3)) * m * m.transpose() +
                          (2.0 + 4.0 * (1.0 + d4) * mm) * e * m.transpose();
    out.diagonal().array() += me * k;
    return out;
  }
  // By d1, d2, d3, d4.
  Eigen::Matrix<double, 2, 4> byParameters(const Eigen::Vector2d& m) const {
    const double mm = m.squaredNorm();
    const double k = 2.0 * (1.0 + (1.0 + d3) * mm);
    const double l = mm * (1.0 + (1.0 + d4) * mm);
    Eigen::Matrix<double, 2, 4> out;
    out.col(0) = k * m.y() * m + l * Eigen::Vector2d::UnitY();
    out.col(1) = k * m.x() * m + l * Eigen::Vector2d::UnitX();
    out.col(2) = (2.0 * m.dot(e) * mm) * m;
    out.col(3) = (mm * mm) * e;
    return out;
  }
  // Bounds over the disc |m| <= radius of the shift [rad], and of its change per radian: below one
  // the shifted angles are one-to-one. |dm/da| <= (1 + |m|^2) / 2.
  struct Bounds {
    double shift;
    double steepness;
  };
  Bounds bounds(double radius) const {
    const double square = radius * radius;
    const double p = e.norm() * radius;
    const double grown3 = std::abs(1.0 + d3) * square;
    const double grown4 = std::abs(1.0 + d4) * square;
    return {p * radius * (3.0 + 2.0 * grown3 + grown4),
            0.5 * (1.0 + square) * p * (6.0 + 8.0 * grown3 + 4.0 * grown4)};
  }
};

// m of a unit direction.
Eigen::Vector2d toPlane(const Eigen::Vector3d& n) { return n.head<2>() / (1.0 + n.z()); }

Jacobian23 toPlaneJacobian(const Eigen::Vector3d& n) {
  const double k = 1.0 / (1.0 + n.z());
  Jacobian23 out;
  out << k, 0.0, -n.x() * k * k, 0.0, k, -n.y() * k * k;
  return out;
}

// The angle vector a of a unit direction, and back.
Eigen::Vector2d toAngles(const Eigen::Vector3d& n) {
  const double s = n.head<2>().norm();
  return (s > 1e-9 ? std::atan2(s, n.z()) / s : 1.0) * n.head<2>();
}

Jacobian23 toAnglesJacobian(const Eigen::Vector3d& n) {
  const double s = n.head<2>().norm();
  const Eigen::Vector2d e = s > 0.0 ? Eigen::Vector2d(n.head<2>() / s) : Eigen::Vector2d(1.0, 0.0);
  const Eigen::Vector2d t(-e.y(), e.x());
  const double k = s > 1e-9 ? std::atan2(s, n.z()) / s : 1.0;
  Jacobian23 out;
  out << n.z() * e * e.transpose() + k * t * t.transpose(), -s * e;
  return out;
}

Eigen::Vector3d fromAngles(const Eigen::Vector2d& a) {
  const double theta = a.norm();
  const double k = theta > 1e-9 ? std::sin(theta) / theta : 1.0;
  return Eigen::Vector3d(k * a.x(), k * a.y(), std::cos(theta));
}

Jacobian32 fromAnglesJacobian(const Eigen::Vector2d& a) {
  const double theta = a.norm();
  const Eigen::Vector2d e = theta > 0.0 ? Eigen::Vector2d(a / theta) : Eigen::Vector2d(1.0, 0.0);
  const Eigen::Vector2d t(-e.y(), e.x());
  const double k = theta > 1e-9 ? std::sin(theta) / theta : 1.0;
  Jacobian32 out;
  out << std::cos(theta) * e * e.transpose() + k * t * t.transpose(),
      -std::sin(theta) * e.transpose();
  return out;
}

// m of an angle vector, and dm/da.
Eigen::Vector2d planeOfAngles(const Eigen::Vector2d& a) {
  const double theta = a.norm();
  return (theta > 1e-9 ? std::tan(0.5 * theta) / theta : 0.5) * a;
}

Eigen::Matrix2d planeOfAnglesJacobian(const Eigen::Vector2d& a) {
  const double theta = a.norm();
  const Eigen::Vector2d e = theta > 0.0 ? Eigen::Vector2d(a / theta) : Eigen::Vector2d(1.0, 0.0);
  const double m = std::tan(0.5 * theta);
  const double k = theta > 1e-9 ? m / theta : 0.5;
  return k * Eigen::Matrix2d::Identity() + (0.5 * (1.0 + m * m) - k) * e * e.transpose();
}

// A smooth shift of the angle vector: uniform cubic B-splines over the square [-span, span]^2, one
// control point (a shift in radians) every 2 span / (n - 3). Outside the square the control points
// go on as zeros, so that the shift fades away.
class BendGrid {
 public:
  BendGrid() = default;
  BendGrid(int side, double span)
      : side_(side), span_(span), cell_(side > 3 ? 2.0 * span / (side - 3) : 1.0) {
    points_.setZero(2, side * side);
  }

  int side() const { return side_; }
  double span() const { return span_; }
  int size() const { return 2 * side_ * side_; }
  const Eigen::Matrix2Xd& points() const { return points_; }
  void set(const double* values) {
    points_ = Eigen::Map<const Eigen::Matrix2Xd>(values, 2, side_ * side_);
  }

  Eigen::Vector2d shift(const Eigen::Vector2d& a, Eigen::Matrix2d* d_a = nullptr) const {
    Eigen::Vector2d out = Eigen::Vector2d::Zero();
    if (d_a != nullptr) d_a->setZero();
    visit(a, [&](int index, double weight, double d_x, double d_y) {
      out += weight * points_.col(index);
      if (d_a == nullptr) return;
      d_a->col(0) += d_x * points_.col(index);
      d_a->col(1) += d_y * points_.col(index);
    });
    return out;
  }

  /// Calls with the index of each control point that matters at `a`, its weight and the slopes of
  /// that.
  template <typename Visitor>
  void visit(const Eigen::Vector2d& a, const Visitor& visitor) const {
    const Axis x = axis(a.x());
    const Axis y = axis(a.y());
    for (int j = 0; j < 4; ++j) {
      if (y.first + j < 0 || y.first + j >= side_) continue;
      for (int i = 0; i < 4; ++i) {
        if (x.first + i < 0 || x.first + i >= side_) continue;
        visitor((y.first + j) * side_ + x.first + i, x.weight[i] * y.weight[j],
                x.slope[i] * y.weight[j], x.weight[i] * y.slope[j]);
      }
    }
  }

  /// Bounds of the shift [rad] and of its change per radian: a spline lies within its control
  /// points, and its slope within their differences.
  Decentring::Bounds bounds() const {
    Decentring::Bounds bounds{0.0, 0.0};
    const auto at = [&](int i, int j) -> Eigen::Vector2d {
      if (i < 0 || j < 0 || i >= side_ || j >= side_) return Eigen::Vector2d::Zero();
      return points_.col(j * side_ + i);
    };
    double across = 0.0;
    double down = 0.0;
    for (int j = 0; j <= side_; ++j) {
      for (int i = 0; i <= side_; ++i) {
        bounds.shift = std::max(bounds.shift, at(i, j).norm());
        across = std::max(across, (at(i, j) - at(i - 1, j)).norm());
        down = std::max(down, (at(i, j) - at(i, j - 1)).norm());
      }
    }
    bounds.steepness = std::hypot(across, down) / cell_;
    return bounds;
  }

 private:
  struct Axis {
    int first;
    std::array<double, 4> weight;
    std::array<double, 4> slope;
  };
  Axis axis(double angle) const {
    const double place = (angle + span_) / cell_;
    const double cell = std::floor(place);
    const double t = place - cell;
    const double u = 1.0 - t;
    Axis out;
    out.first = static_cast<int>(cell);
    out.weight = {u * u * u / 6.0, (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0,
                  (4.0 - 6.0 * u * u + 3.0 * u * u * u) / 6.0, t * t * t / 6.0};
    const double k = 0.5 / cell_;
    out.slope = {-k * u * u, k * t * (3.0 * t - 4.0), k * u * (4.0 - 3.0 * u), k * t * t};
    return out;
  }

  int side_ = 0;
  double span_ = 1.0;
  double cell_ = 1.0;  // [rad]
  Eigen::Matrix2Xd points_;
};

struct Extras {
  bool affinity = false;
  bool turn = false;
  bool decentring = false;
  bool growth = false;
  int grid = 0;
  int bends() const { return decentring ? (growth ? 4 : 2) : 0; }
  int gridSize() const { return 2 * grid * grid; }
  int size() const { return (affinity ? 2 : 0) + (turn ? 1 : 0) + bends() + gridSize(); }
  bool bent() const { return decentring || grid > 0; }
};

template <typename Surface>
class CentralLens final : public LensModel {
 public:
  CentralLens(const Surface& surface, Extras extras, double grid_span = 1.0)
      : surface_(surface), extras_(extras), grid_(extras.grid, grid_span) {}

  std::string_view model() const override { return extras_.grid > 0 ? "spline" : Surface::kModel; }
  double maxTheta() const override { return max_theta_; }
  const Surface& surface() const { return surface_; }
  const Extras& extras() const { return extras_; }
  const BendGrid& grid() const { return grid_; }

  std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& bearing, Jacobian23* d_bearing,
                                         JacobianParams* d_parameters) const override {
    double square = bearing.squaredNorm();
    double scale = 1.0;
    if (!(square > 1e-200 && square < 1e200)) {
      const double largest = bearing.cwiseAbs().maxCoeff();
      if (!(largest > 0.0) || !bearing.allFinite()) return std::nullopt;
      scale = 1.0 / largest;
      if (!std::isfinite(scale)) return std::nullopt;
      square = (bearing * scale).squaredNorm();
    }
    const double inverse = 1.0 / std::sqrt(square);
    const Eigen::Vector3d n = (bearing * scale) * inverse;
    if (!(n.z() >= cos_max_)) return std::nullopt;

    Eigen::Vector2d xy;
    Jacobian23 d_n;
    std::array<double, 2 * kMaxSize> d_surface;
    double* const d_p = d_parameters != nullptr ? d_surface.data() : nullptr;
    if (!extras_.bent()) {
      if (!surface_.project(n, xy, d_bearing != nullptr ? &d_n : nullptr, d_p)) {
        return std::nullopt;
      }
    } else {
      const Eigen::Vector2d m = toPlane(n);
      const Eigen::Vector2d a = toAngles(n);
      Eigen::Vector2d a_bent = a + decentring_.shift(m);
      Eigen::Matrix2d d_grid = Eigen::Matrix2d::Zero();
      if (extras_.grid > 0) a_bent += grid_.shift(a, d_bearing != nullptr ? &d_grid : nullptr);
      const bool need_d_n = d_bearing != nullptr || d_parameters != nullptr;
      if (!surface_.project(fromAngles(a_bent), xy, need_d_n ? &d_n : nullptr, d_p)) {
        return std::nullopt;
      }
      if (need_d_n) {
        const Eigen::Matrix2d d_a = d_n * fromAnglesJacobian(a_bent);
        if (d_parameters != nullptr) {
          d_parameters->resize(2, size());
          const Eigen::Matrix2d d_pixel = linear_ * d_a;
          const int first = size() - extras_.bends() - extras_.gridSize();
          d_parameters->middleCols(first, extras_.bends()) =
              d_pixel * decentring_.byParameters(m).leftCols(extras_.bends());
          if (extras_.grid > 0) {
            const int first_point = size() - extras_.gridSize();
            d_parameters->rightCols(extras_.gridSize()).setZero();
            grid_.visit(a, [&](int index, double weight, double, double) {
              d_parameters->template middleCols<2>(first_point + 2 * index) = weight * d_pixel;
            });
          }
        }
        if (d_bearing != nullptr) {
          Jacobian23 d_bent = decentring_.jacobian(m) * toPlaneJacobian(n);
          d_bent += (Eigen::Matrix2d::Identity() + d_grid) * toAnglesJacobian(n);
          d_n = d_a * d_bent;
          d_n -= (d_n * n) * n.transpose();
        }
      }
    }
    if (d_bearing != nullptr) *d_bearing = linear_ * d_n * (inverse * scale);
    if (d_parameters != nullptr) {
      const int n_surface = surface_.size();
      d_parameters->resize(2, size());
      d_parameters->template leftCols<2>().setIdentity();
      d_parameters->middleCols(2, n_surface) =
          linear_ * Eigen::Map<const Eigen::Matrix2Xd>(d_surface.data(), 2, n_surface);
      if (extras_.affinity) {
        d_parameters->template middleCols<2>(2 + n_surface) << xy.x(), xy.y(), 0.0, 0.0;
      }
      if (extras_.turn) d_parameters->col(4 + n_surface) << 0.0, xy.x();
    }
    return center_ + linear_ * xy;
  }

  std::optional<Eigen::Vector3d> unproject(const Eigen::Vector2d& pixel,
                                           Jacobian32* d_pixel) const override {
    const Eigen::Vector2d xy = inverse_linear_ * (pixel - center_);
    Eigen::Vector3d n;
    Jacobian32 d_xy;
    if (!surface_.unproject(xy, n, d_pixel != nullptr ? &d_xy : nullptr)) return std::nullopt;
    if (extras_.bent()) {
      if (!(1.0 + n.z() > 1e-12)) return std::nullopt;
      const auto a = straighten(toAngles(n));
      if (!a) return std::nullopt;
      if (d_pixel != nullptr) {
        d_xy = fromAnglesJacobian(*a) * bentJacobian(*a).inverse() * toAnglesJacobian(n) * d_xy;
      }
      n = fromAngles(*a);
    }
    if (!(n.z() >= cos_max_)) return std::nullopt;
    if (d_pixel != nullptr) *d_pixel = d_xy * inverse_linear_;
    return n;
  }

  std::optional<double> surfaceHeight(double x, double y) const override {
    Eigen::Vector3d n;
    if (!surface_.unproject({x, y}, n, nullptr) || !(n.z() >= cos_max_)) return std::nullopt;
    return surface_.height({x, y});
  }

  Eigen::VectorXd parameters() const override {
    Eigen::VectorXd out(size());
    out.head<2>() = center_;
    surface_.get(out.data() + 2);
    int i = 2 + surface_.size();
    if (extras_.affinity) {
      out[i++] = p_;  // not from 1 + p, which loses digits of a small p
      out[i++] = linear_(0, 1);
    }
    if (extras_.turn) out[i++] = linear_(1, 0);
    if (extras_.decentring) {
      out[i++] = decentring_.e.y();
      out[i++] = decentring_.e.x();
    }
    if (extras_.growth) {
      out[i++] = decentring_.d3;
      out[i++] = decentring_.d4;
    }
    out.tail(extras_.gridSize()) =
        Eigen::Map<const Eigen::VectorXd>(grid_.points().data(), extras_.gridSize());
    return out;
  }

  std::vector<std::string> parameterNames() const override {
    std::vector<std::string> out{"cx", "cy"};
    for (auto& name : surface_.names()) out.push_back(std::move(name));
    if (extras_.affinity) out.insert(out.end(), {"p", "q"});
    if (extras_.turn) out.push_back("s");
    if (extras_.decentring) out.insert(out.end(), {"d1", "d2"});
    if (extras_.growth) out.insert(out.end(), {"d3", "d4"});
    for (int i = 0; i < extras_.gridSize(); ++i) out.push_back("bend" + std::to_string(i));
    return out;
  }

  LensPtr withParameters(const Eigen::VectorXd& parameters,
                         std::optional<double> max_theta) const override {
    if (parameters.size() != size()) return nullptr;
    double field = max_theta.value_or(max_theta_);
    if (std::is_same_v<Surface, RadialSurface<SphericalProfile>>) {
      field = std::min(field, SphericalProfile::kMaxTheta);
    }
    if (!(field > 0.0) || !(field <= kLargestField) || !parameters.allFinite()) return nullptr;
    if (!(parameters.head<2>().cwiseAbs().maxCoeff() <= kMaxCenter)) return nullptr;

    auto out = std::make_shared<CentralLens>(surface_, extras_, grid_.span());
    out->center_ = parameters.head<2>();
    int i = 2 + surface_.size();
    if (extras_.affinity) {
      out->p_ = parameters[i];
      const double q = parameters[i + 1];
      const double turn = extras_.turn ? parameters[i + 2] : 0.0;
      const double determinant = 1.0 + out->p_ - q * turn;
      if (!(std::abs(out->p_) <= 0.9) || !(std::abs(q) <= 10.0) || !(std::abs(turn) <= 10.0) ||
          !(determinant >= 0.05)) {
        return nullptr;
      }
      out->linear_ << 1.0 + out->p_, q, turn, 1.0;
      out->inverse_linear_ << 1.0, -q, -turn, 1.0 + out->p_;
      out->inverse_linear_ /= determinant;
    }
    double bent_field = field;
    if (extras_.bent()) {
      Decentring::Bounds bounds{0.0, 0.0};
      if (extras_.decentring) {
        const auto d =
            parameters.segment(size() - extras_.gridSize() - extras_.bends(), extras_.bends());
        out->decentring_.e = {d[1], d[0]};
        if (extras_.growth) {
          out->decentring_.d3 = d[2];
          out->decentring_.d4 = d[3];
        }
        bounds = out->decentring_.bounds(std::tan(0.5 * field));
      }
      if (extras_.grid > 0) {
        out->grid_.set(parameters.data() + size() - extras_.gridSize());
        const Decentring::Bounds more = out->grid_.bounds();
        bounds.shift += more.shift;
        bounds.steepness += more.steepness;
      }
      if (!(bounds.steepness < 0.95)) return nullptr;
      bent_field = std::min(field + bounds.shift, kLargestField);
    }
    const auto surface = surface_.with(parameters.data() + 2, bent_field + kFieldSlack);
    if (!surface) return nullptr;
    out->surface_ = *surface;
    out->max_theta_ = field;
    out->cos_max_ = std::cos(field) - kCosSlack;
    return out;
  }

 private:
  static constexpr int kMaxSize = 40;  // of the surface

  int size() const { return 2 + surface_.size() + extras_.size(); }

  // T and the grid's shift.
  Eigen::Vector2d shiftOf(const Eigen::Vector2d& a) const {
    Eigen::Vector2d out = decentring_.shift(planeOfAngles(a));
    if (extras_.grid > 0) out += grid_.shift(a);
    return out;
  }

  // d(a + T)/da
  Eigen::Matrix2d bentJacobian(const Eigen::Vector2d& a) const {
    Eigen::Matrix2d out = Eigen::Matrix2d::Zero();
    if (extras_.grid > 0) grid_.shift(a, &out);
    out += decentring_.jacobian(planeOfAngles(a)) * planeOfAnglesJacobian(a);
    out.diagonal().array() += 1.0;
    return out;
  }

  // The inverse of a + T(m(a)), by Newton with halved steps: within the field the solution is the
  // only one, and outside none is wanted.
  std::optional<Eigen::Vector2d> straighten(const Eigen::Vector2d& bent) const {
    const double border = max_theta_ * (1.0 + 1e-9);
    const auto inside = [&](const Eigen::Vector2d& a) -> Eigen::Vector2d {
      const double length = a.norm();
      return length <= border ? a : Eigen::Vector2d(a * (border / length));
    };
    const auto errorOf = [&](const Eigen::Vector2d& a) -> Eigen::Vector2d {
      return a + shiftOf(a) - bent;
    };
    Eigen::Vector2d a = inside(bent);
    a = inside(bent - shiftOf(a));
    Eigen::Vector2d error = errorOf(a);
    for (int i = 0; i < 50; ++i) {
      const double size = error.norm();
      if (size <= 1e-16 * (1.0 + bent.norm())) return a;
      const Eigen::Vector2d step = bentJacobian(a).inverse() * error;
      double part = 1.0;
      for (;; part *= 0.5) {
        if (part < 1e-3) {
          // No further descent: converged to rounding, or stuck at the border of the field.
          if (size <= 1e-13 * (1.0 + bent.norm())) return a;
          return std::nullopt;
        }
        const Eigen::Vector2d next = inside(a - part * step);
        const Eigen::Vector2d next_error = errorOf(next);
        if (next_error.norm() < size) {
          a = next;
          error = next_error;
          break;
        }
      }
    }
    return std::nullopt;
  }

  Surface surface_;
  Extras extras_;
  BendGrid grid_;
  Eigen::Vector2d center_ = Eigen::Vector2d::Zero();
  Eigen::Matrix2d linear_ = Eigen::Matrix2d::Identity();  // sensor coordinates to pixel
  Eigen::Matrix2d inverse_linear_ = Eigen::Matrix2d::Identity();
  double p_ = 0.0;
  Decentring decentring_;
  double max_theta_ = 0.0;
  double cos_max_ = 1.0;
};

using SphericalLens = CentralLens<RadialSurface<SphericalProfile>>;
using QuadricLens = CentralLens<QuadricSurface>;
using ConicLens = CentralLens<RadialSurface<ConicProfile>>;
using AsphereLens = CentralLens<RadialSurface<AsphereProfile>>;
using SplineLens = CentralLens<RadialSurface<SplineProfile>>;

std::string known() {
  std::string out;
  for (const std::string& name : lensModelNames()) out += (out.empty() ? "" : ", ") + name;
  return out;
}

// A lens of the structure that carries no numbers yet.
LensPtr prototype(const LensStructure& structure, double span) {
  const Extras extras{structure.affinity, structure.turn, structure.decentring,
                      structure.decentring_growth, structure.grid};
  if (structure.grid != 0) {
    if (structure.model != "spline") {
      throw Error("lens model " + printable(structure.model) +
                  " cannot carry a grid of corrections, expected spline");
    }
    if (structure.grid < kLeastGrid || structure.grid > kLargestGrid) {
      throw Error("a grid of " + std::to_string(structure.grid) +
                  " control points a side, expected " + std::to_string(kLeastGrid) + " to " +
                  std::to_string(kLargestGrid));
    }
    if (structure.even_terms < 0 || structure.even_terms > AsphereProfile::kMaxTerms) {
      throw Error("an asphere with " + std::to_string(structure.even_terms) +
                  " even terms, expected 0 to 3");
    }
    return std::make_shared<AsphereLens>(
        RadialSurface<AsphereProfile>(AsphereProfile(structure.even_terms)), extras, span);
  }
  if (structure.turn && !structure.affinity) {
    throw Error("a lens with a turn (s) but no affinity, expected both");
  }
  if (structure.decentring_growth && !structure.decentring) {
    throw Error("a lens with growing decentring (d3, d4) but no decentring, expected both");
  }
  const std::string& model = structure.model;
  if (structure.decentring && model != "asphere" && model != "spline") {
    throw Error("lens model " + printable(model) +
                " cannot carry decentring, expected asphere or spline");
  }
  if (model == "spherical")
    return std::make_shared<SphericalLens>(RadialSurface<SphericalProfile>(), extras);
  if (model == "quadric") return std::make_shared<QuadricLens>(QuadricSurface(), extras);
  if (model == "conic") return std::make_shared<ConicLens>(RadialSurface<ConicProfile>(), extras);
  if (model == "asphere") {
    if (structure.even_terms < 0 || structure.even_terms > AsphereProfile::kMaxTerms) {
      throw Error("an asphere with " + std::to_string(structure.even_terms) +
                  " even terms, expected 0 to 3");
    }
    return std::make_shared<AsphereLens>(
        RadialSurface<AsphereProfile>(AsphereProfile(structure.even_terms)), extras);
  }
  if (model == "spline") {
    if (structure.knots < SplineProfile::kMinKnots || structure.knots > SplineProfile::kMaxKnots) {
      throw Error("a spline with " + std::to_string(structure.knots) + " knots, expected 4 to 32");
    }
    return std::make_shared<SplineLens>(
        RadialSurface<SplineProfile>(SplineProfile(structure.knots, span)), extras);
  }
  throw Error("unknown lens model " + printable(model) + ", expected one of " + known());
}

}  // namespace

const std::vector<std::string>& lensModelNames() {
  static const std::vector<std::string> names{"spherical", "quadric", "conic", "asphere", "spline"};
  return names;
}

LensPtr makeLens(const LensStructure& structure, const Eigen::Vector2d& center, double focal_px,
                 double max_theta) {
  if (!(max_theta > 0.0) || !(max_theta <= kLargestField)) {
    throw Error("a half field of view of " + formatNumber(max_theta) +
                " rad, expected more than 0 and less than pi");
  }
  if (!(focal_px > 0.0) || !std::isfinite(focal_px) || !center.allFinite()) {
    throw Error("a focal length of " + formatNumber(focal_px) + " px about (" +
                formatNumber(center.x()) + ", " + formatNumber(center.y()) +
                "), expected a positive length and finite numbers");
  }
  const LensPtr bare =
      prototype(structure, structure.grid > 0 ? kGridMargin * max_theta : max_theta);
  double field = max_theta;
  if (structure.model == "spherical") field = std::min(field, SphericalProfile::kMaxTheta);

  // Start with a surface that is one-to-one over any field.
  Eigen::VectorXd parameters = Eigen::VectorXd::Zero(bare->parameterNames().size());
  parameters.head<2>() = center;
  int size = 0;
  if (structure.model == "spherical") {
    size = 1;
    parameters[2] = focal_px;
  } else if (structure.model == "quadric") {
    size = 3;
    parameters[2] = focal_px;
    parameters[3] = parameters[4] = 2.0 * std::sqrt(focal_px);
  } else if (structure.model == "spline" && structure.grid == 0) {
    for (int i = 1; i <= structure.knots; ++i) {
      parameters[1 + i] = focal_px * max_theta * i / structure.knots;
    }
  } else {
    size = 3 + (structure.model == "conic" ? 0 : structure.even_terms);
    parameters.segment<3>(2) << focal_px, 0.5, 1.0;
  }
  LensPtr lens = bare->withParameters(parameters, field);
  if (lens == nullptr) {
    throw Error("no " + printable(structure.model) + " lens with a focal length of " +
                formatNumber(focal_px) + " px about (" + formatNumber(center.x()) + ", " +
                formatNumber(center.y()) + ")");
  }
  if (size == 0) return lens;  // the spline is r = f theta already

  std::vector<Eigen::Vector3d> bearings;
  std::vector<Eigen::Vector2d> pixels;
  constexpr int kSamples = 24;
  for (int i = 1; i <= kSamples; ++i) {
    const double theta = field * i / kSamples;
    for (const int axis : {0, 1}) {
      const Eigen::Vector2d e = Eigen::Vector2d::Unit(axis);
      bearings.emplace_back(std::sin(theta) * e.x(), std::sin(theta) * e.y(), std::cos(theta));
      pixels.push_back(center + focal_px * theta * e);
    }
  }
  LensFitOptions options;
  options.first_parameter = 2;
  options.parameters = size;
  options.max_iterations = 50;
  return fitLens(*lens, bearings, pixels, options).lens;
}

LensStructure structureOf(const LensModel& lens) {
  LensStructure out;
  out.model = std::string(lens.model());
  out.affinity = false;
  const auto extras = [&](const Extras& e) {
    out.affinity = e.affinity;
    out.turn = e.turn;
    out.decentring = e.decentring;
    out.decentring_growth = e.growth;
  };
  if (const auto* spherical = dynamic_cast<const SphericalLens*>(&lens)) {
    extras(spherical->extras());
  } else if (const auto* quadric = dynamic_cast<const QuadricLens*>(&lens)) {
    extras(quadric->extras());
  } else if (const auto* conic = dynamic_cast<const ConicLens*>(&lens)) {
    extras(conic->extras());
  } else if (const auto* asphere = dynamic_cast<const AsphereLens*>(&lens)) {
    extras(asphere->extras());
    out.even_terms = asphere->surface().terms();
    out.grid = asphere->extras().grid;
    if (out.grid > 0) out.model = "spline";
  } else if (const auto* spline = dynamic_cast<const SplineLens*>(&lens)) {
    extras(spline->extras());
    out.knots = spline->surface().size();
  }
  return out;
}

NamedParameters namedParameters(const LensModel& lens) {
  NamedParameters out;
  const Eigen::VectorXd values = lens.parameters();
  const std::vector<std::string> names = lens.parameterNames();
  std::size_t i = 2;
  if (const auto* spline = dynamic_cast<const SplineLens*>(&lens)) {
    out.emplace_back("span", std::vector<double>{spline->surface().span()});
    const int n = spline->surface().size();
    out.emplace_back("radii", std::vector<double>(values.data() + 2, values.data() + 2 + n));
    i += n;
  }
  std::size_t end = names.size();
  const auto* bent = dynamic_cast<const AsphereLens*>(&lens);
  if (bent != nullptr) end -= static_cast<std::size_t>(bent->extras().gridSize());
  for (; i < end; ++i) out.emplace_back(names[i], std::vector<double>{values[i]});
  if (end < names.size()) {
    out.emplace_back("bend_span", std::vector<double>{bent->grid().span()});
    out.emplace_back("bend",
                     std::vector<double>(values.data() + end, values.data() + names.size()));
  }
  return out;
}

LensPtr makeLens(std::string_view model, const Eigen::Vector2d& center,
                 const std::map<std::string, std::vector<double>>& parameters, double max_theta,
                 std::string_view source) {
  const std::string place = "lens_surface.parameters";
  LensStructure structure;
  structure.model = std::string(model);
  const auto& models = lensModelNames();
  if (std::find(models.begin(), models.end(), structure.model) == models.end()) {
    throw InputError(source, "lens_surface.model",
                     "is \"" + printable(model) + "\", expected one of " + known());
  }
  const auto given = [&](const char* name) { return parameters.count(name) != 0; };
  structure.turn = given("s");
  structure.affinity = given("p") || given("q") || structure.turn;
  structure.decentring_growth = given("d3") || given("d4");
  structure.decentring = given("d1") || given("d2") || structure.decentring_growth;
  if (structure.decentring && model != "asphere" && model != "spline") {
    throw InputError(
        source, place,
        "give decentring (d1 to d4), but a " + structure.model + " surface has no decentring");
  }
  if (given("a4")) structure.even_terms = 1;
  if (given("a6")) structure.even_terms = 2;
  if (given("a8")) structure.even_terms = 3;
  const bool bent = model == "spline" && (given("bend") || given("bend_span"));
  const auto number = [&](const std::string& name, std::optional<double> fallback) {
    const auto found = parameters.find(name);
    if (found == parameters.end()) {
      if (fallback) return *fallback;
      throw InputError(source, place + "." + name,
                       "is missing, a " + structure.model + " surface needs it");
    }
    if (found->second.size() != 1) {
      throw InputError(
          source, place + "." + name,
          "has " + std::to_string(found->second.size()) + " numbers, expected a single one");
    }
    return found->second[0];
  };
  double span = max_theta;
  std::vector<double> radii;
  std::vector<double> bend;
  if (bent) {
    const auto found = parameters.find("bend");
    if (found == parameters.end()) {
      throw InputError(source, place + ".bend", "is missing, but bend_span is given");
    }
    bend = found->second;
    for (int side = kLeastGrid; side <= kLargestGrid; ++side) {
      if (bend.size() == static_cast<std::size_t>(2 * side * side)) structure.grid = side;
    }
    if (structure.grid == 0) {
      throw InputError(source, place + ".bend",
                       "has " + std::to_string(bend.size()) +
                           " numbers, expected 2 n^2 with n from 4 to 12: a shift in x and y for "
                           "each point of a square grid");
    }
    span = number("bend_span", std::nullopt);
    if (!(span > 0.0) || !(span <= 2.0 * kLargestField)) {
      throw InputError(source, place + ".bend_span",
                       "is " + formatNumber(span) + ", expected radians in (0, 2 pi)");
    }
  } else if (model == "spline") {
    const auto found = parameters.find("radii");
    if (found == parameters.end()) {
      throw InputError(source, place + ".radii", "is missing, a spline surface needs it");
    }
    radii = found->second;
    if (radii.size() < SplineProfile::kMinKnots || radii.size() > SplineProfile::kMaxKnots) {
      throw InputError(source, place + ".radii",
                       "has " + std::to_string(radii.size()) + " numbers, expected 4 to 32");
    }
    structure.knots = static_cast<int>(radii.size());
    span = number("span", std::nullopt);
    if (!(span > 0.0) || !(span <= kLargestField)) {
      throw InputError(source, place + ".span",
                       "is " + formatNumber(span) + ", expected radians in (0, pi)");
    }
  }
  const LensPtr bare = prototype(structure, span);
  const std::vector<std::string> names = bare->parameterNames();
  for (const auto& [name, values] : parameters) {
    const bool list = bent ? name == "bend" || name == "bend_span"
                           : model == "spline" && (name == "radii" || name == "span");
    const bool known_name =
        list || (std::find(names.begin() + 2, names.end(), name) != names.end() &&
                 (model != "spline" || name[0] != (bent ? 'b' : 'r') || name == "beta"));
    if (!known_name) {
      throw InputError(source, place + "." + name,
                       "is no parameter of a " + structure.model + " surface");
    }
    for (const double value : values) {
      if (!std::isfinite(value)) {
        throw InputError(source, place + "." + name,
                         "is " + formatNumber(value) + ", expected a finite number");
      }
    }
  }
  if (!(max_theta > 0.0) || !(max_theta <= kLargestField)) {
    throw InputError(source, "lens_surface.max_theta",
                     "is " + formatNumber(max_theta) + ", expected radians in (0, pi)");
  }
  if (model == "spherical" && max_theta > SphericalProfile::kMaxTheta) {
    throw InputError(source, "lens_surface.max_theta",
                     "is " + formatNumber(max_theta) +
                         ", but a spherical surface ends before pi/2 (at " +
                         formatNumber(SphericalProfile::kMaxTheta) + ")");
  }
  Eigen::VectorXd values(names.size());
  values.head<2>() = center;
  for (std::size_t i = 2; i < names.size(); ++i) {
    if (i - 2 < radii.size()) {
      values[i] = radii[i - 2];
      continue;
    }
    if (i + bend.size() >= names.size()) {
      values[i] = bend[i + bend.size() - names.size()];
      continue;
    }
    const bool neutral = names[i] == "p" || names[i] == "q" || names[i] == "s" ||
                         (names[i].size() == 2 && names[i][0] == 'd');
    values[i] = number(names[i], neutral ? std::optional<double>(0.0) : std::nullopt);
  }
  LensPtr lens = bare->withParameters(values, max_theta);
  if (lens == nullptr) {
    throw InputError(source, place,
                     "give a surface that is not one-to-one (radius rising with the angle, lengths "
                     "positive) over the field of lens_surface.max_theta " +
                         formatNumber(max_theta) + " rad");
  }
  return lens;
}

}  // namespace omnister
