// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/thesis_procedures.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <map>
#include <numeric>
#include <opencv2/imgproc.hpp>
#include <tuple>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/common/text.h"
#include "omnister/lens/lens_models.h"

namespace omnister {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kDegree = M_PI / 180.0;
constexpr std::size_t kLeastCorners = 12;
constexpr int kSweepSteps = 400;

double cross(const Eigen::Vector2d& a, const Eigen::Vector2d& b) {
  return a.x() * b.y() - a.y() * b.x();
}

std::string rounded(double value) { return formatNumber(std::round(value * 100.0) / 100.0); }

/// Typical distance between neighbours on the board.
double spacingOf(const std::vector<Eigen::Vector2d>& points) {
  const std::size_t stride = points.size() / 200 + 1;
  std::vector<double> nearest;
  for (std::size_t i = 0; i < points.size(); i += stride) {
    double best = kInfinity;
    for (std::size_t j = 0; j < points.size(); ++j) {
      if (j != i) best = std::min(best, (points[i] - points[j]).norm());
    }
    nearest.push_back(best);
  }
  std::nth_element(nearest.begin(), nearest.begin() + nearest.size() / 2, nearest.end());
  return nearest[nearest.size() / 2];
}

/// The board's own plane coordinates; the procedures know flat boards only.
std::vector<Eigen::Vector2d> planePoints(const ViewDetections& view) {
  if (view.pixels.size() < kLeastCorners || view.pixels.size() != view.points.size()) {
    throw Error("view '" + printable(view.name, 60) + "' has " +
                std::to_string(view.pixels.size()) + " corners, expected at least " +
                std::to_string(kLeastCorners) + " of a board square to the optical axis");
  }
  std::vector<Eigen::Vector2d> points;
  Eigen::Vector2d low = view.points.front().head<2>();
  Eigen::Vector2d high = low;
  for (const Eigen::Vector3d& point : view.points) {
    points.emplace_back(point.head<2>());
    low = low.cwiseMin(points.back());
    high = high.cwiseMax(points.back());
  }
  const double extent = (high - low).norm();
  for (const Eigen::Vector3d& point : view.points) {
    if (std::abs(point.z() - view.points.front().z()) > 1e-6 * extent) {
      throw Error("view '" + printable(view.name, 60) +
                  "' has corners at different z, expected a " + "flat board");
    }
  }
  return points;
}

/// How far the picture is from an undistorted one, the board turned, moved and scaled [px].
double similarityRms(const std::vector<Eigen::Vector2d>& points,
                     const std::vector<Eigen::Vector2d>& pixels) {
  const double unit = spacingOf(points);
  Eigen::MatrixXd A(2 * points.size(), 4);
  Eigen::VectorXd b(2 * points.size());
  for (std::size_t i = 0; i < points.size(); ++i) {
    const Eigen::Vector2d p = points[i] / unit;
    A.row(2 * i) << p.x(), -p.y(), 1, 0;
    A.row(2 * i + 1) << p.y(), p.x(), 0, 1;
    b.segment<2>(2 * i) = pixels[i];
  }
  const Eigen::Vector4d fit = A.colPivHouseholderQr().solve(b);
  return std::sqrt((A * fit - b).squaredNorm() / static_cast<double>(points.size()));
}

/// Squares of residuals brought to their minimum; few unknowns, smooth residuals.
struct Minimum {
  Eigen::VectorXd parameters;
  double rms = 0.0;
  Eigen::MatrixXd covariance;  ///< from the residuals themselves; empty when singular
};
Minimum levenbergMarquardt(const std::function<Eigen::VectorXd(const Eigen::VectorXd&)>& residuals,
                           Eigen::VectorXd parameters, const Eigen::VectorXd& steps) {
  Eigen::VectorXd current = residuals(parameters);
  const Eigen::Index n = parameters.size();
  Eigen::MatrixXd jacobian(current.size(), n);
  const auto differentiate = [&] {
    for (Eigen::Index i = 0; i < n; ++i) {
      Eigen::VectorXd low = parameters, high = parameters;
      low[i] -= steps[i];
      high[i] += steps[i];
      jacobian.col(i) = (residuals(high) - residuals(low)) / (2.0 * steps[i]);
    }
  };
  double damping = 1e-4;
  bool done = false;
  for (int iteration = 0; iteration < 100 && !done; ++iteration) {
    differentiate();
    const Eigen::MatrixXd normal = jacobian.transpose() * jacobian;
    const Eigen::VectorXd gradient = jacobian.transpose() * current;
    for (done = true; damping < 1e12; damping *= 10.0) {
      Eigen::MatrixXd damped = normal;
      damped.diagonal() *= 1.0 + damping;
      const Eigen::VectorXd step = damped.ldlt().solve(-gradient);
      if (!step.allFinite()) continue;
      const Eigen::VectorXd next = residuals(parameters + step);
      if (!(next.squaredNorm() < current.squaredNorm())) continue;
      done = (step.array() / steps.array()).abs().maxCoeff() < 1e-4;
      parameters += step;
      current = next;
      damping = std::max(damping * 0.1, 1e-12);
      break;
    }
  }
  differentiate();
  Minimum out;
  out.parameters = parameters;
  out.rms = std::sqrt(current.squaredNorm() / static_cast<double>(current.size()));
  // Judge singularity free of units: columns of equal length.
  const Eigen::VectorXd norms = jacobian.colwise().norm().transpose().cwiseMax(1e-300);
  const Eigen::MatrixXd scaled = jacobian * norms.cwiseInverse().asDiagonal();
  const Eigen::JacobiSVD<Eigen::MatrixXd> svd(scaled, Eigen::ComputeThinV);
  if (svd.singularValues()[n - 1] > 1e-9 * svd.singularValues()[0]) {
    const Eigen::MatrixXd root = norms.cwiseInverse().asDiagonal() * svd.matrixV() *
                                 svd.singularValues().cwiseInverse().asDiagonal();
    const double freedom = std::max<double>(1.0, static_cast<double>(current.size() - n));
    out.covariance = root * root.transpose() * (current.squaredNorm() / freedom);
  }
  return out;
}

/// A board square to the axis as the ideal pinhole at its centre would see it.
struct SquareView {
  std::string name;
  cv::Size image_size;
  CenterOfDistortion center;
  double pixels_per_unit = 0.0;
  double spacing = 0.0;                 ///< of the dewarped points [px]
  std::vector<Eigen::Vector2d> board;   ///< relative to what the centre sees, in board units
  std::vector<Eigen::Vector2d> sensor;  ///< (x, y)
  std::vector<Eigen::Vector2d> ideal;   ///< (u, v)
  double radius = 0.0;                  ///< largest of `sensor`
  double one_sided = 0.0;  ///< how much larger the board is on one side, at its rim [px]
};

SquareView squareView(const ViewDetections& view, cv::Size image_size,
                      const ProcedureOptions& options) {
  SquareView out;
  out.name = view.name;
  out.image_size = image_size;
  const std::vector<Eigen::Vector2d> points = planePoints(view);
  out.center = findCenterOfDistortion(view, image_size, options.center);

  std::vector<std::pair<double, double>> samples;  // distance on the board, radius on the sensor
  for (std::size_t i = 0; i < points.size(); ++i) {
    out.board.push_back(points[i] - out.center.board_point);
    out.sensor.push_back(view.pixels[i] - out.center.center);
    samples.emplace_back(out.board[i].norm(), out.sensor[i].norm());
    out.radius = std::max(out.radius, samples.back().second);
  }
  std::sort(samples.begin(), samples.end());
  const double extent = samples.back().first;
  std::size_t inner = 0;
  while (inner < samples.size() &&
         (inner < kLeastCorners || samples[inner].first <= 0.5 * extent)) {
    ++inner;
  }
  // The board's distance as a series in the radius: it converges faster than the other way round.
  const double rim = samples[inner - 1].second;
  Eigen::MatrixXd powers(inner, 4);
  Eigen::VectorXd distances(inner);
  for (std::size_t i = 0; i < inner; ++i) {
    const double r = samples[i].second / rim;
    powers.row(i) << r, std::pow(r, 3), std::pow(r, 5), std::pow(r, 7);
    distances[i] = samples[i].first;
  }
  out.pixels_per_unit = rim / powers.colPivHouseholderQr().solve(distances)[0];
  if (!(out.pixels_per_unit > 0.0)) {
    throw Error("view '" + printable(view.name, 60) +
                "' gives no scale at the centre of distortion");
  }
  out.spacing = spacingOf(points) * out.pixels_per_unit;
  const Eigen::Rotation2Dd turn(out.center.turn);
  for (const Eigen::Vector2d& point : out.board) {
    out.ideal.push_back(out.pixels_per_unit * (turn * point));
  }

  // A tilted board is larger on one side: the first harmonic of the radii about their common curve.
  Eigen::MatrixXd curve(points.size(), 6);
  Eigen::VectorXd radii(points.size());
  for (std::size_t i = 0; i < points.size(); ++i) {
    const double rho = out.board[i].norm() / extent;
    const Eigen::Vector2d side = rho * out.board[i] / extent;
    curve.row(i) << rho, std::pow(rho, 3), std::pow(rho, 5), std::pow(rho, 7), side.x(), side.y();
    radii[i] = out.sensor[i].norm();
  }
  out.one_sided = curve.colPivHouseholderQr().solve(radii).tail<2>().norm();
  return out;
}

DewarpError dewarpError(const std::vector<double>& errors) {
  DewarpError out;
  out.mean_px = std::accumulate(errors.begin(), errors.end(), 0.0) / errors.size();
  out.min_px = *std::min_element(errors.begin(), errors.end());
  out.max_px = *std::max_element(errors.begin(), errors.end());
  return out;
}

/// What the board's tilt or a false centre leaves behind; the procedures forgive neither.
void warnOfTilt(const SquareView& view, std::vector<std::string>& warnings) {
  constexpr double kOffRadius = 1.0;  // [px]
  constexpr double kOneSided = 3.0;   // [px]
  if (view.one_sided > kOneSided) {
    warnings.push_back("the board is larger on one side by " + rounded(view.one_sided) +
                       " px at its rim: it is not square to the optical axis, or the centre is "
                       "wrong");
  }
  if (view.center.rms_px > kOffRadius) {
    warnings.push_back("the corners miss their radii by " + rounded(view.center.rms_px) +
                       " px RMS: the board is not square to the optical axis, or the distortion is "
                       "not radial");
  }
}

/// The remark every result carries.
void remark(const std::string& why, LensFile& file, std::vector<std::string>& warnings) {
  file.calibration.notes["r0_observable"] = "false";
  file.calibration.notes["r0_remark"] = why;
  warnings.push_back("R0 is not observable here: " + why);
}

constexpr const char* kSquareRemark =
    "a board square to the optical axis fixes the lens surface only up to a scale of its height; "
    "dewarped pictures are straight, but angles are not metric. Calibrate with tilted boards for "
    "rays";
constexpr const char* kLinesRemark =
    "straight lines fix the lens surface only up to a scale of its height; the radius is that of "
    "the "
    "assumed sphere and angles are not metric. Calibrate with tilted boards for rays";

LensFile lensFile(const std::string& procedure, const std::string& model,
                  const std::map<std::string, std::vector<double>>& parameters,
                  const Eigen::Vector2d& center, double max_theta, cv::Size image_size,
                  std::size_t points) {
  LensFile file;
  file.image_size = image_size;
  file.lens = makeLens(model, center, parameters, max_theta, "--procedure " + procedure);
  file.calibration.points = static_cast<int>(points);
  file.calibration.date = currentDate();
  file.calibration.notes["procedure"] = procedure + " (Johnson 1997)";
  return file;
}

LensFile sphericalFile(const std::string& procedure, double radius, double largest,
                       const Eigen::Vector2d& center, cv::Size image_size, std::size_t points) {
  // The surface ends at R; keep clear of the place where its slope is infinite.
  const double theta = std::asin(std::min(1.0, largest / radius)) + 1e-3;
  return lensFile(procedure, "spherical", {{"R", {radius}}}, center,
                  std::min(theta, M_PI / 2 - 1e-3), image_size, points);
}

/// RMS of the corners in the image when the lens sees the ideal points with height `R0`.
double imageRms(const SquareView& view, const LensModel& lens, double R0,
                std::vector<std::string>& warnings) {
  double sum = 0.0;
  std::size_t seen = 0;
  for (std::size_t i = 0; i < view.ideal.size(); ++i) {
    const auto pixel = lens.project({view.ideal[i].x(), view.ideal[i].y(), R0});
    if (!pixel) continue;
    sum += (*pixel - view.center.center - view.sensor[i]).squaredNorm();
    ++seen;
  }
  if (seen < view.ideal.size()) {
    warnings.push_back("RMS without " + std::to_string(view.ideal.size() - seen) +
                       " corners that lie outside the fitted surface");
  }
  return seen == 0 ? 0.0 : std::sqrt(sum / static_cast<double>(seen));
}

struct SweepRange {
  double low, high;
};
SweepRange sweepRange(const ProcedureOptions& options, double largest) {
  SweepRange range{1.001 * largest, 4.0 * largest};
  const auto refuse = [&](const std::string& name, double value, const std::string& expected) {
    throw Error(name + " is " + formatNumber(value) + " px, expected " + expected);
  };
  if (options.min_radius != 0.0) {
    if (!(options.min_radius > largest) || !std::isfinite(options.min_radius)) {
      refuse("the least radius of the sweep", options.min_radius,
             "more than " + rounded(largest) + ", the largest radius of the data");
    }
    range.low = options.min_radius;
    range.high = 4.0 * range.low;
  }
  if (options.max_radius != 0.0) range.high = options.max_radius;
  if (!(range.high > range.low) || !std::isfinite(range.high)) {
    refuse("the largest radius of the sweep", range.high, "more than " + rounded(range.low));
  }
  return range;
}

/// Errors for R from MAX to MIN in equal ratios.
std::vector<SweepStep> sweepRadius(const SweepRange& range,
                                   const std::function<SweepStep(double)>& errors) {
  std::vector<SweepStep> sweep;
  for (int i = 0; i <= kSweepSteps; ++i) {
    const double share = static_cast<double>(i) / kSweepSteps;
    sweep.push_back(errors(range.high * std::pow(range.low / range.high, share)));
  }
  return sweep;
}

/// The minimum of one figure of a sweep, refined between its neighbours by golden section.
/// @return nullopt when the least value stands at an end
std::optional<SweepStep> refineMinimum(const std::vector<SweepStep>& sweep,
                                       double SweepStep::*figure,
                                       const std::function<SweepStep(double)>& errors) {
  const auto least = std::min_element(
      sweep.begin(), sweep.end(),
      [&](const SweepStep& a, const SweepStep& b) { return a.*figure < b.*figure; });
  if (least == sweep.begin() || least == sweep.end() - 1) return std::nullopt;
  constexpr double kGolden = 0.6180339887498949;
  double low = (least + 1)->radius;
  double high = (least - 1)->radius;
  SweepStep inner = errors(high - kGolden * (high - low));
  SweepStep outer = errors(low + kGolden * (high - low));
  while (high - low > 1e-7 * high) {
    if (inner.*figure < outer.*figure) {
      high = outer.radius;
      outer = inner;
      inner = errors(high - kGolden * (high - low));
    } else {
      low = inner.radius;
      inner = outer;
      outer = errors(low + kGolden * (high - low));
    }
  }
  return inner.*figure < outer.*figure ? inner : outer;
}

/// Eq. 4.3 and 4.4.
Eigen::Vector2d dewarpSpherical(const Eigen::Vector2d& xy, double radius) {
  return xy * (radius / std::sqrt(radius * radius - xy.squaredNorm()));
}

/// Mean absolute distance from the line of least squares.
double lineDeviation(const std::vector<Eigen::Vector2d>& points) {
  Eigen::Vector2d mean = Eigen::Vector2d::Zero();
  for (const Eigen::Vector2d& point : points) mean += point;
  mean /= static_cast<double>(points.size());
  Eigen::Matrix2d spread = Eigen::Matrix2d::Zero();
  for (const Eigen::Vector2d& point : points) {
    spread += (point - mean) * (point - mean).transpose();
  }
  const Eigen::Vector2d normal =
      Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d>(spread).eigenvectors().col(0);
  double sum = 0.0;
  for (const Eigen::Vector2d& point : points) sum += std::abs(normal.dot(point - mean));
  return sum / static_cast<double>(points.size());
}

/// Radii of one axis of the board: distances on the sensor and on the dewarped plane.
struct AxisPoints {
  std::vector<double> r, rho;
};

/// R(u) and R(v) for one R0: lines with a common constant term.
struct RadiusLines {
  double constant = 0.0;
  double slope_u = 0.0;
  double slope_v = 0.0;
  double relative_rms = 0.0;  ///< of the radii about the lines, over R0
};
RadiusLines fitRadiusLines(const AxisPoints& row, const AxisPoints& column, double R0) {
  const std::size_t n = row.r.size() + column.r.size();
  Eigen::MatrixXd A = Eigen::MatrixXd::Zero(n, 3);
  Eigen::VectorXd radii(n);
  std::size_t i = 0;
  for (const auto& [axis, slope] : {std::pair(&row, 1), std::pair(&column, 2)}) {
    for (std::size_t k = 0; k < axis->r.size(); ++k, ++i) {
      A(i, 0) = 1.0;
      A(i, slope) = axis->rho[k];
      radii[i] = axis->r[k] * std::hypot(axis->rho[k], R0) / axis->rho[k];  // eq. 4.22, 4.23
    }
  }
  const Eigen::Vector3d fit = A.colPivHouseholderQr().solve(radii);
  return {fit[0], fit[1], fit[2],
          std::sqrt((A * fit - radii).squaredNorm() / static_cast<double>(n)) / R0};
}

/// R0 where the common constant term equals R0. Very wide boards allow two; the straighter R(u)
/// wins.
double solveR0(const AxisPoints& row, const AxisPoints& column, double extent) {
  const auto gap = [&](double R0) { return fitRadiusLines(row, column, R0).constant - R0; };
  constexpr int kSteps = 400;
  const double low = 0.05 * extent;
  const double high = 40.0 * extent;
  std::optional<double> best;
  double best_rms = kInfinity;
  double last = low;
  double last_gap = gap(low);
  for (int i = 1; i <= kSteps; ++i) {
    const double next = low * std::pow(high / low, static_cast<double>(i) / kSteps);
    const double next_gap = gap(next);
    if (std::signbit(last_gap) != std::signbit(next_gap)) {
      double a = last, b = next;
      for (int k = 0; k < 60; ++k) {
        const double middle = 0.5 * (a + b);
        (std::signbit(gap(middle)) == std::signbit(last_gap) ? a : b) = middle;
      }
      const double rms = fitRadiusLines(row, column, a).relative_rms;
      if (rms < best_rms) {
        best_rms = rms;
        best = a;
      }
    }
    last = next;
    last_gap = next_gap;
  }
  if (!best) {
    throw Error(
        "no R0 makes the constant terms of R(u) and R(v) equal to it: too little distortion, too "
        "few points near the centre, or a board that is not square to the axis");
  }
  return *best;
}

/// Second-order fit of heights through R0: 1/a^2, and R^2 of the fit.
std::pair<double, double> fitHeights(const AxisPoints& axis, double R0, double slope) {
  std::vector<double> x, drop;
  for (const double rho : axis.rho) {
    const double R = R0 + slope * rho;
    const double beta = std::atan2(rho, R0);
    x.push_back(R * std::sin(beta));          // eq. 4.24
    drop.push_back(R0 - R * std::cos(beta));  // eq. 4.25
  }
  double xxxx = 0.0, xxd = 0.0, mean = 0.0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    xxxx += std::pow(x[i], 4);
    xxd += x[i] * x[i] * drop[i];
    mean += drop[i] / static_cast<double>(x.size());
  }
  const double factor = xxd / xxxx;
  double residual = 0.0, total = 0.0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    residual += std::pow(drop[i] - factor * x[i] * x[i], 2);
    total += std::pow(drop[i] - mean, 2);
  }
  return {factor, total > 0.0 ? 1.0 - residual / total : 1.0};
}

}  // namespace

