// SPDX-License-Identifier: Apache-2.0
#include "bundle.h"

#include <ceres/ceres.h>
#include <ceres/evaluation_callback.h>

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <array>
#include <cmath>
#include <memory>

#include "pose_block.h"

namespace omnister::calibration {

namespace {

/// What a corner that has no pixel at all costs: far more than any real one.
constexpr double kNowherePx = 1e3;

using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

/// Everything the residuals of one corner depend on, at the values of one evaluation.
struct Linearization {
  Eigen::Vector2d residual;
  Jacobian23 d_point;  ///< d(pixel)/d(X) in the reference camera
  JacobianParams d_lens;
  Eigen::Matrix<double, 2, 6> d_pose;
  Eigen::Vector2d d_k1, d_k2;
  Eigen::Matrix<double, 2, 6> d_rig;
};

/// Predicted - observed, with derivatives on request.
void linearize(const LensModel& lens, const PoseValue& pose, const PoseValue* rig,
               const Eigen::Vector2d& warp, const Eigen::Vector3d& shift, const Corner& corner,
               bool derivatives, Linearization& out) {
  Eigen::Vector3d point = corner.point;
  point.z() += warp.dot(corner.bulge);
  const Eigen::Vector3d X = pose.R * point + pose.t - shift;
  const Eigen::Vector3d Y = rig ? Eigen::Vector3d(rig->R * X + rig->t) : X;
  Jacobian23 d_bearing = Jacobian23::Zero();
  const auto pixel = projectContinued(lens, Y, derivatives ? &d_bearing : nullptr,
                                      derivatives ? &out.d_lens : nullptr);
  if (!pixel) {
    out.residual = Eigen::Vector2d(kNowherePx, 0.0);
    if (derivatives) {
      out.d_lens.setZero(2, lens.parameters().size());
      d_bearing.setZero();
    }
  } else {
    out.residual = *pixel - corner.pixel;
  }
  if (!derivatives) return;
  if (rig) {
    out.d_rig.leftCols<3>() = -d_bearing * rig->R * crossMatrix(X) * rig->right_jacobian;
    out.d_rig.rightCols<3>() = d_bearing;
    out.d_point = d_bearing * rig->R;
  } else {
    out.d_point = d_bearing;
  }
  const Jacobian23 d_rotated = out.d_point * pose.R;
  out.d_pose.leftCols<3>() = -d_rotated * crossMatrix(point) * pose.right_jacobian;
  out.d_pose.rightCols<3>() = out.d_point;
  out.d_k1 = d_rotated.col(2) * corner.bulge[0];
  out.d_k2 = d_rotated.col(2) * corner.bulge[1];
}

/// Parameter blocks and, at each evaluation, the lenses and rotations made of them once for all
/// corners.
class Blocks : public ceres::EvaluationCallback {
 public:
  explicit Blocks(const BundleState& state) : state_(state) {
    for (const LensPtr& lens : state.lenses) lens_blocks.push_back(lens->parameters());
    for (const Pose& pose : state.poses) pose_blocks.push_back(blockOf(pose));
    warp = state.warp;
    rig = blockOf(state.T_right_left);
    axis = state.axis;
    prepare();
  }

  void PrepareForEvaluation(bool, bool new_point) override {
    if (new_point) prepare();
  }

  void prepare() {
    lenses.clear();
    for (std::size_t i = 0; i < lens_blocks.size(); ++i) {
      // A lens that does not change need not be built, nor can it fail.
      const bool same = lens_blocks[i] == state_.lenses[i]->parameters();
      lenses.push_back(same ? state_.lenses[i] : state_.lenses[i]->withParameters(lens_blocks[i]));
    }
    poses.clear();
    for (const Vector6d& block : pose_blocks) poses.emplace_back(block.data());
    rig_value.emplace(rig.data());
  }

  BundleState state() const {
    BundleState state = state_;
    for (std::size_t i = 0; i < lens_blocks.size(); ++i) {
      state.lenses[i] = state_.lenses[i]->withParameters(lens_blocks[i]);
    }
    for (std::size_t i = 0; i < pose_blocks.size(); ++i) state.poses[i] = poseOf(pose_blocks[i]);
    state.warp = warp;
    state.T_right_left = poseOf(rig);
    state.axis = axis;
    return state;
  }

