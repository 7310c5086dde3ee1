// SPDX-License-Identifier: Apache-2.0
/// @file The lens surfaces themselves, in sensor coordinates (x, y) [px] about the centre, affinity
/// and decentring already undone. CentralLens (lens_models.cpp) puts those around them.
///
/// A surface S offers
///   static constexpr std::string_view kModel;
///   int size() const;                              number of its parameters
///   std::vector<std::string> names() const;
///   void get(double* parameters) const;
///   std::optional<S> with(const double* parameters, double field) const;
///       the same structure with other numbers; nullopt unless one-to-one over [0, field]
///   bool project(n, xy, d_n, d_parameters) const;  unit direction to sensor; the optional
///   Jacobians are
///       2x3 with d_n * n = 0, and 2 x size() column by column
///   bool unproject(xy, n, d_xy) const;             sensor to unit direction; optional 3x2 Jacobian
///   std::optional<double> height(xy) const;        [px]
///
/// Radial surfaces are a profile P in RadialSurface<P>. With r = |(x, y)| and (s, c) = (sin, cos)
/// of the off-axis angle theta, a profile offers
///   bool radius(s, c, r_over_s, dr_dtheta, dr_dparameters) const;
///   bool angle(r, s_over_r, c, dtheta_dr) const;
/// beside kModel, size, names, get and with.
///
/// For a sag h(r) the ray is (r, h) / N with N^2 = r^2 + h^2, so that r / s = N, and from the
/// implicit equation r c = h s with g = h - r dh/dr (positive where the surface is one-to-one)
///   dr/dtheta = N^2 / g,     dr/dp = r (dh/dp) / g.
#pragma once

#include <Eigen/Core>
#include <array>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "omnister/lens/lens_model.h"

namespace omnister::detail {

/// Least slope |dr/dtheta| (and g) as a part of its value on the axis: below it a pixel or a ray no
/// longer tells one angle from its neighbour, and 1e-9 rad cannot be kept.
inline constexpr double kLeastSlope = 1e-3;

template <typename Profile>
class RadialSurface : public Profile {
 public:
  RadialSurface() = default;
  explicit RadialSurface(Profile profile) : Profile(std::move(profile)) {}

  std::optional<RadialSurface> with(const double* parameters, double field) const {
    auto profile = Profile::with(parameters, field);
    if (!profile) return std::nullopt;
    return RadialSurface(std::move(*profile));
  }

  bool project(const Eigen::Vector3d& n, Eigen::Vector2d& xy, Jacobian23* d_n,
               double* d_parameters) const {
    const double s = std::sqrt(n.x() * n.x() + n.y() * n.y());
    const double c = n.z();
    double r_over_s = 0.0;
    double dr_dtheta = 0.0;
    std::array<double, Profile::kMaxSize> dr_dp;
    if (!Profile::radius(s, c, r_over_s, d_n != nullptr ? &dr_dtheta : nullptr,
                         d_parameters != nullptr ? dr_dp.data() : nullptr)) {
      return false;
    }
    xy = r_over_s * n.head<2>();
    if (d_n == nullptr && d_parameters == nullptr) return true;
    const Eigen::Vector2d e =
        s > 0.0 ? Eigen::Vector2d(n.head<2>() / s) : Eigen::Vector2d(1.0, 0.0);
    if (d_n != nullptr) {
      const Eigen::Vector2d a(-e.y(), e.x());
      d_n->leftCols<2>() = (dr_dtheta * c) * e * e.transpose() + r_over_s * a * a.transpose();
      d_n->col(2) = -(dr_dtheta * s) * e;
    }
    if (d_parameters != nullptr) {
      for (int i = 0; i < this->size(); ++i) {
        d_parameters[2 * i] = dr_dp[i] * e.x();
        d_parameters[2 * i + 1] = dr_dp[i] * e.y();
      }
    }
    return true;
  }

