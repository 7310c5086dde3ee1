// SPDX-License-Identifier: Apache-2.0
#include "bundle.h"

#include <ceres/ceres.h>
#include <ceres/evaluation_callback.h>

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <array>
#include <cmath>
#include <memory>

#include "omnister/lens/lens_models.h"
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

/// Weight of a grid's control points [px per rad], see adjust().
constexpr double kGridWeight = 100.0;

/// The normal equations of the whole problem: what is shared (lens parameters, warp, rig and axis,
/// in that order, those that are free), and one pose each.
class NormalEquations {
 public:
  NormalEquations(const std::vector<BundleView>& views, const BundleOptions& options,
                  const BundleState& state)
      : views_(views), options_(options) {
    for (const LensPtr& lens : state.lenses) {
      lens_column_.push_back(columns_);
      if (options.lens) columns_ += static_cast<int>(lens->parameters().size());
      const int side = structureOf(*lens).grid;
      grid_size_.push_back(2 * side * side);
    }
    warp_column_ = columns_;
    columns_ += options.warp ? 2 : 0;
    rig_column_ = columns_;
    columns_ += options.rig ? 6 : 0;
    axis_column_ = columns_;
    axis_steps_ = options.axis_length ? Eigen::MatrixXd(Eigen::Matrix3d::Identity())
                                      : Eigen::MatrixXd(axisTangents(state.axis));
    columns_ += options.axis ? static_cast<int>(axis_steps_.cols()) : 0;
    poses_ = state.poses.size();
  }

  /// Sums up at `blocks`. @return the cost: the sum of the loss over all corners; infinite when a
  /// lens is none
  double build(const Blocks& blocks, double loss_px, bool derivatives) {
    if (derivatives) {
      shared = Eigen::MatrixXd::Zero(columns_, columns_);
      gradient = Eigen::VectorXd::Zero(columns_);
      pose.assign(poses_, Eigen::Matrix<double, 6, 6>::Zero());
      pose_gradient.assign(poses_, Vector6d::Zero());
      coupling.assign(poses_, Eigen::MatrixXd());
    }
    double cost = 0.0;
    Linearization corner;
    std::vector<int> active;
    std::vector<Eigen::Vector2d> row;
    for (const BundleView& view : views_) {
      const LensPtr& lens = blocks.lenses[view.camera];
      if (!lens) return HUGE_VAL;
      const PoseValue* rig = view.camera == 1 ? &*blocks.rig_value : nullptr;
      if (derivatives && coupling[view.pose].size() == 0) {
        coupling[view.pose] = Eigen::MatrixXd::Zero(columns_, 6);
      }
      for (const Corner& c : *view.corners) {
        linearize(*lens, blocks.poses[view.pose], rig, blocks.warp, view.travel * blocks.axis, c,
                  derivatives, corner);
        const double s = corner.residual.squaredNorm();
        cost += loss_px > 0.0 ? loss_px * loss_px * std::log1p(s / (loss_px * loss_px)) : s;
        if (!derivatives) continue;
        active.clear();
        row.clear();
        const auto add = [&](int column, const Eigen::Vector2d& slope) {
          // A grid has many control points, of which few matter to a corner.
          if (slope.x() == 0.0 && slope.y() == 0.0) return;
          active.push_back(column);
          row.push_back(slope);
        };
        if (options_.lens) {
          for (int k = 0; k < corner.d_lens.cols(); ++k) {
            add(lens_column_[view.camera] + k, corner.d_lens.col(k));
          }
        }
        if (options_.warp) {
          add(warp_column_, corner.d_k1);
          add(warp_column_ + 1, corner.d_k2);
        }
        if (options_.rig && rig) {
          for (int k = 0; k < 6; ++k) add(rig_column_ + k, corner.d_rig.col(k));
        }
        if (options_.axis) {
          for (int k = 0; k < axis_steps_.cols(); ++k) {
            add(axis_column_ + k, -view.travel * corner.d_point * axis_steps_.col(k));
          }
        }
        const double weight = cauchyWeight(s, loss_px);
        Eigen::MatrixXd& couple = coupling[view.pose];
        for (std::size_t a = 0; a < active.size(); ++a) {
          const Eigen::Vector2d weighted = weight * row[a];
          for (std::size_t b = 0; b <= a; ++b) shared(active[a], active[b]) += weighted.dot(row[b]);
          gradient[active[a]] += weighted.dot(corner.residual);
          couple.row(active[a]).noalias() += weighted.transpose() * corner.d_pose;
        }
        pose[view.pose].noalias() += weight * corner.d_pose.transpose() * corner.d_pose;
        pose_gradient[view.pose].noalias() += weight * corner.d_pose.transpose() * corner.residual;
      }
    }
    for (std::size_t i = 0; i < grid_size_.size(); ++i) {
      if (!options_.lens || grid_size_[i] == 0) continue;
      const Eigen::Index size = blocks.lens_blocks[i].size();
      const auto points = blocks.lens_blocks[i].tail(grid_size_[i]);
      cost += kGridWeight * kGridWeight * points.squaredNorm();
      if (!derivatives) continue;
      const Eigen::Index first = lens_column_[i] + size - grid_size_[i];
      gradient.segment(first, grid_size_[i]) += kGridWeight * kGridWeight * points;
      shared.diagonal().segment(first, grid_size_[i]).array() += kGridWeight * kGridWeight;
    }
    if (derivatives) shared = Eigen::MatrixXd(shared.selfadjointView<Eigen::Lower>());
    return std::isfinite(cost) ? cost : HUGE_VAL;
  }