CenterOfDistortion findCenterOfDistortion(const ViewDetections& view, cv::Size image_size,
                                          const std::optional<Eigen::Vector2d>& given) {
  const std::vector<Eigen::Vector2d> points = planePoints(view);
  const double spacing = spacingOf(points);
  if (!(spacing > 0.0)) {
    throw Error("view '" + printable(view.name, 60) + "' repeats board points");
  }
  const Eigen::Vector2d start =
      given ? *given : Eigen::Vector2d(0.5 * (image_size.width - 1), 0.5 * (image_size.height - 1));

  // Near the middle the picture is hardly distorted: board to pixels by the nearest corners.
  std::vector<std::size_t> order(points.size());
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) {
    return (view.pixels[a] - start).squaredNorm() < (view.pixels[b] - start).squaredNorm();
  });
  Eigen::Matrix<double, kLeastCorners, 3> A;
  Eigen::Matrix<double, kLeastCorners, 2> B;
  for (std::size_t i = 0; i < kLeastCorners; ++i) {
    A.row(i) << points[order[i]].x() / spacing, points[order[i]].y() / spacing, 1.0;
    B.row(i) = view.pixels[order[i]].transpose();
  }
  const Eigen::ColPivHouseholderQR<Eigen::Matrix<double, kLeastCorners, 3>> qr(A);
  const Eigen::Matrix<double, 3, 2> affine = qr.solve(B);
  const Eigen::Matrix2d local = affine.topRows<2>().transpose() / spacing;
  if (qr.rank() < 3 || !(std::abs(local.determinant()) > 0.0)) {
    throw Error("view '" + printable(view.name, 60) + "' has its middle corners on one line");
  }
  if (local.determinant() < 0.0) {
    throw Error("view '" + printable(view.name, 60) +
                "' is mirrored: the board's x and y turn the other way round in the image");
  }
  const double turn = std::atan2(local(1, 0) - local(0, 1), local(0, 0) + local(1, 1));
  const Eigen::Vector2d seen = local.inverse() * (start - affine.row(2).transpose());

  // Unknowns: what the centre sees [spacings], turn, centre.
  const auto residuals = [&](const Eigen::VectorXd& p) {
    const Eigen::Vector2d center = given ? *given : Eigen::Vector2d(p.segment<2>(3));
    const Eigen::Rotation2Dd rotation(p[2]);
    Eigen::VectorXd out(points.size());
    for (std::size_t i = 0; i < points.size(); ++i) {
      const Eigen::Vector2d w = rotation * (points[i] / spacing - p.head<2>());
      // Beside the centre a radius has no direction: its weight fades over half a spacing.
      out[i] = cross(view.pixels[i] - center, w) / std::sqrt(w.squaredNorm() + 0.25);
    }
    return out;
  };
  Eigen::VectorXd parameters(given ? 3 : 5);
  parameters.head<3>() << seen / spacing, turn;
  if (!given) parameters.tail<2>() = start;
  Eigen::VectorXd steps(parameters.size());
  steps.head<3>() << 1e-4, 1e-4, 1e-5;
  if (!given) steps.tail<2>() << 1e-2, 1e-2;
  const Minimum minimum = levenbergMarquardt(residuals, parameters, steps);

  CenterOfDistortion out;
  out.board_point = spacing * minimum.parameters.head<2>();
  out.turn = std::remainder(minimum.parameters[2], 2.0 * M_PI);
  out.rms_px = minimum.rms;
  if (given) {
    out.center = *given;
    return out;
  }
  out.center = minimum.parameters.tail<2>();
  const double half = 0.5 * std::hypot(image_size.width, image_size.height);
  const bool sure = minimum.covariance.size() > 0;
  if (sure) out.sigma = minimum.covariance.diagonal().tail<2>().cwiseMax(0.0).cwiseSqrt();
  // A centre that is known to a twentieth of the picture only is as good as none.
  if (!sure || !(similarityRms(points, view.pixels) > std::max(0.1, 3.0 * out.rms_px)) ||
      !(out.sigma.norm() < 0.05 * half) || !((out.center - start).norm() < half)) {
    throw Error("the corners of view '" + printable(view.name, 60) +
                "' do not show a centre of distortion: too little distortion, or a board far from "
                "square to the axis; give it with --center");
  }
  return out;
}

