// SPDX-License-Identifier: Apache-2.0
#include "lens/model/surfaces.h"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <limits>

namespace omnister::detail {
namespace {

// Sizes beyond these are no lens, and their squares would leave the range of double.
constexpr double kMaxLength = 1e9;  // [px]
constexpr double kMinLength = 1e-6;

bool isLength(double value) { return value >= kMinLength && value <= kMaxLength; }

}  // namespace

// ---------------------------------------------------------------- spherical

std::optional<SphericalProfile> SphericalProfile::with(const double* parameters,
                                                       double field) const {
  if (!isLength(parameters[0]) || !(field <= kMaxTheta + 1e-6)) return std::nullopt;
  SphericalProfile out;
  out.R_ = parameters[0];
  return out;
}

bool SphericalProfile::radius(double s, double c, double& r_over_s, double* dr_dtheta,
                              double* dr_dp) const {
  if (!(c > 0.0)) return false;
  r_over_s = R_;
  if (dr_dtheta != nullptr) *dr_dtheta = R_ * c;
  if (dr_dp != nullptr) dr_dp[0] = s;
  return true;
}

bool SphericalProfile::angle(double r, double& s_over_r, double& c, double* dtheta_dr) const {
  const double square = (R_ - r) * (R_ + r);
  if (!(square > 0.0)) return false;
  s_over_r = 1.0 / R_;
  c = std::sqrt(square) * s_over_r;
  if (dtheta_dr != nullptr) *dtheta_dr = s_over_r / c;
  return true;
}

// ---------------------------------------------------------------- quadric

void QuadricSurface::get(double* parameters) const {
  parameters[0] = R0_;
  parameters[1] = a_;
  parameters[2] = b_;
}

std::optional<QuadricSurface> QuadricSurface::with(const double* parameters, double field) const {
  // Along any azimuth g = R0 + r^2 (cos^2/a^2 + sin^2/b^2) > 0: one-to-one up to 180 degrees.
  if (!isLength(parameters[0]) || !isLength(parameters[1]) || !isLength(parameters[2]) ||
      !std::isfinite(field)) {
    return std::nullopt;
  }
  QuadricSurface out;
  out.R0_ = parameters[0];
  out.a_ = parameters[1];
  out.b_ = parameters[2];
  return out;
}

bool QuadricSurface::project(const Eigen::Vector3d& n, Eigen::Vector2d& xy, Jacobian23* d_n,
                             double* d_parameters) const {
  // (x, y, h) = t n with h = R0 - x^2/a^2 - y^2/b^2:  Q t^2 + n_z t - R0 = 0.
  const double ax = n.x() / a_;
  const double by = n.y() / b_;
  const double Q = ax * ax + by * by;
  const double w = std::sqrt(n.z() * n.z() + 4.0 * Q * R0_);
  const double t = n.z() > 0.0 ? 2.0 * R0_ / (w + n.z()) : (w - n.z()) / (2.0 * Q);
  if (!std::isfinite(t)) return false;
  xy = t * n.head<2>();
  if (d_n != nullptr) {
    const Eigen::RowVector3d dt(-2.0 * t * t * ax / (a_ * w), -2.0 * t * t * by / (b_ * w), -t / w);
    *d_n = n.head<2>() * dt;
    (*d_n)(0, 0) += t;
    (*d_n)(1, 1) += t;
  }
  if (d_parameters != nullptr) {
    Eigen::Map<Eigen::Matrix<double, 2, 3>> d(d_parameters);
    d = n.head<2>() *
        Eigen::RowVector3d(1.0, 2.0 * t * t * ax * ax / a_, 2.0 * t * t * by * by / b_) / w;
  }
  return true;
}

bool QuadricSurface::unproject(const Eigen::Vector2d& xy, Eigen::Vector3d& n,
                               Jacobian32* d_xy) const {
  const double xa = xy.x() / a_;
  const double yb = xy.y() / b_;
  n << xy, R0_ - xa * xa - yb * yb;
  const double length = n.norm();
  if (!std::isfinite(length)) return false;
  n /= length;
  if (d_xy != nullptr) {
    Jacobian32 d;
    d << 1.0, 0.0, 0.0, 1.0, -2.0 * xa / a_, -2.0 * yb / b_;
    *d_xy = (d - n * (n.transpose() * d)) / length;
  }
  return true;
}

std::optional<double> QuadricSurface::height(const Eigen::Vector2d& xy) const {
  const double xa = xy.x() / a_;
  const double yb = xy.y() / b_;
  return R0_ - xa * xa - yb * yb;
}

// ---------------------------------------------------------------- conic

double Conic::limit() const {
  return alpha > 0.5 ? 1.0 / std::sqrt(beta * (2.0 * alpha - 1.0))
                     : std::numeric_limits<double>::infinity();
}

bool Conic::root(double rho, double& q) const {
  const double square = 1.0 - (2.0 * alpha - 1.0) * beta * rho * rho;
  if (!(square > 0.0)) return false;
  q = std::sqrt(square);
  return true;
}

double Conic::height(double rho, double q) const {
  return (1.0 - beta * alpha * alpha * rho * rho) / (alpha * q + (1.0 - alpha));
}

double Conic::dAlpha(double rho, double q) const {
  // From the surface's equation, with H - 1 = alpha E written so that alpha = 0 is no exception.
  const double b = beta * rho * rho;
  const double E = b * ((2.0 * alpha - 1.0) / (1.0 + q) - alpha) / (alpha * q + (1.0 - alpha));
  return -(b + (1.0 + alpha * E) * E) / q;
}

namespace {

bool isConic(const double* parameters) {
  return isLength(parameters[0]) && parameters[1] >= 0.0 && parameters[1] <= 100.0 &&
         parameters[2] >= 1e-6 && parameters[2] <= 1e6;
}

// Angle [rad] at which the conic ends: it stands upright (alpha > 1/2) or runs to infinity.
double conicEnd(const Conic& conic) {
  const double k = 2.0 * conic.alpha - 1.0;
  if (k > 0.0) return std::atan2(conic.limit(), -(1.0 - conic.alpha) / k);
  return std::atan2(std::sqrt(std::abs(k)), -conic.alpha * std::sqrt(conic.beta));
}

}  // namespace

void ConicProfile::get(double* parameters) const {
  parameters[0] = f_;
  parameters[1] = conic_.alpha;
  parameters[2] = conic_.beta;
}

std::optional<ConicProfile> ConicProfile::with(const double* parameters, double field) const {
  if (!isConic(parameters)) return std::nullopt;
  ConicProfile out;
  out.f_ = parameters[0];
  out.conic_ = {parameters[1], parameters[2]};
  if (!(field < conicEnd(out.conic_))) return std::nullopt;
  double r_over_s = 0.0;
  double dr_dtheta = 0.0;
  if (!out.radius(std::sin(field), std::cos(field), r_over_s, &dr_dtheta, nullptr) ||
      !(r_over_s <= kMaxLength) || !(dr_dtheta >= kLeastSlope * out.f_)) {
    return std::nullopt;
  }
  return out;
}

bool ConicProfile::radius(double s, double c, double& r_over_s, double* dr_dtheta,
                          double* dr_dp) const {
  const double alpha = conic_.alpha;
  const double beta = conic_.beta;
  const double denominator = alpha * std::sqrt(beta * s * s + c * c) + (1.0 - alpha) * c;
  if (!(denominator > 0.0)) return false;
  r_over_s = f_ / denominator;
  if (dr_dtheta == nullptr && dr_dp == nullptr) return true;
  const double rho = s / denominator;
  const double height = c / denominator;
  // alpha q, from the surface's equation.
  const double alpha_q = (2.0 * alpha - 1.0) * height + (1.0 - alpha);
  const double q =
      alpha > 1e-3 ? alpha_q / alpha : std::sqrt(1.0 - (2.0 * alpha - 1.0) * beta * rho * rho);
  const double g = height - rho * conic_.slope(rho, q);
  if (dr_dtheta != nullptr) *dr_dtheta = f_ / (denominator * denominator * g);
  if (dr_dp != nullptr) {
    dr_dp[0] = rho;
    dr_dp[1] = f_ * rho * conic_.dAlpha(rho, q) / g;
    dr_dp[2] = f_ * rho * conic_.dBeta(rho, q) / g;
  }
  return true;
}

bool ConicProfile::angle(double r, double& s_over_r, double& c, double* dtheta_dr) const {
  const double rho = r / f_;
  double q = 0.0;
  if (!conic_.root(rho, q)) return false;
  const double height = conic_.height(rho, q);
  const double inverse = 1.0 / std::sqrt(rho * rho + height * height);
  s_over_r = inverse / f_;
  c = height * inverse;
  if (dtheta_dr != nullptr) {
    *dtheta_dr = (height - rho * conic_.slope(rho, q)) * inverse * inverse / f_;
  }
  return true;
}

// ---------------------------------------------------------------- asphere

std::vector<std::string> AsphereProfile::names() const {
  std::vector<std::string> out{"f", "alpha", "beta", "a4", "a6", "a8"};
  out.resize(size());
  return out;
}

void AsphereProfile::get(double* parameters) const {
  parameters[0] = f_;
  parameters[1] = conic_.alpha;
  parameters[2] = conic_.beta;
  std::copy_n(a_.begin(), terms_, parameters + 3);
}

std::optional<AsphereProfile> AsphereProfile::with(const double* parameters, double field) const {
  if (!isConic(parameters)) return std::nullopt;
  AsphereProfile out(terms_);
  out.f_ = parameters[0];
  out.conic_ = {parameters[1], parameters[2]};
  std::copy_n(parameters + 3, terms_, out.a_.begin());
  for (const double a : out.a_) {
    if (!(std::abs(a) <= 1e6)) return std::nullopt;
  }
  if (!out.prepare(field)) return std::nullopt;
  return out;
}

bool AsphereProfile::evaluate(double rho, double& height, double& slope) const {
  double q = 0.0;
  if (!conic_.root(rho, q)) return false;
  const double square = rho * rho;
  height = conic_.height(rho, q) + square * square * (a_[0] + square * (a_[1] + square * a_[2]));
  slope = conic_.slope(rho, q) +
          square * rho * (4.0 * a_[0] + square * (6.0 * a_[1] + square * 8.0 * a_[2]));
  return true;
}

bool AsphereProfile::risesOver(double low, double high, int depth) const {
  // g = (H - rho H') of the conic, which rises from 1 since the conic is concave, plus
  // -3 a4 rho^4 - 5 a6 rho^6 - 7 a8 rho^8, each least at one of the ends.
  double q = 0.0;
  if (!conic_.root(low, q)) return false;
  double bound = conic_.height(low, q) - low * conic_.slope(low, q);
  double low_power = low * low;
  double high_power = high * high;
  for (int i = 0; i < terms_; ++i) {
    low_power *= low * low;
    high_power *= high * high;
    bound -= (3.0 + 2.0 * i) * std::max(a_[i] * low_power, a_[i] * high_power);
  }
  if (bound > kLeastSlope) return true;
  if (depth == 0) return false;
  const double middle = 0.5 * (low + high);
  return risesOver(low, middle, depth - 1) && risesOver(middle, high, depth - 1);
}

double AsphereProfile::solve(double s, double c, double low, double high, double guess) const {
  double rho = guess > low && guess < high ? guess : 0.5 * (low + high);
  for (int i = 0; i < 100; ++i) {
    double height = 0.0;
    double slope = 0.0;
    evaluate(rho, height, slope);
    const double value =
        rho * c - height * s;  // sin(theta(rho) - theta) N: negative below the root
    (value < 0.0 ? low : high) = rho;
    const double derivative = c - slope * s;
    double next = rho - value / derivative;
    // Newton's error after a step is of the order of the step squared.
    if (std::abs(next - rho) <= 1e-9 * rho) return std::clamp(next, low, high);
    if (!(next > low && next < high)) next = 0.5 * (low + high);
    if (next == rho || !(high - low > 1e-16 * high)) return next;
    rho = next;
  }
  return rho;
}

bool AsphereProfile::prepare(double field) {
  // Walk outwards in steps of about field / 24, proving on each that theta rises, up to the field.
  const double limit = conic_.limit();
  double rho = 0.0;
  double height = 1.0;
  double slope = 0.0;
  double theta = 0.0;
  for (int step = 0;; ++step) {
    if (step == 400) return false;
    const double g = height - rho * slope;
    double next = rho + (field / 24.0) * (rho * rho + height * height) / g;
    if (next >= limit) {
      next = rho + 0.9 * (limit - rho);
      if (next - rho < 1e-9 * limit) return false;
    }
    if (!risesOver(rho, next, 8) || !evaluate(next, height, slope) || !(next < 1e6)) return false;
    const double next_theta = std::atan2(next, height);
    if (!(next_theta > theta) || !(height - next * slope > kLeastSlope)) return false;
    if (next_theta >= field) {
      rho_max_ = solve(std::sin(field), std::cos(field), rho, next, 0.5 * (rho + next));
      break;
    }
    rho = next;
    theta = next_theta;
  }
  c_min_ = std::cos(field);
  cells_per_c_ = kCells / (1.0 - c_min_);
  nodes_[kCells] = {1.0, (conic_.alpha * conic_.beta - 1.0) / cells_per_c_, 0.0};
  double previous = 0.0;
  double guess = 0.0;
  for (int i = kCells - 1; i >= 0; --i) {
    const double c = c_min_ + i / cells_per_c_;
    const double s = std::sqrt((1.0 - c) * (1.0 + c));
    guess = (nodes_[i + 1].k - nodes_[i + 1].dk) * s;
    rho = i == 0 ? rho_max_ : solve(s, c, previous, rho_max_, guess);
    if (!evaluate(rho, height, slope)) return false;
    const double k = rho / s;
    const double dr_dtheta = (rho * rho + height * height) / (height - rho * slope);
    if (!(dr_dtheta >= kLeastSlope)) return false;
    nodes_[i] = {k, -(dr_dtheta - k * c) / (s * s * cells_per_c_), rho};
    previous = rho;
  }
  return rho_max_ * f_ <= kMaxLength;
}

bool AsphereProfile::radius(double s, double c, double& r_over_s, double* dr_dtheta,
                            double* dr_dp) const {
  const double place = (c - c_min_) * cells_per_c_;
  if (!(place >= 0.0)) return false;
  double rho = 0.0;
  double k = 1.0;
  if (s > 0.0) {
    const int cell = std::min(static_cast<int>(place), kCells - 1);
    const Node& low = nodes_[cell];
    const Node& high = nodes_[cell + 1];
    const double u = place - cell;
    const double v = 1.0 - u;
    const double guess = s * (v * v * ((1.0 + 2.0 * u) * low.k + u * low.dk) +
                              u * u * ((1.0 + 2.0 * v) * high.k - v * high.dk));
    // Rounding of c may put the root just outside the nodes.
    rho = solve(s, c, high.rho * (1.0 - 1e-12), low.rho * (1.0 + 1e-12), guess);
    k = rho / s;
  }
  r_over_s = f_ * k;
  if (dr_dtheta == nullptr && dr_dp == nullptr) return true;
  double height = 0.0;
  double slope = 0.0;
  if (!evaluate(rho, height, slope)) return false;
  const double g = height - rho * slope;
  if (dr_dtheta != nullptr) *dr_dtheta = f_ * (rho * rho + height * height) / g;
  if (dr_dp != nullptr) {
    double q = 0.0;
    conic_.root(rho, q);
    const double scale = f_ * rho / g;
    dr_dp[0] = rho;
    dr_dp[1] = scale * conic_.dAlpha(rho, q);
    dr_dp[2] = scale * conic_.dBeta(rho, q);
    double power = rho * rho;
    for (int i = 0; i < terms_; ++i) {
      power *= rho * rho;
      dr_dp[3 + i] = scale * power;
    }
  }
  return true;
}

bool AsphereProfile::angle(double r, double& s_over_r, double& c, double* dtheta_dr) const {
  const double rho = r / f_;
  double height = 0.0;
  double slope = 0.0;
  if (!(rho <= rho_max_ * (1.0 + 1e-12)) || !evaluate(rho, height, slope)) return false;
  const double inverse = 1.0 / std::sqrt(rho * rho + height * height);
  s_over_r = inverse / f_;
  c = height * inverse;
  if (dtheta_dr != nullptr) *dtheta_dr = (height - rho * slope) * inverse * inverse / f_;
  return true;
}

// ---------------------------------------------------------------- spline

SplineProfile::SplineProfile(int knots, double span)
    : knots_(knots), span_(span), step_(span / knots) {
  // Unknown m_0..m_n; m_0 = 0 (odd), second differences inside, m_n - 2 m_{n-1} + m_{n-2} = 0.
  const int n = knots;
  Eigen::MatrixXd left = Eigen::MatrixXd::Zero(n + 1, n + 1);
  Eigen::MatrixXd right = Eigen::MatrixXd::Zero(n + 1, n + 1);
  left(0, 0) = 1.0;
  for (int i = 1; i < n; ++i) {
    left.row(i).segment<3>(i - 1) << 1.0, 4.0, 1.0;
    right.row(i).segment<3>(i - 1) << 6.0, -12.0, 6.0;
  }
  left.row(n).tail<3>() << 1.0, -2.0, 1.0;
  // r_0 = 0 needs no column.
  curvature_ = std::make_shared<Eigen::MatrixXd>(
      Eigen::MatrixXd(left.partialPivLu().solve(right)).rightCols(n));
}

std::vector<std::string> SplineProfile::names() const {
  std::vector<std::string> out;
  for (int i = 1; i <= knots_; ++i) out.push_back("r" + std::to_string(i));
  return out;
}

void SplineProfile::get(double* parameters) const {
  std::copy_n(r_.begin() + 1, knots_, parameters);
}

std::optional<SplineProfile> SplineProfile::with(const double* parameters, double field) const {
  SplineProfile out(*this);
  out.r_[0] = 0.0;
  std::copy_n(parameters, knots_, out.r_.begin() + 1);
  for (int i = 1; i <= knots_; ++i) {
    if (!(out.r_[i] > out.r_[i - 1]) || !(out.r_[i] <= kMaxLength)) return std::nullopt;
  }
  const Eigen::VectorXd m =
      *curvature_ * Eigen::Map<const Eigen::VectorXd>(out.r_.data() + 1, knots_);
  double least = std::numeric_limits<double>::infinity();  // of dr/du, exact: it is a parabola
  for (int i = 0; i < knots_; ++i) {
    const Segment segment{out.r_[i], out.r_[i + 1] - out.r_[i] - (2.0 * m[i] + m[i + 1]) / 6.0,
                          0.5 * m[i], (m[i + 1] - m[i]) / 6.0};
    out.segments_[i] = segment;
    // The field may end inside a segment; what lies beyond matters to nobody.
    const double end = std::min(1.0, field / step_ - i);
    if (end <= 0.0) continue;
    const auto slope = [&](double u) {
      return segment.a1 + u * (2.0 * segment.a2 + u * 3.0 * segment.a3);
    };
    least = std::min({least, slope(0.0), slope(end)});
    const double turn = -segment.a2 / (3.0 * segment.a3);
    if (turn > 0.0 && turn < end) least = std::min(least, slope(turn));
  }
  if (!(least >= kLeastSlope * out.segments_[0].a1) || !(out.segments_[0].a1 > 0.0)) {
    return std::nullopt;
  }
  const Segment& last = out.segments_[knots_ - 1];
  out.field_ = field;
  out.end_slope_ = (last.a1 + 2.0 * last.a2 + 3.0 * last.a3) / step_;
  if (field > span_) {
    out.r_max_ = out.r_[knots_] + out.end_slope_ * (field - span_);
  } else {
    const double place = field / step_;
    const int i = std::min(static_cast<int>(place), knots_ - 1);
    const double u = place - i;
    const Segment& segment = out.segments_[i];
    out.r_max_ = segment.a0 + u * (segment.a1 + u * (segment.a2 + u * segment.a3));
  }
  return out;
}

bool SplineProfile::radius(double s, double c, double& r_over_s, double* dr_dtheta,
                           double* dr_dp) const {
  const double theta = std::atan2(s, c);
  const double place = theta / step_;
  double r = 0.0;
  if (theta >= span_) {
    r = r_[knots_] + end_slope_ * (theta - span_);
    if (dr_dtheta != nullptr) *dr_dtheta = end_slope_;
    if (dr_dp != nullptr) {
      // d(end slope)/dr: r_n - r_{n-1} + (m_{n-1} + 2 m_n) / 6, per step.
      const double ahead = (theta - span_) / step_;
      Eigen::Map<Eigen::RowVectorXd> d(dr_dp, knots_);
      d = (ahead / 6.0) * (curvature_->row(knots_ - 1) + 2.0 * curvature_->row(knots_));
      d[knots_ - 1] += 1.0 + ahead;
      d[knots_ - 2] -= ahead;
    }
  } else {
    const int i = std::min(static_cast<int>(place), knots_ - 1);
    const double u = place - i;
    const Segment& segment = segments_[i];
    r = segment.a0 + u * (segment.a1 + u * (segment.a2 + u * segment.a3));
    if (dr_dtheta != nullptr) {
      *dr_dtheta = (segment.a1 + u * (2.0 * segment.a2 + u * 3.0 * segment.a3)) / step_;
    }
    if (dr_dp != nullptr) {
      const double v = 1.0 - u;
      Eigen::Map<Eigen::RowVectorXd> d(dr_dp, knots_);
      d = (v * (v * v - 1.0) / 6.0) * curvature_->row(i) +
          (u * (u * u - 1.0) / 6.0) * curvature_->row(i + 1);
      if (i > 0) d[i - 1] += v;
      d[i] += u;
    }
  }
  r_over_s = s > 0.0 ? r / s : segments_[0].a1 / step_;
  return true;
}

bool SplineProfile::angle(double r, double& s_over_r, double& c, double* dtheta_dr) const {
  if (!(r <= r_max_ * (1.0 + 1e-12))) return false;
  double theta = 0.0;
  double slope = end_slope_;
  if (r >= r_[knots_]) {
    theta = span_ + (r - r_[knots_]) / end_slope_;
  } else {
    // Most lenses are near r = f theta, so this guess is right or next to it.
    int i = std::min(static_cast<int>(r / r_[knots_] * knots_), knots_ - 1);
    while (r < r_[i]) --i;
    while (r >= r_[i + 1]) ++i;
    const Segment& segment = segments_[i];
    const double target = r - segment.a0;
    double low = 0.0;
    double high = std::min(1.0, field_ / step_ - i + 1e-9);
    double u = std::min(high, target / (r_[i + 1] - r_[i]));
    for (int iteration = 0; iteration < 100; ++iteration) {
      const double value = u * (segment.a1 + u * (segment.a2 + u * segment.a3)) - target;
      slope = segment.a1 + u * (2.0 * segment.a2 + u * 3.0 * segment.a3);
      (value < 0.0 ? low : high) = u;
      double next = u - value / slope;
      if (std::abs(next - u) <= 1e-9) {
        u = next;
        break;
      }
      if (!(next > low && next < high)) next = 0.5 * (low + high);
      if (next == u) break;
      u = next;
    }
    theta = (i + u) * step_;
    slope = (segment.a1 + u * (2.0 * segment.a2 + u * 3.0 * segment.a3)) / step_;
  }
  c = std::cos(theta);
  s_over_r = r > 0.0 ? std::sin(theta) / r : step_ / segments_[0].a1;
  if (dtheta_dr != nullptr) *dtheta_dr = 1.0 / slope;
  return true;
}

}  // namespace omnister::detail
