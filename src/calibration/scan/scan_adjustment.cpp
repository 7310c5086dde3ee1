// SPDX-License-Identifier: Apache-2.0
#include "calibration/scan/scan_adjustment.h"

#include <ceres/ceres.h>
#include <ceres/evaluation_callback.h>

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <utility>

#include "calibration/fit/bundle.h"
#include "calibration/fit/pose_block.h"

namespace omnister::calibration {
namespace {

using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

constexpr double kNowherePx = 1e3;
/// Corners of boards are less exact than features measured through the lens: their loss never
/// becomes as narrow.
constexpr double kCornerLossPx = 0.5;
/// Off-axis angle at which the slope on the axis is taken [rad].
constexpr double kAxisAngle = 0.02;

class Blocks : public ceres::EvaluationCallback {
 public:
  explicit Blocks(const ScanEstimate& start) : start_(start), lens_block(start.lens->parameters()) {
    axis = start.axis;
    for (const Pose& pose : start.T_scan) scan_blocks.push_back(blockOf(pose));
    for (const Pose& pose : start.T_camera_board) board_blocks.push_back(blockOf(pose));
    points = start.points;
    prepare();
  }

  void PrepareForEvaluation(bool, bool new_point) override {
    if (new_point) prepare();
  }

  void prepare() {
    lens = start_.lens->withParameters(lens_block);
    scans.clear();
    for (const Vector6d& block : scan_blocks) scans.emplace_back(block.data());
    boards.clear();
    for (const Vector6d& block : board_blocks) boards.emplace_back(block.data());
  }

  std::optional<ScanEstimate> estimate() const {
    ScanEstimate result;
    result.lens = start_.lens->withParameters(lens_block);
    if (!result.lens) return std::nullopt;
    result.axis = axis.normalized();
    for (const Vector6d& block : scan_blocks) result.T_scan.push_back(poseOf(block));
    for (const Vector6d& block : board_blocks) result.T_camera_board.push_back(poseOf(block));
    result.points = points;
    return result;
  }

 private:
  const ScanEstimate& start_;

 public:
  Eigen::VectorXd lens_block;
  Eigen::Vector3d axis;
  std::vector<Vector6d> scan_blocks;
  std::vector<Vector6d> board_blocks;
  std::vector<Eigen::Vector3d> points;

  LensPtr lens;  ///< null where the parameters make none
  std::vector<PoseValue> scans;
  std::vector<PoseValue> boards;
};

void store(double** jacobians, int block, const Eigen::Ref<const Eigen::MatrixXd>& derivative) {
  if (jacobians == nullptr || jacobians[block] == nullptr) return;
  Eigen::Map<RowMajor>(jacobians[block], derivative.rows(), derivative.cols()) = derivative;
}

/// Blocks: lens, axis, scan pose, point.
class PointCost : public ceres::CostFunction {
 public:
  PointCost(const ScanObservation& observation, const Blocks& blocks)
      : observation_(observation), blocks_(blocks) {
    set_num_residuals(2);
    *mutable_parameter_block_sizes() = {static_cast<int>(blocks.lens_block.size()), 3, 6, 3};
  }

  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override {
    if (!blocks_.lens) return false;
    const PoseValue& pose = blocks_.scans[observation_.scan];
    const Eigen::Map<const Eigen::Vector3d> axis(parameters[1]);
    const Eigen::Map<const Eigen::Vector3d> point(parameters[3]);
    const Eigen::Vector3d X = pose.R * point + pose.t - observation_.travel * axis;
    Jacobian23 d_bearing = Jacobian23::Zero();
    JacobianParams d_lens;
    const auto pixel = projectContinued(*blocks_.lens, X, jacobians ? &d_bearing : nullptr,
                                        jacobians ? &d_lens : nullptr);
    Eigen::Map<Eigen::Vector2d> residual(residuals);
    if (pixel) {
      residual = *pixel - observation_.pixel;
    } else {
      residual = Eigen::Vector2d(kNowherePx, 0.0);
      d_bearing.setZero();
      d_lens.setZero(2, blocks_.lens_block.size());
    }
    residual *= observation_.weight;
    if (jacobians == nullptr) return true;
    d_bearing *= observation_.weight;
    store(jacobians, 0, observation_.weight * d_lens);
    store(jacobians, 1, -observation_.travel * d_bearing);
    Eigen::Matrix<double, 2, 6> d_pose;
    d_pose.leftCols<3>() = -d_bearing * pose.R * crossMatrix(point) * pose.right_jacobian;
    d_pose.rightCols<3>() = d_bearing;
    store(jacobians, 2, d_pose);
    store(jacobians, 3, d_bearing * pose.R);
    return true;
  }