LineRadius calibrateByLines(const Detections& lines, const ProcedureOptions& options) {
  const cv::Size size = lines.image_size;
  const Eigen::Vector2d center =
      options.center.value_or(Eigen::Vector2d(0.5 * (size.width - 1), 0.5 * (size.height - 1)));
  double largest = 0.0;
  for (const ViewDetections& line : lines.views) {
    for (const Eigen::Vector2d& pixel : line.pixels) {
      largest = std::max(largest, (pixel - center).norm());
    }
  }
  if (!(largest > 0.0)) throw Error("no edge pixels to calibrate from");
  const SweepRange range = sweepRange(options, largest);

  LineRadius out;
  std::size_t points = 0;
  std::vector<double> radii;
  for (const ViewDetections& view : lines.views) {
    LineRadius::Line line;
    line.name = view.name;
    line.points = static_cast<int>(view.pixels.size());
    std::vector<Eigen::Vector2d> sensor;
    for (const Eigen::Vector2d& pixel : view.pixels) sensor.push_back(pixel - center);
    // A line through the centre is straight for every radius, and a faint bow is lost in the noise.
    constexpr std::size_t kLeastPixels = 10;
    constexpr double kLeastBow = 0.5;
    if (sensor.size() < kLeastPixels) {
      line.reason = "has fewer than " + std::to_string(kLeastPixels) + " edge pixels";
    } else if (lineDeviation(sensor) < kLeastBow) {
      line.reason = "is straight already; expected a line half way from the centre to the border";
    } else {
      std::vector<Eigen::Vector2d> dewarped(sensor.size());
      const auto deviation = [&](double radius) {
        for (std::size_t i = 0; i < sensor.size(); ++i) {
          dewarped[i] = dewarpSpherical(sensor[i], radius);
        }
        SweepStep step;
        step.radius = radius;
        step.combined = lineDeviation(dewarped);
        return step;
      };
      line.sweep = sweepRadius(range, deviation);
      if (const auto best = refineMinimum(line.sweep, &SweepStep::combined, deviation)) {
        line.radius = best->radius;
        line.deviation_px = best->combined;
        radii.push_back(best->radius);
        points += sensor.size();
      } else {
        line.reason = "is straightest at an end of the sweep";
      }
    }
    if (!line.radius) {
      out.warnings.push_back("line '" + printable(line.name, 100) + "' " + line.reason);
    }
    out.lines.push_back(std::move(line));
  }
  if (radii.empty()) {
    throw Error("no line is fit for the radius: " + out.warnings.front());
  }
  out.radius = std::accumulate(radii.begin(), radii.end(), 0.0) / radii.size();
  for (const double radius : radii) {
    if (radii.size() > 1) out.spread += std::pow(radius - out.radius, 2) / (radii.size() - 1);
  }
  out.spread = std::sqrt(out.spread);
  out.file = sphericalFile("lines", out.radius, largest, center, size, points);
  out.file.calibration.notes["lines"] =
      std::to_string(radii.size()) + " of " + std::to_string(lines.views.size());
  out.file.calibration.notes["radius_spread_px"] = formatNumber(out.spread);
  remark(kLinesRemark, out.file, out.warnings);
  return out;
}