  std::vector<Eigen::VectorXd> lens_blocks;
  std::vector<Vector6d> pose_blocks;
  Eigen::Vector2d warp;
  Vector6d rig;
  Eigen::Vector3d axis;

  std::vector<LensPtr> lenses;  ///< null where the parameters make none
  std::vector<PoseValue> poses;
  std::optional<PoseValue> rig_value;

 private:
  const BundleState& state_;
};

/// All corners of a view in one residual block: Ceres' book-keeping then costs little beside the
/// projections. The loss acts on each corner: the residual handed over is g(r) = r sqrt(rho(s) / s)
/// with s = |r|^2, whose squared length is rho(s), and its exact derivative.
class ViewCost : public ceres::CostFunction {
 public:
  ViewCost(const BundleView& view, const Blocks& blocks, double loss_px, bool with_axis)
      : view_(view), blocks_(blocks), loss_px_(loss_px), with_axis_(with_axis) {
    set_num_residuals(2 * static_cast<int>(view.corners->size()));
    auto* sizes = mutable_parameter_block_sizes();
    sizes->push_back(static_cast<int>(blocks.lens_blocks[view.camera].size()));
    sizes->push_back(6);
    sizes->push_back(2);
    if (view.camera == 1) sizes->push_back(6);
    if (with_axis) sizes->push_back(3);
  }

  std::vector<double*> parameterBlocks(Blocks& blocks) const {
    std::vector<double*> result = {blocks.lens_blocks[view_.camera].data(),
                                   blocks.pose_blocks[view_.pose].data(), blocks.warp.data()};
    if (view_.camera == 1) result.push_back(blocks.rig.data());
    if (with_axis_) result.push_back(blocks.axis.data());
    return result;
  }

  bool Evaluate(double const* const*, double* residuals, double** jacobians) const override {
    const LensPtr& lens = blocks_.lenses[view_.camera];
    if (!lens) return false;
    const PoseValue& pose = blocks_.poses[view_.pose];
    const PoseValue* rig = view_.camera == 1 ? &*blocks_.rig_value : nullptr;
    const Eigen::Vector3d shift = view_.travel * blocks_.axis;
    Linearization corner;
    Eigen::Matrix<double, 2, 3> d_axis;
    for (std::size_t i = 0; i < view_.corners->size(); ++i) {
      linearize(*lens, pose, rig, blocks_.warp, shift, (*view_.corners)[i], jacobians != nullptr,
                corner);
      // g = gain r;  dg = (gain I + slope r r^T) dr
      const Eigen::Vector2d r = corner.residual;
      const double s = r.squaredNorm();
      double gain = 1.0;
      double slope = 0.0;
      if (loss_px_ > 0.0) {
        const double c2 = loss_px_ * loss_px_;
        const double x = s / c2;
        if (x < 1e-6) {
          gain = 1.0 - 0.25 * x;
          slope = -0.5 / c2;
        } else {
          const double rho = c2 * std::log1p(x);
          gain = std::sqrt(rho / s);
          slope = (s / (1.0 + x) - rho) / (gain * s * s);
        }
      }
      Eigen::Map<Eigen::Vector2d>(residuals + 2 * i) = gain * r;
      if (jacobians == nullptr) continue;
      const Eigen::Matrix2d chain = gain * Eigen::Matrix2d::Identity() + slope * r * r.transpose();
      const auto store = [&](int block, const auto& derivative) {
        if (jacobians[block] == nullptr) return;
        const int columns = static_cast<int>(derivative.cols());
        Eigen::Map<RowMajor>(jacobians[block] + 2 * i * columns, 2, columns).noalias() =
            chain * derivative;
      };
      store(0, corner.d_lens);
      store(1, corner.d_pose);
      Eigen::Matrix2d d_warp;
      d_warp << corner.d_k1, corner.d_k2;
      store(2, d_warp);
      int next = 3;
      if (rig) store(next++, corner.d_rig);
      if (with_axis_) {
        d_axis = -view_.travel * corner.d_point;
        store(next, d_axis);
      }
    }
    return true;
  }