 private:
  const ScanObservation& observation_;
  const Blocks& blocks_;
};

/// Blocks: lens, board pose. One corner.
class CornerCost : public ceres::CostFunction {
 public:
  CornerCost(const Eigen::Vector2d& pixel, const Eigen::Vector3d& point, int view,
             const Blocks& blocks)
      : pixel_(pixel), point_(point), view_(view), blocks_(blocks) {
    set_num_residuals(2);
    *mutable_parameter_block_sizes() = {static_cast<int>(blocks.lens_block.size()), 6};
  }

  bool Evaluate(double const* const*, double* residuals, double** jacobians) const override {
    if (!blocks_.lens) return false;
    const PoseValue& pose = blocks_.boards[view_];
    Jacobian23 d_bearing = Jacobian23::Zero();
    JacobianParams d_lens;
    const auto pixel =
        projectContinued(*blocks_.lens, pose.R * point_ + pose.t, jacobians ? &d_bearing : nullptr,
                         jacobians ? &d_lens : nullptr);
    Eigen::Map<Eigen::Vector2d> residual(residuals);
    if (pixel) {
      residual = *pixel - pixel_;
    } else {
      residual = Eigen::Vector2d(kNowherePx, 0.0);
      d_bearing.setZero();
      d_lens.setZero(2, blocks_.lens_block.size());
    }
    if (jacobians == nullptr) return true;
    store(jacobians, 0, d_lens);
    Eigen::Matrix<double, 2, 6> d_pose;
    d_pose.leftCols<3>() = -d_bearing * pose.R * crossMatrix(point_) * pose.right_jacobian;
    d_pose.rightCols<3>() = d_bearing;
    store(jacobians, 1, d_pose);
    return true;
  }

 private:
  Eigen::Vector2d pixel_;
  Eigen::Vector3d point_;
  int view_;
  const Blocks& blocks_;
};

/// Holds log of the slope on the axis at a value; a gauge, not a measurement.
class SlopePin : public ceres::CostFunction {
 public:
  SlopePin(double slope, double weight, const Blocks& blocks)
      : slope_(slope), weight_(weight), blocks_(blocks) {
    set_num_residuals(1);
    *mutable_parameter_block_sizes() = {static_cast<int>(blocks.lens_block.size())};
  }

  bool Evaluate(double const* const*, double* residuals, double** jacobians) const override {
    if (!blocks_.lens) return false;
    Eigen::RowVectorXd gradient;
    const double slope = axisSlope(*blocks_.lens, jacobians ? &gradient : nullptr);
    if (!(slope > 0.0)) return false;
    residuals[0] = weight_ * std::log(slope / slope_);
    if (jacobians != nullptr) store(jacobians, 0, weight_ / slope * gradient);
    return true;
  }

 private:
  double slope_;
  double weight_;
  const Blocks& blocks_;
};

/// Angle between two unprojected pixels. With n(pixel, p) and project(n, p) = pixel fixed,
/// dn/dp = -(dn/dpixel) (dpixel/dp).
class AngleCost : public ceres::CostFunction {
 public:
  AngleCost(const KnownAngle& known, const Blocks& blocks) : known_(known), blocks_(blocks) {
    set_num_residuals(1);
    *mutable_parameter_block_sizes() = {static_cast<int>(blocks.lens_block.size())};
  }

  bool Evaluate(double const* const*, double* residuals, double** jacobians) const override {
    if (!blocks_.lens) return false;
    Jacobian32 d_first, d_second;
    const auto first = blocks_.lens->unproject(known_.first, &d_first);
    const auto second = blocks_.lens->unproject(known_.second, &d_second);
    if (!first || !second) return false;
    const double angle = std::atan2(first->cross(*second).norm(), first->dot(*second));
    residuals[0] = kWeight * (angle - known_.angle);
    if (jacobians == nullptr) return true;
    JacobianParams p_first, p_second;
    if (!blocks_.lens->project(*first, nullptr, &p_first) ||
        !blocks_.lens->project(*second, nullptr, &p_second)) {
      return false;
    }
    const double s = std::max(std::sin(angle), 1e-9);
    const Eigen::RowVectorXd gradient =
        (second->transpose() * d_first * p_first + first->transpose() * d_second * p_second) / s;
    store(jacobians, 0, kWeight * gradient);
    return true;
  }