std::vector<Eigen::Vector2d> findEdgePixels(const cv::Mat& image, cv::Rect roi) {
  const cv::Rect whole(0, 0, image.cols, image.rows);
  if (roi.empty()) roi = whole;
  if (image.empty() || (roi & whole) != roi) throw Error("the region lies outside the image");
  cv::Mat gray = image(roi);
  if (gray.channels() > 1) {
    cv::Mat single;
    cv::cvtColor(gray, single, gray.channels() == 4 ? cv::COLOR_BGRA2GRAY : cv::COLOR_BGR2GRAY);
    gray = single;
  }
  cv::Mat bytes;
  if (gray.depth() == CV_8U) {
    bytes = gray.clone();
  } else {
    cv::normalize(gray, bytes, 0, 255, cv::NORM_MINMAX, CV_8U);
  }
  cv::Mat binary;
  cv::GaussianBlur(bytes, bytes, {5, 5}, 1.0);
  const double threshold =
      cv::threshold(bytes, binary, 0, 255, cv::THRESH_BINARY | cv::THRESH_OTSU) + 0.5;
  std::vector<std::vector<cv::Point>> contours;
  cv::findContours(binary, contours, cv::RETR_LIST, cv::CHAIN_APPROX_NONE);

  // Contours close along the border of the region: keep the longest piece away from it.
  constexpr int kMargin = 4;
  const cv::Rect inside(kMargin, kMargin, roi.width - 2 * kMargin, roi.height - 2 * kMargin);
  std::vector<cv::Point> longest;
  for (const auto& contour : contours) {
    const std::size_t n = contour.size();
    std::size_t first = 0;
    while (first < n && inside.contains(contour[first])) ++first;
    std::vector<cv::Point> piece;
    for (std::size_t i = 0; i <= n; ++i) {
      const cv::Point& point = contour[(first + i) % n];
      const bool closed = first == n && i == n;
      if (inside.contains(point) && !closed) {
        piece.push_back(point);
        continue;
      }
      if (piece.size() > longest.size()) longest = piece;
      piece.clear();
    }
  }

  const auto grey = [&](const Eigen::Vector2d& at) {
    const int x = static_cast<int>(std::floor(at.x()));
    const int y = static_cast<int>(std::floor(at.y()));
    const double fx = at.x() - x, fy = at.y() - y;
    return (1 - fy) * ((1 - fx) * bytes.at<uchar>(y, x) + fx * bytes.at<uchar>(y, x + 1)) +
           fy * ((1 - fx) * bytes.at<uchar>(y + 1, x) + fx * bytes.at<uchar>(y + 1, x + 1));
  };
  std::vector<Eigen::Vector2d> edge;
  for (const cv::Point& point : longest) {
    const int x = point.x, y = point.y;
    const Eigen::Vector2d slope(bytes.at<uchar>(y, x + 1) - bytes.at<uchar>(y, x - 1),
                                bytes.at<uchar>(y + 1, x) - bytes.at<uchar>(y - 1, x));
    if (!(slope.norm() > 4.0)) continue;
    // Contour pixels are bright: the crossing lies downhill, within two pixels.
    const Eigen::Vector2d step = -0.25 * slope.normalized();
    Eigen::Vector2d at(x, y);
    double value = grey(at);
    for (int k = 0; k < 8; ++k) {
      const double next = grey(at + step);
      if (next < threshold && value >= threshold) {
        edge.emplace_back(at + step * ((value - threshold) / (value - next)) +
                          Eigen::Vector2d(roi.x, roi.y));
        break;
      }
      at += step;
      value = next;
    }
  }
  constexpr std::size_t kLeastEdge = 20;
  if (edge.size() < kLeastEdge) {
    throw Error("the region shows no edge between bright and dark of at least " +
                std::to_string(kLeastEdge) + " pixels");
  }
  return edge;
}