  bool unproject(const Eigen::Vector2d& xy, Eigen::Vector3d& n, Jacobian32* d_xy) const {
    const double r = std::sqrt(xy.x() * xy.x() + xy.y() * xy.y());
    double s_over_r = 0.0;
    double c = 0.0;
    double dtheta_dr = 0.0;
    if (!Profile::angle(r, s_over_r, c, d_xy != nullptr ? &dtheta_dr : nullptr)) return false;
    n << s_over_r * xy, c;
    if (d_xy != nullptr) {
      const Eigen::Vector2d e = r > 0.0 ? Eigen::Vector2d(xy / r) : Eigen::Vector2d(1.0, 0.0);
      const Eigen::Vector2d a(-e.y(), e.x());
      d_xy->topRows<2>() = (dtheta_dr * c) * e * e.transpose() + s_over_r * a * a.transpose();
      d_xy->row(2) = -(dtheta_dr * s_over_r * r) * e.transpose();
    }
    return true;
  }

  std::optional<double> height(const Eigen::Vector2d& xy) const {
    double s_over_r = 0.0;
    double c = 0.0;
    if (!Profile::angle(xy.norm(), s_over_r, c, nullptr)) return std::nullopt;
    return c / s_over_r;
  }
};

/// h = sqrt(R^2 - r^2), r = R sin(theta): theta below 90 degrees only (Johnson 1997, eqs 4.1-4.4).
class SphericalProfile {
 public:
  static constexpr std::string_view kModel = "spherical";
  static constexpr int kMaxSize = 1;
  /// The field ends here, just before the surface stands upright.
  static constexpr double kMaxTheta = 1.5707963267948966 - kLeastSlope;

  int size() const { return 1; }
  std::vector<std::string> names() const { return {"R"}; }
  void get(double* parameters) const { parameters[0] = R_; }
  std::optional<SphericalProfile> with(const double* parameters, double field) const;
  bool radius(double s, double c, double& r_over_s, double* dr_dtheta, double* dr_dp) const;
  bool angle(double r, double& s_over_r, double& c, double* dtheta_dr) const;

 private:
  double R_ = 1.0;
};

/// h = R0 - x^2/a^2 - y^2/b^2 (Johnson 1997, eq. 4.26); closed form both ways (4.27-4.32), here
/// with the direction (n_x, n_y, n_z) in place of (u, v, R0), so that it holds behind the camera
/// too.
class QuadricSurface {
 public:
  static constexpr std::string_view kModel = "quadric";

  int size() const { return 3; }
  std::vector<std::string> names() const { return {"R0", "a", "b"}; }
  void get(double* parameters) const;
  std::optional<QuadricSurface> with(const double* parameters, double field) const;
  bool project(const Eigen::Vector3d& n, Eigen::Vector2d& xy, Jacobian23* d_n,
               double* d_parameters) const;
  bool unproject(const Eigen::Vector2d& xy, Eigen::Vector3d& n, Jacobian32* d_xy) const;
  std::optional<double> height(const Eigen::Vector2d& xy) const;

 private:
  double R0_ = 1.0;
  double a_ = 2.0;
  double b_ = 2.0;
};

/// alpha^2 beta rho^2 + (2 alpha - 1) H^2 + 2 (1 - alpha) H = 1 with rho = r / f, H = h / f.
struct Conic {
  double alpha = 0.5;
  double beta = 1.0;

  /// Largest radius with a height [in f]; infinite for alpha <= 1/2.
  double limit() const;
  /// What the surface's height, slope and derivatives need: q = sqrt(1 - (2 alpha - 1) beta rho^2).
  /// @return false outside the surface
  bool root(double rho, double& q) const;
  double height(double rho, double q) const;
  double slope(double rho, double q) const { return -alpha * beta * rho / q; }
  double dAlpha(double rho, double q) const;
  double dBeta(double rho, double q) const { return -0.5 * alpha * rho * rho / q; }
};

/// The general quadric of Johnson 1997, eq. 4.19, with its z^2 term: exactly the enhanced unified
/// camera model (Khomutenko et al. 2016). Parameters f [px], alpha, beta.
class ConicProfile {
 public:
  static constexpr std::string_view kModel = "conic";
  static constexpr int kMaxSize = 3;

