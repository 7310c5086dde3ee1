// SPDX-License-Identifier: Apache-2.0
#include "omnister/lens/lens_fit.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>

#include "omnister/common/error.h"

namespace omnister {
namespace {

struct Normal {
  Eigen::MatrixXd matrix;
  Eigen::VectorXd gradient;
};

// Sum of squared errors; nullopt when some bearing has no image.
std::optional<double> cost(const LensModel& lens, const std::vector<Eigen::Vector3d>& bearings,
                           const std::vector<Eigen::Vector2d>& pixels, double* largest = nullptr) {
  double sum = 0.0;
  double max = 0.0;
  for (std::size_t i = 0; i < bearings.size(); ++i) {
    const auto pixel = lens.project(bearings[i]);
    if (!pixel) return std::nullopt;
    const double square = (*pixel - pixels[i]).squaredNorm();
    sum += square;
    max = std::max(max, square);
  }
  if (largest != nullptr) *largest = std::sqrt(max);
  if (!std::isfinite(sum)) return std::nullopt;
  return sum;
}

Normal normalEquations(const LensModel& lens, const std::vector<Eigen::Vector3d>& bearings,
                       const std::vector<Eigen::Vector2d>& pixels, int first, int count) {
  Normal out{Eigen::MatrixXd::Zero(count, count), Eigen::VectorXd::Zero(count)};
  JacobianParams d_parameters;
  for (std::size_t i = 0; i < bearings.size(); ++i) {
    const auto pixel = lens.project(bearings[i], nullptr, &d_parameters);
    if (!pixel) continue;
    const auto J = d_parameters.middleCols(first, count);
    out.matrix.selfadjointView<Eigen::Lower>().rankUpdate(J.transpose());
    out.gradient += J.transpose() * (*pixel - pixels[i]);
  }
  out.matrix = out.matrix.selfadjointView<Eigen::Lower>();
  return out;
}

}  // namespace

LensFit fitLens(const LensModel& start, const std::vector<Eigen::Vector3d>& bearings,
                const std::vector<Eigen::Vector2d>& pixels, const LensFitOptions& options) {
  if (bearings.empty() || bearings.size() != pixels.size()) {
    throw Error("fitting a lens to " + std::to_string(bearings.size()) + " bearings and " +
                std::to_string(pixels.size()) + " pixels, expected as many of both");
  }
  Eigen::VectorXd values = start.parameters();
  const int first = options.first_parameter;
  const int count =
      options.parameters < 0 ? static_cast<int>(values.size()) - first : options.parameters;
  LensFit out;
  out.lens = start.withParameters(values);
  auto now = out.lens ? cost(*out.lens, bearings, pixels) : std::nullopt;
  if (!now) throw Error("fitting a lens: a bearing lies outside the field of the starting lens");

  double damping = 1e-4;
  for (out.iterations = 0; out.iterations < options.max_iterations; ++out.iterations) {
    const Normal normal = normalEquations(*out.lens, bearings, pixels, first, count);
    // Scaled by the diagonal, so that units do not matter.
    const Eigen::VectorXd scale =
        normal.matrix.diagonal().cwiseMax(1e-30).cwiseSqrt().cwiseInverse();
    const Eigen::MatrixXd scaled = scale.asDiagonal() * normal.matrix * scale.asDiagonal();
    bool moved = false;
    bool converged = false;
    while (damping < 1e12) {
      Eigen::MatrixXd damped = scaled;
      damped.diagonal().array() += damping;
      const Eigen::VectorXd step =
          -(scale.cwiseProduct(damped.ldlt().solve(scale.cwiseProduct(normal.gradient))));
      Eigen::VectorXd next_values = values;
      next_values.segment(first, count) += step;
      LensPtr next = step.allFinite() ? out.lens->withParameters(next_values) : nullptr;
      const auto next_cost = next ? cost(*next, bearings, pixels) : std::nullopt;
      if (next_cost && *next_cost < *now) {
        converged = *now - *next_cost <= options.tolerance * *now;
        values = next_values;
        out.lens = std::move(next);
        now = next_cost;
        damping = std::max(damping * 0.1, 1e-15);
        moved = true;
        break;
      }
      damping *= 10.0;
    }
    if (!moved || converged || *now <= 1e-26 * static_cast<double>(bearings.size())) break;
  }
  out.rms_px = std::sqrt(*cost(*out.lens, bearings, pixels, &out.max_px) /
                         static_cast<double>(bearings.size()));
  return out;
}

}  // namespace omnister