DotRadius calibrateByDots(const ViewDetections& detections, cv::Size image_size,
                          const ProcedureOptions& options) {
  const SquareView view = squareView(detections, image_size, options);
  DotRadius out;
  out.center = view.center;
  const auto errors = [&](double radius) {
    SweepStep step;
    step.radius = radius;
    for (std::size_t i = 0; i < view.sensor.size(); ++i) {
      const Eigen::Vector2d error = dewarpSpherical(view.sensor[i], radius) - view.ideal[i];
      step.error_x += std::abs(error.x()) / view.sensor.size();
      step.error_y += std::abs(error.y()) / view.sensor.size();
    }
    step.combined = 0.5 * (step.error_x + step.error_y);
    return step;
  };
  out.sweep = sweepRadius(sweepRange(options, view.radius), errors);
  const auto keep = [&](double SweepStep::*figure, const std::string& name) {
    if (const auto best = refineMinimum(out.sweep, figure, errors)) return *best;
    throw Error("the error " + name + " has no minimum for R from " +
                rounded(out.sweep.back().radius) + " to " + rounded(out.sweep.front().radius) +
                " px: the lens is too far from a sphere, or hardly distorts");
  };
  out.best_x = keep(&SweepStep::error_x, "along x");
  out.best_y = keep(&SweepStep::error_y, "along y");
  out.best = keep(&SweepStep::combined, "of both axes");

  std::vector<double> distances;
  for (std::size_t i = 0; i < view.sensor.size(); ++i) {
    distances.push_back((dewarpSpherical(view.sensor[i], out.best.radius) - view.ideal[i]).norm());
  }
  out.error = dewarpError(distances);
  // Ideal points beyond the last corner's own ray are still on the sphere: give them field.
  double reach = view.radius;
  for (const Eigen::Vector2d& uv : view.ideal) {
    reach = std::max(reach, out.best.radius * uv.norm() / std::hypot(uv.norm(), out.best.radius));
  }
  out.file = sphericalFile("dots", out.best.radius, reach, view.center.center, image_size,
                           view.sensor.size());
  out.rms_px = imageRms(view, *out.file.lens, out.best.radius, out.warnings);
  out.file.calibration.rms_px = out.rms_px;
  out.file.calibration.views = 1;
  out.file.calibration.notes["radius_x_px"] = formatNumber(out.best_x.radius);
  out.file.calibration.notes["radius_y_px"] = formatNumber(out.best_y.radius);
  warnOfTilt(view, out.warnings);
  remark(kSquareRemark, out.file, out.warnings);
  return out;
}