  int size() const { return 3; }
  std::vector<std::string> names() const { return {"f", "alpha", "beta"}; }
  void get(double* parameters) const;
  std::optional<ConicProfile> with(const double* parameters, double field) const;
  bool radius(double s, double c, double& r_over_s, double* dr_dtheta, double* dr_dp) const;
  bool angle(double r, double& s_over_r, double& c, double* dtheta_dr) const;

 private:
  double f_ = 1.0;
  Conic conic_;
};

/// Conic plus a4 rho^4 + a6 rho^6 + a8 rho^8 (as many as it has), all scaled by f.
class AsphereProfile {
 public:
  static constexpr std::string_view kModel = "asphere";
  static constexpr int kMaxTerms = 3;
  static constexpr int kMaxSize = 3 + kMaxTerms;

  explicit AsphereProfile(int terms = 0) : terms_(terms) {}
  int size() const { return 3 + terms_; }
  int terms() const { return terms_; }
  std::vector<std::string> names() const;
  void get(double* parameters) const;
  std::optional<AsphereProfile> with(const double* parameters, double field) const;
  bool radius(double s, double c, double& r_over_s, double* dr_dtheta, double* dr_dp) const;
  bool angle(double r, double& s_over_r, double& c, double* dtheta_dr) const;

 private:
  /// Height and slope at rho, in f. @return false outside the conic part
  bool evaluate(double rho, double& height, double& slope) const;
  /// Lower bound of g = H - rho H' over [low, high]. @return false when it may reach kLeastSlope
  bool risesOver(double low, double high, int depth) const;
  /// Radius of the direction (s, c) within [low, high], from a first guess.
  double solve(double s, double c, double low, double high, double guess) const;
  bool prepare(double field);

  // The inverse starts from a Hermite interpolation of rho / s over c: even in theta, so smooth in
  // c. Its nodes bracket the root.
  static constexpr int kCells = 24;
  struct Node {
    double k;   // rho / s
    double dk;  // per cell
    double rho;
  };

  int terms_ = 0;
  double f_ = 1.0;
  Conic conic_;
  std::array<double, kMaxTerms> a_{};
  double rho_max_ = 0.0;
  double c_min_ = 0.0;
  double cells_per_c_ = 0.0;
  std::array<Node, kCells + 1> nodes_{};
};

/// r(theta): a C2 cubic spline through r_0 = 0 and r_i at theta_i = i span / n, odd about the axis,
/// with a continuous third derivative at the last knot but one; beyond the span it goes on
/// straight.
class SplineProfile {
 public:
  static constexpr std::string_view kModel = "spline";
  static constexpr int kMinKnots = 4;
  static constexpr int kMaxKnots = 32;
  static constexpr int kMaxSize = kMaxKnots;

  SplineProfile() = default;
  SplineProfile(int knots, double span);
  int size() const { return knots_; }
  double span() const { return span_; }
  std::vector<std::string> names() const;
  void get(double* parameters) const;
  std::optional<SplineProfile> with(const double* parameters, double field) const;
  bool radius(double s, double c, double& r_over_s, double* dr_dtheta, double* dr_dp) const;
  bool angle(double r, double& s_over_r, double& c, double* dtheta_dr) const;

 private:
  /// r = a0 + u (a1 + u (a2 + u a3)) with u in [0, 1] over the segment.
  struct Segment {
    double a0, a1, a2, a3;
  };

  int knots_ = 0;
  double span_ = 1.0;
  double step_ = 1.0;       // [rad]
  double end_slope_ = 0.0;  // dr/dtheta at the span
  double field_ = 0.0;      // [rad]
  double r_max_ = 0.0;      // at the field
  /// Second derivatives (times step^2) at the knots 0..n as a linear function of r_1..r_n.
  std::shared_ptr<const Eigen::MatrixXd> curvature_;
  std::array<double, kMaxKnots + 1> r_{};
  std::array<Segment, kMaxKnots> segments_{};
};

}  // namespace omnister::detail