 private:
  const BundleView& view_;
  const Blocks& blocks_;
  double loss_px_;
  bool with_axis_;
};

}  // namespace

std::optional<Eigen::Vector2d> projectContinued(const LensModel& lens,
                                                const Eigen::Vector3d& bearing,
                                                Jacobian23* d_bearing,
                                                JacobianParams* d_parameters) {
  if (auto pixel = lens.project(bearing, d_bearing, d_parameters)) return pixel;
  const double rho2 = bearing.x() * bearing.x() + bearing.y() * bearing.y();
  const double rho = std::sqrt(rho2);
  const double length2 = rho2 + bearing.z() * bearing.z();
  if (!std::isfinite(length2) || rho2 <= 1e-24 * length2 || length2 <= 0.0) return std::nullopt;
  // The ray on the edge of the field with the same azimuth, and the slope of the image there.
  const double theta = std::atan2(rho, bearing.z());
  const double edge = lens.maxTheta() * (1.0 - 1e-9);
  const Eigen::Vector2d azimuth(bearing.x() / rho, bearing.y() / rho);
  Eigen::Vector3d rim;
  rim << std::sin(edge) * azimuth, std::cos(edge);
  Eigen::Vector3d outward;
  outward << std::cos(edge) * azimuth, -std::sin(edge);
  Jacobian23 d_rim;
  const auto pixel = lens.project(rim, &d_rim, d_parameters);
  if (!pixel) return std::nullopt;
  const Eigen::Vector2d slope = d_rim * outward;
  if (d_bearing != nullptr) {
    const Eigen::Vector3d d_azimuth(-bearing.y() / rho2, bearing.x() / rho2, 0.0);
    Eigen::Vector3d d_theta;
    d_theta << bearing.z() / length2 * azimuth, -rho / length2;
    const Eigen::Vector3d around(-rim.y(), rim.x(), 0.0);
    *d_bearing = d_rim * around * d_azimuth.transpose() + slope * d_theta.transpose();
  }
  return *pixel + (theta - edge) * slope;
}

Eigen::Vector3d cornerInCamera(const BundleView& view, const BundleState& state,
                               const Corner& corner) {
  Eigen::Vector3d point = corner.point;
  point.z() += state.warp.dot(corner.bulge);
  const Eigen::Vector3d X = state.poses[view.pose] * point - view.travel * state.axis;
  return view.camera == 1 ? state.T_right_left * X : X;
}

std::vector<Eigen::Vector2d> residualsOf(const BundleView& view, const BundleState& state) {
  std::vector<Eigen::Vector2d> residuals;
  residuals.reserve(view.corners->size());
  for (const Corner& corner : *view.corners) {
    const auto pixel =
        projectContinued(*state.lenses[view.camera], cornerInCamera(view, state, corner));
    residuals.push_back(pixel ? Eigen::Vector2d(corner.pixel - *pixel)
                              : Eigen::Vector2d(kNowherePx, 0.0));
  }
  return residuals;
}

bool adjust(const std::vector<BundleView>& views, const BundleOptions& options,
            BundleState& state) {
  Blocks blocks(state);
  ceres::Problem::Options problem_options;
  problem_options.evaluation_callback = &blocks;
  ceres::Problem problem(problem_options);
  bool used_right = false;
  std::vector<bool> used_lens(state.lenses.size(), false);
  std::vector<bool> used_pose(state.poses.size(), false);
  for (const BundleView& view : views) {
    auto cost = std::make_unique<ViewCost>(view, blocks, options.loss_px, options.axis);
    const auto parameters = cost->parameterBlocks(blocks);
    problem.AddResidualBlock(cost.release(), nullptr, parameters);
    used_right = used_right || view.camera == 1;
    used_lens[view.camera] = true;
    used_pose[view.pose] = true;
  }
  auto ordering = std::make_shared<ceres::ParameterBlockOrdering>();
  for (std::size_t i = 0; i < blocks.pose_blocks.size(); ++i) {
    if (used_pose[i]) ordering->AddElementToGroup(blocks.pose_blocks[i].data(), 0);
  }
  bool any_shared = false;
  const auto shared = [&](double* block, bool free) {
    ordering->AddElementToGroup(block, 1);
    if (free) {
      any_shared = true;
    } else {
      problem.SetParameterBlockConstant(block);
    }
  };
  for (std::size_t i = 0; i < blocks.lens_blocks.size(); ++i) {
    if (used_lens[i]) shared(blocks.lens_blocks[i].data(), options.lens);
  }
  shared(blocks.warp.data(), options.warp);
  if (used_right) shared(blocks.rig.data(), options.rig);
  if (options.axis) {
    shared(blocks.axis.data(), true);
    if (!options.axis_length) {
      problem.SetManifold(blocks.axis.data(), new ceres::SphereManifold<3>);
    }
  }

  ceres::Solver::Options solver;
  // One thread: sums then run in one order, so the result is the same on every machine size. Work
  // is shared out over folds and candidates instead.
  solver.num_threads = 1;
  solver.linear_solver_type = any_shared ? ceres::DENSE_SCHUR : ceres::DENSE_QR;
  if (any_shared) solver.linear_solver_ordering = ordering;
  solver.max_num_iterations = options.max_iterations;
  solver.function_tolerance = options.tolerance;
  solver.parameter_tolerance = 1e-12;
  solver.gradient_tolerance = 1e-14;
  solver.max_num_consecutive_invalid_steps = 20;
  solver.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(solver, &problem, &summary);
  if (!summary.IsSolutionUsable() || !std::isfinite(summary.final_cost)) return false;
  BundleState result = blocks.state();
  for (const LensPtr& lens : result.lenses) {
    if (!lens) return false;
  }
  if (options.axis && !options.axis_length) result.axis *= state.axis.norm() / result.axis.norm();
  state = std::move(result);
  return true;
}

double refinePose(const std::vector<BundleView>& views, double loss_px, BundleState& state,
                  int max_iterations) {
  const int index = views.front().pose;
  Vector6d block = blockOf(state.poses[index]);
  const std::optional<PoseValue> rig_value(blockOf(state.T_right_left).data());
  Linearization corner;
  const auto evaluate = [&](const Vector6d& at, Eigen::Matrix<double, 6, 6>* hessian,
                            Vector6d* gradient, double* squares) {
    const PoseValue pose(at.data());
    double cost = 0.0;
    *squares = 0.0;
    for (const BundleView& view : views) {
      const PoseValue* rig = view.camera == 1 ? &*rig_value : nullptr;
      const Eigen::Vector3d shift = view.travel * state.axis;
      for (const Corner& c : *view.corners) {
        linearize(*state.lenses[view.camera], pose, rig, state.warp, shift, c, hessian != nullptr,
                  corner);
        const double s = corner.residual.squaredNorm();
        *squares += s;
        cost += loss_px > 0.0 ? loss_px * loss_px * std::log1p(s / (loss_px * loss_px)) : s;
        if (hessian == nullptr) continue;
        const double weight = cauchyWeight(s, loss_px);
        hessian->noalias() += weight * corner.d_pose.transpose() * corner.d_pose;
        gradient->noalias() += weight * corner.d_pose.transpose() * corner.residual;
      }
    }
    return cost;
  };

  double damping = 1e-4;
  double squares = 0.0;
  double cost = evaluate(block, nullptr, nullptr, &squares);
  std::size_t count = 0;
  for (const BundleView& view : views) count += view.corners->size();
  for (int iteration = 0; iteration < max_iterations; ++iteration) {
    Eigen::Matrix<double, 6, 6> hessian = Eigen::Matrix<double, 6, 6>::Zero();
    Vector6d gradient = Vector6d::Zero();
    evaluate(block, &hessian, &gradient, &squares);
    bool improved = false;
    double change = 0.0;
    for (int attempt = 0; attempt < 10 && !improved; ++attempt) {
      Eigen::Matrix<double, 6, 6> damped = hessian;
      damped.diagonal() *= 1.0 + damping;
      damped.diagonal().array() += 1e-12 * hessian.diagonal().maxCoeff();
      const Vector6d step = damped.ldlt().solve(-gradient);
      const Vector6d next = block + step;
      double next_squares = 0.0;
      const double next_cost =
          step.allFinite() ? evaluate(next, nullptr, nullptr, &next_squares) : HUGE_VAL;
      if (next_cost < cost) {
        change = cost - next_cost;
        block = next;
        cost = next_cost;
        squares = next_squares;
        damping = std::max(damping * 0.1, 1e-12);
        improved = true;
      } else {
        damping *= 10.0;
      }
    }
    if (!improved || change < 1e-12 * cost) break;
  }
  state.poses[index] = poseOf(block);
  return std::sqrt(squares / static_cast<double>(count));
}

Eigen::Matrix<double, 3, 2> axisTangents(const Eigen::Vector3d& axis) {
  Eigen::Vector3d least = Eigen::Vector3d::Zero();
  Eigen::Index place = 0;
  axis.cwiseAbs().minCoeff(&place);
  least[place] = 1.0;
  Eigen::Matrix<double, 3, 2> tangents;
  tangents.col(0) = axis.cross(least).normalized();
  tangents.col(1) = axis.cross(tangents.col(0)).normalized();
  return tangents;
}

Eigen::MatrixXd reducedInformation(const std::vector<BundleView>& views,
                                   const BundleOptions& options, const BundleState& state) {
  // Columns: lens of each camera, warp, rig, axis.
  std::vector<int> lens_column;
  int columns = 0;
  for (const LensPtr& lens : state.lenses) {
    lens_column.push_back(columns);
    if (options.lens) columns += static_cast<int>(lens->parameters().size());
  }
  const int warp_column = columns;
  columns += options.warp ? 2 : 0;
  const int rig_column = columns;
  columns += options.rig ? 6 : 0;
  const int axis_column = columns;
  const Eigen::MatrixXd axis_steps = options.axis_length
                                         ? Eigen::MatrixXd(Eigen::Matrix3d::Identity())
                                         : Eigen::MatrixXd(axisTangents(state.axis));
  columns += options.axis ? static_cast<int>(axis_steps.cols()) : 0;

  const Blocks blocks(state);
  Eigen::MatrixXd information = Eigen::MatrixXd::Zero(columns, columns);
  // Per pose, since several views may share one.
  std::vector<Eigen::Matrix<double, 6, 6>> pose_information(state.poses.size(),
                                                            Eigen::Matrix<double, 6, 6>::Zero());
  std::vector<Eigen::MatrixXd> coupling(state.poses.size());
  Linearization corner;
  Eigen::MatrixXd row(2, columns);
  for (const BundleView& view : views) {
    Eigen::MatrixXd& couple = coupling[view.pose];
    if (couple.size() == 0) couple = Eigen::MatrixXd::Zero(columns, 6);
    const PoseValue* rig = view.camera == 1 ? &*blocks.rig_value : nullptr;
    for (const Corner& c : *view.corners) {
      linearize(*state.lenses[view.camera], blocks.poses[view.pose], rig, state.warp,
                view.travel * state.axis, c, true, corner);
      row.setZero();
      if (options.lens) {
        row.middleCols(lens_column[view.camera], corner.d_lens.cols()) = corner.d_lens;
      }
      if (options.warp) row.middleCols(warp_column, 2) << corner.d_k1, corner.d_k2;
      if (options.rig && rig) row.middleCols(rig_column, 6) = corner.d_rig;
      if (options.axis) {
        row.middleCols(axis_column, axis_steps.cols()) = -view.travel * corner.d_point * axis_steps;
      }
      information.noalias() += row.transpose() * row;
      couple.noalias() += row.transpose() * corner.d_pose;
      pose_information[view.pose].noalias() += corner.d_pose.transpose() * corner.d_pose;
    }
  }
  for (std::size_t i = 0; i < state.poses.size(); ++i) {
    if (coupling[i].size() == 0) continue;
    information.noalias() -=
        coupling[i] * pose_information[i].ldlt().solve(coupling[i].transpose());
  }
  return 0.5 * (information + information.transpose());
}

}  // namespace omnister::calibration