QuadricProcedure calibrateQuadric(const ViewDetections& detections, cv::Size image_size,
                                  const ProcedureOptions& options) {
  const SquareView view = squareView(detections, image_size, options);
  QuadricProcedure out;
  out.center = view.center;
  out.pixels_per_unit = view.pixels_per_unit;

  // The board's rows lie along x, or along y when it stands on its side.
  const double turn_off_axis = std::remainder(view.center.turn, M_PI / 2);
  const bool upright = std::abs(std::cos(view.center.turn)) > std::sqrt(0.5);
  if (std::abs(turn_off_axis) > 5.0 * kDegree) {
    out.warnings.push_back("the board is turned by " + rounded(turn_off_axis / kDegree) +
                           " degrees in the image: a and b are not those of the image's axes");
  }
  AxisPoints row, column;
  double extent = 0.0;
  // A row and a column: those nearest the centre, both neighbours where it falls half way between.
  const double spacing = view.spacing / view.pixels_per_unit;
  for (std::size_t i = 0; i < view.board.size(); ++i) {
    const double rho = view.ideal[i].norm();
    // Points beside the centre say nothing of R: x / u is a small number over a small number.
    if (rho < 0.75 * view.spacing) continue;
    const Eigen::Vector2d off = view.board[i].cwiseAbs() / spacing;
    constexpr double kBand = 0.55;
    if (off.y() < kBand && off.x() > off.y()) {
      (upright ? row : column).r.push_back(view.sensor[i].norm());
      (upright ? row : column).rho.push_back(rho);
      extent = std::max(extent, rho);
    } else if (off.x() < kBand && off.y() > off.x()) {
      (upright ? column : row).r.push_back(view.sensor[i].norm());
      (upright ? column : row).rho.push_back(rho);
      extent = std::max(extent, rho);
    }
  }
  out.row_points = static_cast<int>(row.r.size());
  out.column_points = static_cast<int>(column.r.size());
  if (row.r.size() < 4 || column.r.size() < 4) {
    throw Error(
        "view '" + printable(view.name, 60) + "' has " + std::to_string(row.r.size()) +
        " points beside and " + std::to_string(column.r.size()) +
        " above and below the centre of distortion, expected a row and a column of the board "
        "through it with at least 4 each");
  }

  out.R0 = solveR0(row, column, extent);
  const RadiusLines lines = fitRadiusLines(row, column, out.R0);
  out.slope_u = lines.slope_u;
  out.slope_v = lines.slope_v;
  std::tie(out.inverse_a2, out.r_squared_x) = fitHeights(row, out.R0, out.slope_u);
  std::tie(out.inverse_b2, out.r_squared_y) = fitHeights(column, out.R0, out.slope_v);
  if (!(out.inverse_a2 > 0.0) || !(out.inverse_b2 > 0.0)) {
    throw Error("the fitted surface is not an elliptic paraboloid: 1/a^2 = " +
                formatNumber(out.inverse_a2) + ", 1/b^2 = " + formatNumber(out.inverse_b2) +
                ", expected both above 0; the image hardly shows barrel distortion");
  }

  std::vector<double> distances;
  double reach = 0.0;
  for (std::size_t i = 0; i < view.sensor.size(); ++i) {
    const Eigen::Vector2d& xy = view.sensor[i];
    const double h = out.R0 - xy.x() * xy.x() * out.inverse_a2 - xy.y() * xy.y() * out.inverse_b2;
    reach = std::max({reach, std::atan2(xy.norm(), h), std::atan2(view.ideal[i].norm(), out.R0)});
    if (h > 0.0) distances.push_back((out.R0 / h * xy - view.ideal[i]).norm());  // eq. 4.17, 4.18
  }
  if (distances.size() < view.sensor.size()) {
    out.warnings.push_back(std::to_string(view.sensor.size() - distances.size()) +
                           " corners fall below the fitted surface and have no dewarped place");
  }
  if (distances.empty()) throw Error("every corner falls below the fitted surface");
  out.error = dewarpError(distances);
  out.file =
      lensFile("quadric", "quadric",
               {{"R0", {out.R0}},
                {"a", {1.0 / std::sqrt(out.inverse_a2)}},
                {"b", {1.0 / std::sqrt(out.inverse_b2)}}},
               view.center.center, std::min(reach + 1e-3, 3.0), image_size, view.sensor.size());
  out.rms_px = imageRms(view, *out.file.lens, out.R0, out.warnings);
  out.file.calibration.rms_px = out.rms_px;
  out.file.calibration.views = 1;
  out.file.calibration.notes["slope_u"] = formatNumber(out.slope_u);
  out.file.calibration.notes["slope_v"] = formatNumber(out.slope_v);
  warnOfTilt(view, out.warnings);
  remark(kSquareRemark, out.file, out.warnings);
  return out;
}

}  // namespace omnister
