// SPDX-License-Identifier: Apache-2.0
#include "omnister/lens/lens_export.h"

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <Eigen/QR>
#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <optional>

#include "lens/file/equidistant.h"
#include "lens/file/yaml_write.h"
#include "lens/foreign/foreign_models.h"
#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_import.h"

namespace omnister {
namespace {

using namespace detail;
using Eigen::Vector2d;
using Eigen::Vector3d;
using Eigen::VectorXd;

constexpr double kPi = 3.14159265358979323846;
constexpr double kInfinity = std::numeric_limits<double>::infinity();
// Models this near are as good as exact: the first of them is taken [px].
constexpr double kExact = 1e-3;
// Of models this near none is nearer: the first is taken [px].
constexpr double kSame = 1e-5;
// A sensor is sheared or turned from this share of its scale: half a pixel at the edge of a large
// image.
constexpr double kSkew = 2e-4;
// A higher degree has to lower the residual to this part.
constexpr double kEarned = 0.8;
constexpr double kLeastField = 5.0 * kPi / 180.0;  // half field of view [rad]
constexpr int kLeastDegree = 4;                    // what OCamCalib itself fits
constexpr int kMostDegree = 8;                     // more go astray just beyond the field
constexpr int kMostInverseDegree = 18;

struct Samples {
  std::vector<Vector3d> bearings;
  std::vector<Vector2d> pixels;
};

Vector3d direction(double theta, double phi) {
  return {std::sin(theta) * std::cos(phi), std::sin(theta) * std::sin(phi), std::cos(theta)};
}

Samples sampleLens(const LensModel& lens, double max_theta, int rings, int rays) {
  Samples out;
  for (int i = 0; i <= rings; ++i) {
    const double theta = max_theta * (1.0 - 1e-9) * i / rings;
    for (int j = 0; j < (i == 0 ? 1 : rays); ++j) {
      const Vector3d n = direction(theta, (j + 0.5 * (i % 2)) * 2.0 * kPi / rays);
      const auto pixel = lens.project(n);
      if (!pixel) continue;
      out.bearings.push_back(n);
      out.pixels.push_back(*pixel);
    }
  }
  return out;
}

// The farthest ray of the image's border, or the border of the field where that shows in the image.
double fieldWithinImage(const LensModel& lens, cv::Size size) {
  const double right = size.width - 0.5;
  const double bottom = size.height - 0.5;
  double out = 0.0;
  bool any = false;
  bool field_ends = false;
  const auto look = [&](double u, double v) {
    const auto ray = lens.unproject({u, v});
    if (!ray) {
      field_ends = true;
      return;
    }
    any = true;
    out = std::max(out, std::atan2(ray->head<2>().norm(), ray->z()));
  };
  constexpr int kSteps = 200;
  for (int i = 0; i <= kSteps; ++i) {
    const double u = -0.5 + (right + 0.5) * i / kSteps;
    const double v = -0.5 + (bottom + 0.5) * i / kSteps;
    look(u, -0.5);
    look(u, bottom);
    look(-0.5, v);
    look(right, v);
  }
  // The middle of the image tells a field within it from one beside it.
  look(0.5 * (size.width - 1.0), 0.5 * (size.height - 1.0));
  if (!any) throw Error("the image lies outside the field of the lens");
  return field_ends ? lens.maxTheta() : std::min(out, lens.maxTheta());
}

// ---------------------------------------------------------------- fitting

/// All pixels of a model with these numbers; false where it has none.
using Predict = std::function<bool(const VectorXd& numbers, std::vector<Vector2d>& pixels)>;

struct Bound {
  int place;
  double least, most;
};

/// Least squares by Levenberg and Marquardt. The fields of these models end where their formulas
/// do, often just past the lens' own: differences are taken to one side there.
/// @return false when not even the start has an image of every bearing
bool fitNumbers(const Samples& samples, const Predict& predict, const std::vector<Bound>& bounds,
                VectorXd& numbers) {
  const Eigen::Index count = numbers.size();
  std::vector<Vector2d> pixels;
  const auto residuals = [&](const VectorXd& trial) -> std::optional<VectorXd> {
    for (const Bound& bound : bounds) {
      if (!(trial[bound.place] >= bound.least && trial[bound.place] <= bound.most)) return {};
    }
    if (!trial.allFinite() || !predict(trial, pixels)) return std::nullopt;
    VectorXd out(2 * static_cast<Eigen::Index>(pixels.size()));
    for (std::size_t i = 0; i < pixels.size(); ++i) {
      out.segment<2>(2 * static_cast<Eigen::Index>(i)) = pixels[i] - samples.pixels[i];
    }
    return out.allFinite() ? std::optional<VectorXd>(std::move(out)) : std::nullopt;
  };
  auto now = residuals(numbers);
  if (!now) return false;
  constexpr int kMaxIterations = 300;
  constexpr double kTolerance = 1e-10;
  double damping = 1e-4;
  for (int iteration = 0; iteration < kMaxIterations; ++iteration) {
    Eigen::MatrixXd jacobian(now->size(), count);
    for (Eigen::Index k = 0; k < count; ++k) {
      const double step = 1e-6 * std::max(std::abs(numbers[k]), 1e-2);
      VectorXd high = numbers;
      VectorXd low = numbers;
      high[k] += step;
      low[k] -= step;
      auto above = residuals(high);
      auto below = residuals(low);
      if (!above && !below) return true;  // wedged in: the best there is
      if (!above) {
        above = now;
        high = numbers;
      }
      if (!below) {
        below = now;
        low = numbers;
      }
      jacobian.col(k) = (*above - *below) / (high[k] - low[k]);
    }
    // Scaled by the diagonal, so that units do not matter.
    const Eigen::MatrixXd normal = jacobian.transpose() * jacobian;
    const VectorXd gradient = jacobian.transpose() * *now;
    const VectorXd scale = normal.diagonal().cwiseMax(1e-30).cwiseSqrt().cwiseInverse();
    const Eigen::MatrixXd scaled = scale.asDiagonal() * normal * scale.asDiagonal();
    bool moved = false;
    bool converged = false;
    while (damping < 1e12 && !moved) {
      Eigen::MatrixXd damped = scaled;
      damped.diagonal().array() += damping;
      const VectorXd next =
          numbers - scale.cwiseProduct(damped.ldlt().solve(scale.cwiseProduct(gradient)));
      auto next_residuals = residuals(next);
      if (next_residuals && next_residuals->squaredNorm() < now->squaredNorm()) {
        converged =
            now->squaredNorm() - next_residuals->squaredNorm() <= kTolerance * now->squaredNorm();
        numbers = next;
        now = std::move(next_residuals);
        damping = std::max(damping * 0.1, 1e-15);
        moved = true;
      } else {
        damping *= 10.0;
      }
    }
    // Below a millionth of a pixel there is nothing to gain.
    if (!moved || converged || now->squaredNorm() <= 1e-14 * static_cast<double>(now->size())) {
      break;
    }
  }
  return true;
}

struct Measure {
  double rms = kInfinity;
  double max = kInfinity;
};

Measure measure(const Samples& samples, const ForeignProject& project) {
  double sum = 0.0;
  Measure out{0.0, 0.0};
  for (std::size_t i = 0; i < samples.bearings.size(); ++i) {
    const auto pixel = project(samples.bearings[i]);
    if (!pixel || !pixel->allFinite()) return {};
    const double error = (*pixel - samples.pixels[i]).norm();
    sum += error * error;
    out.max = std::max(out.max, error);
  }
  out.rms = std::sqrt(sum / static_cast<double>(samples.bearings.size()));
  return out;
}

bool oneToOne(const ForeignProject& project, double max_theta) {
  const auto center = project({0.0, 0.0, 1.0});
  if (!center) return false;
  constexpr int kAzimuths = 36;
  constexpr int kSteps = 200;
  for (int j = 0; j < kAzimuths; ++j) {
    double last = 0.0;
    for (int i = 1; i <= kSteps; ++i) {
      const auto pixel =
          project(direction(max_theta * (1.0 - 1e-9) * i / kSteps, j * 2.0 * kPi / kAzimuths));
      const double radius = pixel ? (*pixel - *center).norm() : 0.0;
      if (!(radius > last)) return false;
      last = radius;
    }
  }
  return true;
}

// ---------------------------------------------------------------- the models

/// What every model is fitted to.
struct Task {
  const LensFile& file;
  double max_theta;
  Samples fit;    // few, for the fit
  Samples dense;  // others, for the residual
  Vector2d center;
  Eigen::Matrix2d slope;  // d(pixel)/d(bearing) on the axis
};

/// A model fitted and written.
struct Written {
  std::string name;
  std::string text;
  std::optional<ForeignProject> other_way;  // OCamCalib's second polynomial
};

Eigen::Matrix3d cameraMatrix(const double* fu_fv_pu_pv) {
  Eigen::Matrix3d K;
  K << fu_fv_pu_pv[0], 0.0, fu_fv_pu_pv[2], 0.0, fu_fv_pu_pv[1], fu_fv_pu_pv[3], 0.0, 0.0, 1.0;
  return K;
}

Predict predictBy(const Samples& samples,
                  const std::function<ForeignProject(const VectorXd&)>& make) {
  return [&samples, make](const VectorXd& numbers, std::vector<Vector2d>& pixels) {
    const ForeignProject project = make(numbers);
    pixels.clear();
    for (const Vector3d& n : samples.bearings) {
      const auto pixel = project(n);
      if (!pixel) return false;
      pixels.push_back(*pixel);
    }
    return true;
  };
}

// fu, fv, pu, pv, k1 … k4.
std::optional<VectorXd> fitKannalaBrandt(const Task& task) {
  VectorXd numbers(8);
  if (const auto near = fitEquidistant(*task.file.lens, task.file.image_size)) {
    numbers << near->K(0, 0), near->K(1, 1), near->K(0, 2), near->K(1, 2), near->D[0], near->D[1],
        near->D[2], near->D[3];
  } else {
    numbers << task.slope(0, 0), task.slope(1, 1), task.center, 0.0, 0.0, 0.0, 0.0;
  }
  const Predict predict = predictBy(task.fit, [](const VectorXd& p) {
    return equidistantProject(cameraMatrix(p.data()), {p[4], p[5], p[6], p[7]});
  });
  if (!fitNumbers(task.fit, predict, {{0, 1e-3, 1e7}, {1, 1e-3, 1e7}}, numbers)) {
    return std::nullopt;
  }
  return numbers;
}

std::optional<Written> writeEquidistant(const Task& task) {
  const auto numbers = fitKannalaBrandt(task);
  if (!numbers) return std::nullopt;
  StandardCameraInfo info;
  info.distortion_model = "equidistant";
  info.K = cameraMatrix(numbers->data());
  info.D.assign(numbers->data() + 4, numbers->data() + 8);
  return Written{
      "equidistant", cameraInfoText(task.file.image_size, task.file.camera_name, info), {}};
}

// The best fit that is one-to-one over the field, from several starts.
std::optional<VectorXd> nearest(const Task& task, const std::vector<VectorXd>& starts,
                                const std::vector<Bound>& bounds,
                                const std::function<ForeignProject(const VectorXd&)>& make) {
  std::optional<VectorXd> best;
  double best_rms = kInfinity;
  const Predict predict = predictBy(task.fit, make);
  for (const VectorXd& start : starts) {
    if (best_rms < kExact) break;
    VectorXd numbers = start;
    if (!fitNumbers(task.fit, predict, bounds, numbers)) continue;
    const ForeignProject project = make(numbers);
    const double rms = measure(task.fit, project).rms;
    if (rms < best_rms && oneToOne(project, task.max_theta)) {
      best = numbers;
      best_rms = rms;
    }
  }
  return best;
}

std::optional<Written> writeKalibr(const Task& task, const std::string& model) {
  const auto write = [&](const char* camera_model, std::vector<double> intrinsics,
                         const char* distortion, const std::vector<double>& coefficients) {
    const cv::Size size = task.file.image_size;
    return Written{
        model,
        std::string("cam0:\n  cam_overlaps: []\n  camera_model: ") + camera_model +
            "\n  distortion_coeffs: " + yamlFlow(coefficients) +
            "\n  distortion_model: " + distortion + "\n  intrinsics: " + yamlFlow(intrinsics) +
            "\n  resolution: [" + std::to_string(size.width) + ", " + std::to_string(size.height) +
            "]\n  rostopic: " + yamlText("/" + task.file.camera_name + "/image_raw") + "\n",
        {}};
  };
  const double fu = task.slope(0, 0);
  const double fv = task.slope(1, 1);
  const double pu = task.center.x();
  const double pv = task.center.y();
  // Each starts stereographic, which all of these can say and which has no end before 180 degrees.
  if (model == "pinhole-equidistant") {
    const auto p = fitKannalaBrandt(task);
    if (!p) return std::nullopt;
    return write("pinhole", {p->data(), p->data() + 4}, "equidistant",
                 {p->data() + 4, p->data() + 8});
  }
  if (model == "eucm") {
    VectorXd p(6);
    p << 0.5, 1.0, fu, fv, pu, pv;
    const Predict predict = predictBy(task.fit, [](const VectorXd& q) {
      return eucmProject(cameraMatrix(q.data() + 2), q[0], q[1]);
    });
    if (!fitNumbers(task.fit, predict,
                    {{0, 0.0, 1.0}, {1, 1e-3, 1e3}, {2, 1e-3, 1e7}, {3, 1e-3, 1e7}}, p)) {
      return std::nullopt;
    }
    return write("eucm", {p.data(), p.data() + 6}, "none", {});
  }
  // Two numbers that bend alike make several valleys: each is tried from its own start.
  if (model == "ds") {
    std::vector<VectorXd> starts;
    for (const double xi : {0.0, -0.25, 0.5, 1.5}) {
      starts.emplace_back(6);
      starts.back() << xi, 0.5, (1.0 + xi) * fu, (1.0 + xi) * fv, pu, pv;
    }
    const auto p =
        nearest(task, starts, {{0, -0.99, 9.9}, {1, 0.0, 1.0}, {2, 1e-3, 1e7}, {3, 1e-3, 1e7}},
                [](const VectorXd& q) {
                  return doubleSphereProject(cameraMatrix(q.data() + 2), q[0], q[1]);
                });
    if (!p) return std::nullopt;
    return write("ds", {p->data(), p->data() + 6}, "none", {});
  }
  std::vector<VectorXd> starts;
  for (const double xi : {1.0, 0.4, 2.0, 3.0}) {
    starts.emplace_back(9);
    starts.back() << xi, (1.0 + xi) * fu, (1.0 + xi) * fv, pu, pv, 0.0, 0.0, 0.0, 0.0;
  }
  const auto p = nearest(
      task, starts, {{0, -0.99, 100.0}, {1, 1e-3, 1e7}, {2, 1e-3, 1e7}}, [](const VectorXd& q) {
        return omniProject(cameraMatrix(q.data() + 1), q[0], openCvBend({q[5], q[6], q[7], q[8]}));
      });
  if (!p) return std::nullopt;
  return write("omni", {p->data(), p->data() + 5}, "radtan", {p->data() + 5, p->data() + 9});
}

double polynomialAt(const Numbers& coefficients, double x) {
  double out = 0.0;
  for (auto k = coefficients.rbegin(); k != coefficients.rend(); ++k) out = out * x + *k;
  return out;
}

// OCamCalib's numbers as they are fitted: row and column of the centre, c, d, e, then the direct
// polynomial's coefficients 0, 2, 3, … in units of `length`, which keeps all of them near one.
OcamNumbers ocamNumbers(const VectorXd& p, double length) {
  OcamNumbers out;
  out.center_row = p[0];
  out.center_col = p[1];
  out.c = p[2];
  out.d = p[3];
  out.e = p[4];
  out.polynomial = {p[5] * length, 0.0};
  for (int i = 6; i < p.size(); ++i) {
    out.polynomial.push_back(p[i] * std::pow(length, 1 - (i - 4)));
  }
  return out;
}

// Distance from the centre on OCamCalib's plane, its affinity undone [px].
double ocamRadius(const OcamNumbers& ocam, const Vector2d& pixel) {
  Eigen::Matrix2d affine;
  affine << ocam.c, ocam.d, ocam.e, 1.0;
  return (affine.inverse() * Vector2d(pixel.y() - ocam.center_row, pixel.x() - ocam.center_col))
      .norm();
}

Vector2d ocamPixel(const OcamNumbers& ocam, const Vector3d& n, double rho) {
  const double s = n.head<2>().norm();
  const Vector2d m = s > 0.0 ? Vector2d(n.head<2>() * (rho / s)) : Vector2d(0.0, 0.0);
  return {ocam.e * m.y() + m.x() + ocam.center_col,
          ocam.c * m.y() + ocam.d * m.x() + ocam.center_row};
}

// Solves rho cos(theta) + f(rho) sin(theta) = 0 from the radius of the pixel that is wanted: smooth
// in the numbers, and faster than the importer's search.
Predict predictOcam(const Samples& samples, double length) {
  return [&samples, length](const VectorXd& numbers, std::vector<Vector2d>& pixels) {
    const OcamNumbers ocam = ocamNumbers(numbers, length);
    if (!(ocam.c - ocam.d * ocam.e > 0.1) || !(ocam.polynomial[0] < 0.0)) return false;
    pixels.clear();
    for (std::size_t i = 0; i < samples.bearings.size(); ++i) {
      const Vector3d& n = samples.bearings[i];
      const double s = n.head<2>().norm();
      double rho = ocamRadius(ocam, samples.pixels[i]);
      bool found = false;
      for (int step = 0; step < 30 && !found; ++step) {
        double f = 0.0;
        double slope = 0.0;
        for (auto k = ocam.polynomial.rbegin(); k != ocam.polynomial.rend(); ++k) {
          slope = slope * rho + f;
          f = f * rho + *k;
        }
        const double change = (rho * n.z() + f * s) / (n.z() + slope * s);
        rho -= change;
        if (!std::isfinite(rho)) return false;
        found = std::abs(change) <= 1e-12 * length;
      }
      if (!found || rho < -1e-9 * length) return false;
      pixels.push_back(ocamPixel(ocam, n, rho));
    }
    return true;
  };
}

// rho as a polynomial of OCamCalib's angle, theta - pi/2.
Numbers inverseOcam(const OcamNumbers& ocam, const Task& task) {
  constexpr int kPoints = 400;
  const ForeignProject project =
      ocamProject(ocam, 2.0 * std::hypot(task.file.image_size.width, task.file.image_size.height));
  VectorXd angles(kPoints + 1);
  VectorXd radii(kPoints + 1);
  for (int i = 0; i <= kPoints; ++i) {
    const double theta = task.max_theta * (1.0 - 1e-9) * i / kPoints;
    const auto pixel = project(direction(theta, 0.0));
    if (!pixel) return {};
    angles[i] = theta - 0.5 * kPi;
    radii[i] = ocamRadius(ocam, *pixel);
  }
  Numbers best;
  double best_error = kInfinity;
  for (int degree = 4; degree <= kMostInverseDegree && best_error > kExact; ++degree) {
    Eigen::MatrixXd powers(kPoints + 1, degree + 1);
    powers.col(0).setOnes();
    for (int k = 1; k <= degree; ++k) powers.col(k) = powers.col(k - 1).cwiseProduct(angles);
    const VectorXd solution = powers.colPivHouseholderQr().solve(radii);
    const Numbers candidate(solution.data(), solution.data() + solution.size());
    double error = 0.0;
    for (int i = 0; i <= kPoints; ++i) {
      error = std::max(error, std::abs(polynomialAt(candidate, angles[i]) - radii[i]));
    }
    if (error < kEarned * best_error) {
      best = candidate;
      best_error = error;
    }
  }
  return best;
}

std::optional<Written> writeOcam(const Task& task, int degree) {
  // On the axis [u; v] moves by slope * (right, down), so slope = [1, e; d, c] * |f(0)|.
  const double focal = task.slope(0, 0);
  VectorXd numbers(degree + 5);
  numbers << task.center.y(), task.center.x(), task.slope(1, 1) / focal, task.slope(1, 0) / focal,
      task.slope(0, 1) / focal, VectorXd::Zero(degree);
  OcamNumbers ocam = ocamNumbers(numbers, 1.0);
  if (!(ocam.c - ocam.d * ocam.e > 0.1)) return std::nullopt;
  VectorXd radii(task.fit.pixels.size());
  for (int i = 0; i < radii.size(); ++i) radii[i] = ocamRadius(ocam, task.fit.pixels[i]);
  const double length = radii.maxCoeff();
  // With the affinity of the axis the polynomial is a linear problem.
  Eigen::MatrixXd left(radii.size(), degree);
  VectorXd right(radii.size());
  for (int i = 0; i < radii.size(); ++i) {
    const Vector3d& n = task.fit.bearings[i];
    const double rho = radii[i] / length;
    const double s = n.head<2>().norm();
    for (int k = 0; k < degree; ++k) left(i, k) = s * std::pow(rho, k == 0 ? 0 : k + 1);
    right[i] = -rho * n.z();
  }
  numbers.tail(degree) = left.colPivHouseholderQr().solve(right);
  if (!fitNumbers(task.fit, predictOcam(task.fit, length), {}, numbers)) return std::nullopt;
  ocam = ocamNumbers(numbers, length);
  const Numbers inverse = inverseOcam(ocam, task);
  if (inverse.empty()) return std::nullopt;

  const auto polynomial = [](const Numbers& coefficients) {
    std::string out = std::to_string(coefficients.size());
    for (const double k : coefficients) out += " " + formatNumber(k);
    return out;
  };
  Written out;
  out.name = "ocam";
  out.text =
      "#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB). These "
      "are used by cam2world\n\n" +
      polynomial(ocam.polynomial) +
      "\n\n#polynomial coefficients for the inverse mapping function (ocam_model.invpol in "
      "MATLAB). "
      "These are used by world2cam\n\n" +
      polynomial(inverse) +
      "\n\n#center: \"row\" and \"column\", starting from 0 (C convention)\n\n" +
      formatNumber(ocam.center_row) + " " + formatNumber(ocam.center_col) +
      "\n\n#affine parameters \"c\", \"d\", \"e\"\n\n" + formatNumber(ocam.c) + " " +
      formatNumber(ocam.d) + " " + formatNumber(ocam.e) +
      "\n\n#image size: \"height\" and \"width\"\n\n" +
      std::to_string(task.file.image_size.height) + " " +
      std::to_string(task.file.image_size.width) + "\n";
  out.other_way = [ocam, inverse](const Vector3d& n) -> std::optional<Vector2d> {
    const double s = n.head<2>().norm();
    const double rho = s > 0.0 ? polynomialAt(inverse, -std::atan2(n.z(), s)) : 0.0;
    return ocamPixel(ocam, n, rho);
  };
  return out;
}

// The residual of a file as any reader finds it; infinite where it says no lens over the field.
Measure measureWritten(const Task& task, const Written& written) {
  ForeignCamera camera;
  try {
    camera = readForeignCamera(written.text, written.name);
  } catch (const InputError&) {
    return {};  // numbers out of the range that the format allows
  }
  if (!oneToOne(camera.project, task.max_theta)) return {};
  Measure out = measure(task.dense, camera.project);
  if (written.other_way) {
    const Measure other = measure(task.dense, *written.other_way);
    out.rms = std::max(out.rms, other.rms);
    out.max = std::max(out.max, other.max);
  }
  return out;
}

}  // namespace

const std::vector<std::string>& exportFormats() {
  static const std::vector<std::string> kNames{"kalibr", "ocam", "equidistant"};
  return kNames;
}

const std::vector<std::string>& kalibrExportModels() {
  static const std::vector<std::string> kNames{"pinhole-equidistant", "eucm", "ds", "omni-radtan"};
  return kNames;
}

LensExport exportLens(const LensFile& file, std::string_view format, std::string_view model,
                      std::optional<double> narrowed_theta) {
  const LensModel& lens = *file.lens;
  double max_theta = fieldWithinImage(lens, file.image_size);
  if (narrowed_theta) {
    if (!(*narrowed_theta >= kLeastField)) {
      throw Error("a field of " + formatNumber(*narrowed_theta * 180.0 / kPi) +
                  " degrees off the axis is too narrow, expected 5 or more");
    }
    max_theta = std::min(max_theta, *narrowed_theta);
  }
  Jacobian23 slope;
  const auto center = lens.project({0.0, 0.0, 1.0}, &slope);
  if (!center || !(slope(0, 0) > 0.0) || !(slope(1, 1) > 0.0)) {
    throw Error("the sensor is turned by 90 degrees or more, which no foreign model says");
  }
  const Task task{file,
                  max_theta,
                  sampleLens(lens, max_theta, 40, 24),
                  sampleLens(lens, max_theta, 97, 60),
                  *center,
                  slope.leftCols<2>()};

  LensExport out;
  out.max_theta_rad = max_theta;
  out.residual_rms_px = out.residual_max_px = kInfinity;
  // Takes a candidate that is clearly better.
  const auto consider = [&](const std::optional<Written>& written, double part, double exact) {
    const Measure found = written ? measureWritten(task, *written) : Measure{};
    if (found.rms < part * out.residual_rms_px && out.residual_rms_px > exact) {
      out.text = written->text;
      out.model = written->name;
      out.residual_rms_px = found.rms;
      out.residual_max_px = found.max;
    }
    return found.rms;
  };
  if (format == "kalibr") {
    const auto& names = kalibrExportModels();
    if (!model.empty() && std::find(names.begin(), names.end(), model) == names.end()) {
      throw Error("no Kalibr model is called \"" + printable(model) + "\"");
    }
    for (const std::string& name : names) {
      if (!model.empty() && name != model) continue;
      out.tried.emplace_back(name, consider(writeKalibr(task, name), 1.0, kSame));
    }
  } else if (format == "ocam") {
    for (int degree = kLeastDegree; degree <= kMostDegree; ++degree) {
      consider(writeOcam(task, degree), kEarned, kExact);
    }
    out.tried.emplace_back("ocam", out.residual_rms_px);
  } else if (format == "equidistant") {
    out.tried.emplace_back("equidistant", consider(writeEquidistant(task), 1.0, kExact));
  } else {
    throw Error("no export format is called \"" + printable(format) + "\"");
  }
  if (out.text.empty()) {
    throw Error("no " + std::string(model.empty() ? format : model) +
                " camera is one-to-one and near this lens over its field of " +
                formatNumber(std::round(max_theta * 1800.0 / kPi) / 10.0) +
                " degrees off the axis");
  }
  // Only OCamCalib has an affinity with shear and turn.
  const double skew = std::max(std::abs(slope(0, 1)), std::abs(slope(1, 0))) / slope(0, 0);
  if (out.model != "ocam" && skew > kSkew) {
    out.remarks.push_back("the sensor's shear or turn (" +
                          formatNumber(std::round(1e6 * slope(0, 1) / slope(0, 0)) / 1e6) + ", " +
                          formatNumber(std::round(1e6 * slope(1, 0) / slope(0, 0)) / 1e6) +
                          " of its scale) is left out, " + out.model +
                          " has none: that is part of the residual; --format ocam can say it");
  }
  return out;
}

std::optional<LensExport> exportWidest(const LensFile& file, std::string_view format,
                                       std::string_view model, double max_residual_px) {
  const auto attempt = [&](double theta) -> std::optional<LensExport> {
    try {
      LensExport made = exportLens(file, format, model, theta);
      if (made.residual_rms_px <= max_residual_px) return made;
    } catch (const Error&) {
      // No model of the format over this field.
    }
    return std::nullopt;
  };
  const double whole = fieldWithinImage(*file.lens, file.image_size);
  double good = 10.0 * kPi / 180.0;
  if (good >= whole) return attempt(whole);
  std::optional<LensExport> best = attempt(good);
  if (!best) return std::nullopt;
  if (auto all = attempt(whole)) return all;
  double bad = whole;
  while (bad - good > 0.25 * kPi / 180.0) {
    const double middle = 0.5 * (good + bad);
    if (auto made = attempt(middle)) {
      best = std::move(made);
      good = middle;
    } else {
      bad = middle;
    }
  }
  return best;
}

}  // namespace omnister