  /// Moves the blocks by the step that solves the equations with a damped diagonal.
  /// @return false for equations without a solution
  bool step(double damping, Blocks& blocks) const {
    const auto damped = [&](auto matrix) {
      const double least = 1e-12 * matrix.diagonal().maxCoeff();
      matrix.diagonal() *= 1.0 + damping;
      matrix.diagonal().array() += least;
      return matrix;
    };
    Eigen::MatrixXd reduced = damped(shared);
    Eigen::VectorXd right = -gradient;
    std::vector<Eigen::LDLT<Eigen::Matrix<double, 6, 6>>> inverse(poses_);
    for (std::size_t i = 0; i < poses_; ++i) {
      if (coupling[i].size() == 0) continue;
      inverse[i].compute(damped(pose[i]));
      reduced.noalias() -= coupling[i] * inverse[i].solve(coupling[i].transpose());
      right += coupling[i] * inverse[i].solve(pose_gradient[i]);
    }
    // Parameters differ by many orders of magnitude.
    const Eigen::VectorXd scale = reduced.diagonal().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
    const Eigen::MatrixXd scaled = scale.asDiagonal() * reduced * scale.asDiagonal();
    const Eigen::VectorXd change =
        scale.cwiseProduct(scaled.ldlt().solve(scale.cwiseProduct(right)));
    if (!change.allFinite()) return false;
    for (std::size_t i = 0; i < poses_; ++i) {
      if (coupling[i].size() == 0) continue;
      const Vector6d move =
          -inverse[i].solve(Vector6d(pose_gradient[i] + coupling[i].transpose() * change));
      if (!move.allFinite()) return false;
      blocks.pose_blocks[i] += move;
    }
    if (options_.lens) {
      for (std::size_t i = 0; i < lens_column_.size(); ++i) {
        blocks.lens_blocks[i] += change.segment(lens_column_[i], blocks.lens_blocks[i].size());
      }
    }
    if (options_.warp) blocks.warp += change.segment<2>(warp_column_);
    if (options_.rig) blocks.rig += change.segment<6>(rig_column_);
    if (options_.axis) {
      const double length = blocks.axis.norm();
      blocks.axis += axis_steps_ * change.segment(axis_column_, axis_steps_.cols());
      if (!options_.axis_length) blocks.axis *= length / blocks.axis.norm();
    }
    blocks.prepare();
    return true;
  }

  Eigen::MatrixXd shared;  ///< lower and upper
  Eigen::VectorXd gradient;
  std::vector<Eigen::Matrix<double, 6, 6>> pose;
  std::vector<Vector6d> pose_gradient;
  std::vector<Eigen::MatrixXd> coupling;  ///< empty for poses that no view has

 private:
  const std::vector<BundleView>& views_;
  const BundleOptions& options_;
  std::vector<int> lens_column_;
  std::vector<int> grid_size_;
  int warp_column_ = 0;
  int rig_column_ = 0;
  int axis_column_ = 0;
  int columns_ = 0;
  Eigen::MatrixXd axis_steps_;
  std::size_t poses_ = 0;
};

/// Levenberg and Marquardt on the normal equations: for lenses with a grid, whose Jacobians are
/// sparse within their one block.
bool adjustByNormalEquations(const std::vector<BundleView>& views, const BundleOptions& options,
                             BundleState& state) {
  Blocks blocks(state);
  NormalEquations equations(views, options, state);
  double damping = 1e-4;
  double cost = equations.build(blocks, options.loss_px, true);
  if (!(cost < HUGE_VAL)) return false;
  for (int iteration = 0; iteration < options.max_iterations; ++iteration) {
    bool improved = false;
    double change = 0.0;
    const auto lens_before = blocks.lens_blocks;
    const auto poses_before = blocks.pose_blocks;
    const Eigen::Vector2d warp_before = blocks.warp;
    const Vector6d rig_before = blocks.rig;
    const Eigen::Vector3d axis_before = blocks.axis;
    for (int attempt = 0; attempt < 12 && !improved; ++attempt) {
      const double next = equations.step(damping, blocks)
                              ? equations.build(blocks, options.loss_px, false)
                              : HUGE_VAL;
      if (next < cost) {
        change = cost - next;
        cost = next;
        damping = std::max(0.1 * damping, 1e-12);
        improved = true;
        break;
      }
      damping *= 10.0;
      blocks.lens_blocks = lens_before;
      blocks.pose_blocks = poses_before;
      blocks.warp = warp_before;
      blocks.rig = rig_before;
      blocks.axis = axis_before;
      blocks.prepare();
    }
    if (!improved || change <= options.tolerance * cost) break;
    equations.build(blocks, options.loss_px, true);
  }
  state = blocks.state();
  return true;
}

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
  for (const LensPtr& lens : state.lenses) {
    if (options.lens && structureOf(*lens).grid > 0) {
      return adjustByNormalEquations(views, options, state);
    }
  }
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
  const Blocks blocks(state);
  NormalEquations equations(views, options, state);
  equations.build(blocks, 0.0, true);
  Eigen::MatrixXd information = equations.shared;
  for (std::size_t i = 0; i < state.poses.size(); ++i) {
    const Eigen::MatrixXd& coupling = equations.coupling[i];
    if (coupling.size() == 0) continue;
    information.noalias() -= coupling * equations.pose[i].ldlt().solve(coupling.transpose());
  }
  return 0.5 * (information + information.transpose());
}

}  // namespace omnister::calibration
