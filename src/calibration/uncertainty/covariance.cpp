// SPDX-License-Identifier: Apache-2.0
#include "calibration/uncertainty/covariance.h"

#include <Eigen/Eigenvalues>
#include <algorithm>

namespace omnister::calibration {

Eigen::MatrixXd sharedCovariance(const std::vector<BundleView>& views, const BundleOptions& options,
                                 const BundleState& state, double loss_px, double least_sigma_px) {
  const Eigen::MatrixXd information = reducedInformation(views, options, state);
  // Parameters differ by many orders of magnitude: bring the diagonal to one, and let a direction
  // that nothing determines have a variance that is huge but finite.
  Eigen::VectorXd scale = information.diagonal().cwiseMax(0.0).cwiseSqrt();
  const double largest = scale.maxCoeff();
  for (Eigen::Index i = 0; i < scale.size(); ++i) {
    if (!(scale[i] > 1e-12 * largest)) scale[i] = 1e-12 * std::max(largest, 1e-300);
  }
  const Eigen::MatrixXd scaled =
      scale.cwiseInverse().asDiagonal() * information * scale.cwiseInverse().asDiagonal();
  const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> solver(scaled);
  const Eigen::VectorXd inverse = solver.eigenvalues().cwiseMax(1e-14).cwiseInverse();
  Eigen::MatrixXd covariance =
      solver.eigenvectors() * inverse.asDiagonal() * solver.eigenvectors().transpose();
  covariance = scale.cwiseInverse().asDiagonal() * covariance * scale.cwiseInverse().asDiagonal();

  // Variance of a robust estimate: E[psi^2] / E[psi']^2 per coordinate.
  double psi_squared = 0.0;
  double psi_slope = 0.0;
  double count = 0.0;
  for (const BundleView& view : views) {
    for (const Eigen::Vector2d& residual : residualsOf(view, state)) {
      const double s = residual.squaredNorm();
      const double weight = cauchyWeight(s, loss_px);
      psi_squared += 0.5 * weight * weight * s;
      // rho'(s) + s rho''(s), the mean of psi' over the two coordinates
      psi_slope += loss_px > 0.0 ? weight - s / (loss_px * loss_px) * weight * weight : 1.0;
      count += 1.0;
    }
  }
  std::vector<bool> used_pose(state.poses.size(), false);
  for (const BundleView& view : views) used_pose[view.pose] = true;
  const double unknowns =
      static_cast<double>(information.rows()) +
      6.0 * static_cast<double>(std::count(used_pose.begin(), used_pose.end(), true));
  const double freedom = std::max(1.0, 2.0 * count - unknowns) / (2.0 * count);
  const double slope = std::max(psi_slope / count, 0.05);
  const double variance =
      std::max(psi_squared / count / freedom / (slope * slope), least_sigma_px * least_sigma_px);
  return variance * covariance;
}

Eigen::MatrixXd lensCovariance(const std::vector<BundleView>& views, const BundleOptions& options,
                               const BundleState& state, double loss_px, int camera,
                               double least_sigma_px) {
  Eigen::Index first = 0;
  for (int i = 0; i < camera; ++i)
    first += state.lenses[static_cast<std::size_t>(i)]->parameters().size();
  const Eigen::Index size = state.lenses[static_cast<std::size_t>(camera)]->parameters().size();
  return sharedCovariance(views, options, state, loss_px, least_sigma_px)
      .block(first, first, size, size);
}

}  // namespace omnister::calibration