 private:
  /// The angle is taken as known to 1e-5 rad.
  static constexpr double kWeight = 1e5;
  KnownAngle known_;
  const Blocks& blocks_;
};

}  // namespace

double axisSlope(const LensModel& lens, Eigen::RowVectorXd* d_parameters) {
  JacobianParams d_off, d_on;
  const auto off = lens.project(Eigen::Vector3d(std::sin(kAxisAngle), 0.0, std::cos(kAxisAngle)),
                                nullptr, d_parameters ? &d_off : nullptr);
  const auto on = lens.project(Eigen::Vector3d::UnitZ(), nullptr, d_parameters ? &d_on : nullptr);
  if (!off || !on) return std::numeric_limits<double>::quiet_NaN();
  if (d_parameters != nullptr) *d_parameters = (d_off.row(0) - d_on.row(0)) / kAxisAngle;
  return (off->x() - on->x()) / kAxisAngle;
}

std::optional<double> adjust(const ScanData& data, const AdjustOptions& options,
                             ScanEstimate& estimate) {
  Blocks blocks(estimate);
  ceres::Problem::Options problem_options;
  problem_options.evaluation_callback = &blocks;
  ceres::Problem problem(problem_options);
  auto ordering = std::make_shared<ceres::ParameterBlockOrdering>();
  std::vector<bool> scan_used(blocks.scan_blocks.size(), false);
  std::vector<bool> point_used(blocks.points.size(), false);
  double* lens = blocks.lens_block.data();
  for (const ScanObservation& o : data.observations) {
    problem.AddResidualBlock(new PointCost(o, blocks), new ceres::CauchyLoss(options.loss_px), lens,
                             blocks.axis.data(), blocks.scan_blocks[o.scan].data(),
                             blocks.points[o.point].data());
    scan_used[o.scan] = true;
    point_used[o.point] = true;
  }
  if (data.observations.empty()) return std::nullopt;
  for (std::size_t i = 0; i < blocks.points.size(); ++i) {
    if (point_used[i]) ordering->AddElementToGroup(blocks.points[i].data(), 0);
  }
  ordering->AddElementToGroup(lens, 1);
  ordering->AddElementToGroup(blocks.axis.data(), 1);
  problem.SetManifold(blocks.axis.data(), new ceres::SphereManifold<3>());
  for (std::size_t s = 0; s < blocks.scan_blocks.size(); ++s) {
    if (!scan_used[s]) continue;
    ordering->AddElementToGroup(blocks.scan_blocks[s].data(), 1);
    if (s == 0 || !options.scans) problem.SetParameterBlockConstant(blocks.scan_blocks[s].data());
  }
  if (data.boards != nullptr) {
    for (std::size_t v = 0; v < blocks.board_blocks.size(); ++v) {
      const ViewDetections& view = data.boards->views[v];
      for (std::size_t i = 0; i < view.pixels.size(); ++i) {
        problem.AddResidualBlock(
            new CornerCost(view.pixels[i], view.points[i], static_cast<int>(v), blocks),
            new ceres::CauchyLoss(std::max(options.loss_px, kCornerLossPx)), lens,
            blocks.board_blocks[v].data());
      }
      ordering->AddElementToGroup(blocks.board_blocks[v].data(), 1);
    }
  }
  if (data.pinned_slope) {
    problem.AddResidualBlock(new SlopePin(*data.pinned_slope, 1e4, blocks), nullptr, lens);
  }
  if (data.known_angle) {
    problem.AddResidualBlock(new AngleCost(*data.known_angle, blocks), nullptr, lens);
  }
  ceres::Solver::Options solver;
  solver.linear_solver_type = ceres::DENSE_SCHUR;
  solver.linear_solver_ordering = ordering;
  solver.max_num_iterations = options.max_iterations;
  solver.function_tolerance = 1e-8;
  solver.num_threads = options.threads;
  solver.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(solver, &problem, &summary);
  if (!summary.IsSolutionUsable() || !std::isfinite(summary.final_cost)) return std::nullopt;
  auto result = blocks.estimate();
  if (!result) return std::nullopt;
  estimate = std::move(*result);
  return summary.final_cost / static_cast<double>(data.observations.size());
}

Eigen::Vector3d inCamera(const ScanObservation& o, const ScanEstimate& estimate) {
  return estimate.T_scan[o.scan] * estimate.points[o.point] - o.travel * estimate.axis;
}

double residualOf(const ScanObservation& o, const ScanEstimate& estimate) {
  const auto pixel = projectContinued(*estimate.lens, inCamera(o, estimate));
  return pixel ? (*pixel - o.pixel).norm() : kNowherePx;
}

std::vector<std::vector<const ScanObservation*>> byPoint(
    const std::vector<ScanObservation>& observations, std::size_t points) {
  std::vector<std::vector<const ScanObservation*>> result(points);
  for (const ScanObservation& o : observations) result[o.point].push_back(&o);
  return result;
}

Eigen::MatrixXd lensCovariance(const ScanData& data, const ScanEstimate& estimate,
                               bool scans_free) {
  const int lens_size = static_cast<int>(estimate.lens->parameters().size());
  const int scans = scans_free ? static_cast<int>(estimate.T_scan.size()) - 1 : 0;
  const int boards = static_cast<int>(estimate.T_camera_board.size());
  const int size = lens_size + 2 + 6 * (scans + boards);
  Eigen::MatrixXd H = Eigen::MatrixXd::Zero(size, size);
  Blocks blocks(estimate);
  // Tangents of the unit axis.
  Eigen::Matrix<double, 3, 2> tangent;
  tangent.col(0) = estimate.axis.unitOrthogonal();
  tangent.col(1) = estimate.axis.cross(tangent.col(0));

  const auto tracks = byPoint(data.observations, estimate.points.size());
  for (const auto& track : tracks) {
    if (track.empty()) continue;
    Eigen::MatrixXd J = Eigen::MatrixXd::Zero(2 * static_cast<int>(track.size()), size);
    Eigen::MatrixXd P(2 * static_cast<int>(track.size()), 3);
    for (std::size_t i = 0; i < track.size(); ++i) {
      const ScanObservation& o = *track[i];
      RowMajor d_lens(2, lens_size), d_axis(2, 3), d_pose(2, 6), d_point(2, 3);
      double* jacobians[] = {d_lens.data(), d_axis.data(), d_pose.data(), d_point.data()};
      const double* parameters[] = {blocks.lens_block.data(), blocks.axis.data(),
                                    blocks.scan_blocks[o.scan].data(),
                                    blocks.points[o.point].data()};
      double residual[2];
      PointCost(o, blocks).Evaluate(parameters, residual, jacobians);
      const int row = 2 * static_cast<int>(i);
      J.block(row, 0, 2, lens_size) = d_lens;
      J.block<2, 2>(row, lens_size) = d_axis * tangent;
      if (scans_free && o.scan > 0) J.block<2, 6>(row, lens_size + 2 + 6 * (o.scan - 1)) = d_pose;
      P.middleRows<2>(row) = d_point;
    }
    const Eigen::Matrix3d V = P.transpose() * P;
    const Eigen::MatrixXd W = P.transpose() * J;
    H += J.transpose() * J - W.transpose() * V.ldlt().solve(W);
  }
  if (data.boards != nullptr) {
    for (int v = 0; v < boards; ++v) {
      const ViewDetections& view = data.boards->views[v];
      const int column = lens_size + 2 + 6 * (scans + v);
      for (std::size_t i = 0; i < view.pixels.size(); ++i) {
        RowMajor d_lens(2, lens_size), d_pose(2, 6);
        double* jacobians[] = {d_lens.data(), d_pose.data()};
        double residual[2];
        CornerCost(view.pixels[i], view.points[i], v, blocks)
            .Evaluate(nullptr, residual, jacobians);
        Eigen::MatrixXd J = Eigen::MatrixXd::Zero(2, size);
        J.leftCols(lens_size) = d_lens;
        J.middleCols(column, 6) = d_pose;
        H += J.transpose() * J;
      }
    }
  }
  if (data.known_angle) {
    RowMajor gradient(1, lens_size);
    double* jacobians[] = {gradient.data()};
    double residual[1];
    AngleCost(*data.known_angle, blocks).Evaluate(nullptr, residual, jacobians);
    H.topLeftCorner(lens_size, lens_size) += gradient.transpose() * gradient;
  }
  // Scaled to a unit diagonal, so that "singular" does not depend on units.
  Eigen::VectorXd scale = H.diagonal().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
  const Eigen::MatrixXd scaled_H = scale.asDiagonal() * H * scale.asDiagonal();
  const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(scaled_H);
  const Eigen::VectorXd inverse = eigen.eigenvalues().cwiseMax(1e-14).cwiseInverse();
  const Eigen::MatrixXd covariance = scale.asDiagonal() * eigen.eigenvectors() *
                                     inverse.asDiagonal() * eigen.eigenvectors().transpose() *
                                     scale.asDiagonal();
  return covariance.topLeftCorner(lens_size, lens_size);
}

}  // namespace omnister::calibration
