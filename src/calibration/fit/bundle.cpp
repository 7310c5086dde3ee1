// SPDX-License-Identifier: Apache-2.0
#include "calibration/fit/bundle.h"

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <array>
#include <cmath>
#include <memory>

#include "calibration/fit/pose_block.h"
#include "omnister/lens/lens_models.h"

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

/// Parameter blocks, and the lenses and rotations made of them once for all corners.
class Blocks {
 public:
  explicit Blocks(const BundleState& state) : state_(&state) {
    for (const LensPtr& lens : state.lenses) lens_blocks.push_back(lens->parameters());
    for (const Pose& pose : state.poses) pose_blocks.push_back(blockOf(pose));
    warp = state.warp;
    rig = blockOf(state.T_right_left);
    axis = state.axis;
    prepare();
  }

  void prepare() {
    lenses.clear();
    for (std::size_t i = 0; i < lens_blocks.size(); ++i) {
      // A lens that does not change need not be built, nor can it fail.
      const bool same = lens_blocks[i] == state_->lenses[i]->parameters();
      lenses.push_back(same ? state_->lenses[i]
                            : state_->lenses[i]->withParameters(lens_blocks[i]));
    }
    poses.clear();
    for (const Vector6d& block : pose_blocks) poses.emplace_back(block.data());
    rig_value.emplace(rig.data());
  }

  BundleState state() const {
    BundleState state = *state_;
    state.lenses = lenses;
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
  const BundleState* state_;
};

/// Weight of a grid's control points [px per rad], see adjust().
constexpr double kGridWeight = 100.0;

/// The loss acts on each corner. Its second order, which plain weights leave out, is taken along
/// (Triggs et al. 1999, sec. 4.3): J^T W J with W = rho' I + 2 rho'' r r^T, held positive, so that
/// corners on the way to being outliers do not slow the fit down.
struct Robust {
  double cost;
  Eigen::Matrix2d chain = Eigen::Matrix2d::Identity();  ///< W = chain^2
  Eigen::Vector2d residual;                             ///< chain^-1 rho' r

  Robust(const Eigen::Vector2d& r, double loss_px) : cost(r.squaredNorm()), residual(r) {
    if (!(loss_px > 0.0)) return;
    const double s = cost;
    const double c2 = loss_px * loss_px;
    const double weight = 1.0 / (1.0 + s / c2);  // rho'
    const double root = std::sqrt(weight);
    const double across = std::sqrt(std::max((1.0 - s / c2) * weight, 0.05));
    cost = c2 * std::log1p(s / c2);
    chain *= root;
    if (s > 0.0) chain -= (root * (1.0 - across) / s) * r * r.transpose();
    residual *= root / across;
  }
};

/// Levenberg and Marquardt. `System` has two places: where it stands and a trial.
///   double build();            cost and equations at the trial; infinite where there is none
///   void accept();             the trial becomes where it stands
///   double propose(damping);   a new trial; what it should lower the cost by, at least, or a
///                              negative number when the equations have no solution
/// @return false when the first trial has no cost
template <typename System>
bool minimise(System& system, int max_iterations, double tolerance) {
  double cost = system.build();
  if (!(cost < HUGE_VAL)) return false;
  system.accept();
  // Damping follows how well the last step was foretold (Nielsen 1999): it neither grows in a
  // narrow valley nor has to be found anew at each step.
  double damping = 1e-6;
  double growth = 2.0;
  for (int iteration = 0; iteration < max_iterations; ++iteration) {
    double change = 0.0;
    for (int attempt = 0; attempt < 12 && !(change > 0.0); ++attempt) {
      const double expected = system.propose(damping);
      if (expected >= 0.0 && expected <= 0.1 * tolerance * cost) return true;
      const double next = expected >= 0.0 ? system.build() : HUGE_VAL;
      if (next < cost) {
        change = cost - next;
        cost = next;
        const double surprise = 2.0 * change / expected - 1.0;
        damping = std::max(damping * std::max(0.1, 1.0 - std::pow(surprise, 3)), 1e-12);
        growth = 2.0;
        system.accept();
      } else {
        damping *= growth;
        growth *= 2.0;
      }
    }
    if (change <= tolerance * cost) break;
  }
  return true;
}

/// A copy with a larger diagonal, so that a step is shorter and there is one at all.
template <typename Matrix>
Matrix damped(Matrix matrix, double damping) {
  const double least = 1e-12 * matrix.diagonal().maxCoeff();
  matrix.diagonal() *= 1.0 + damping;
  matrix.diagonal().array() += least;
  return matrix;
}

/// J^T J and J^T r of the whole problem: what is shared (lens parameters, warp, rig and axis, in
/// that order, those that are free), and one pose each.
struct Equations {
  Eigen::MatrixXd shared;  ///< lower and upper
  Eigen::VectorXd gradient;
  std::vector<Eigen::Matrix<double, 6, 6>> pose;
  std::vector<Vector6d> pose_gradient;
  std::vector<Eigen::MatrixXd> coupling;  ///< empty for poses that no view has
};

/// The whole problem, its poses eliminated from each step (Schur's complement).
class BundleSystem {
 public:
  BundleSystem(const std::vector<BundleView>& views, const BundleOptions& options,
               const BundleState& state)
      : views_(views), options_(options), now_(state), trial_(state) {
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
  }

  double build() {
    const std::size_t poses = trial_.pose_blocks.size();
    sums_.shared = Eigen::MatrixXd::Zero(columns_, columns_);
    sums_.gradient = Eigen::VectorXd::Zero(columns_);
    sums_.pose.assign(poses, Eigen::Matrix<double, 6, 6>::Zero());
    sums_.pose_gradient.assign(poses, Vector6d::Zero());
    sums_.coupling.assign(poses, Eigen::MatrixXd());
    double cost = 0.0;
    for (const BundleView& view : views_) {
      if (!trial_.lenses[view.camera]) return HUGE_VAL;
      if (sums_.coupling[view.pose].size() == 0) {
        sums_.coupling[view.pose] = Eigen::MatrixXd::Zero(columns_, 6);
      }
      cost += options_.lens && grid_size_[view.camera] > 0 ? addSparse(view) : addDense(view);
    }
    for (std::size_t i = 0; i < grid_size_.size(); ++i) {
      if (!options_.lens || grid_size_[i] == 0) continue;
      const auto points = trial_.lens_blocks[i].tail(grid_size_[i]);
      const Eigen::Index first = lens_column_[i] + trial_.lens_blocks[i].size() - grid_size_[i];
      cost += kGridWeight * kGridWeight * points.squaredNorm();
      sums_.gradient.segment(first, grid_size_[i]) += kGridWeight * kGridWeight * points;
      sums_.shared.diagonal().segment(first, grid_size_[i]).array() += kGridWeight * kGridWeight;
    }
    sums_.shared = Eigen::MatrixXd(sums_.shared.selfadjointView<Eigen::Lower>());
    return std::isfinite(cost) ? cost : HUGE_VAL;
  }

  void accept() {
    std::swap(now_, trial_);
    std::swap(equations_, sums_);
  }

  double propose(double damping) {
    const Equations& e = equations_;
    Eigen::MatrixXd reduced = columns_ > 0 ? damped(e.shared, damping) : e.shared;
    Eigen::VectorXd right = -e.gradient;
    std::vector<Eigen::LDLT<Eigen::Matrix<double, 6, 6>>> inverse(e.pose.size());
    for (std::size_t i = 0; i < e.pose.size(); ++i) {
      if (!used(i)) continue;
      inverse[i].compute(damped(e.pose[i], damping));
      reduced.noalias() -= e.coupling[i] * inverse[i].solve(e.coupling[i].transpose());
      right += e.coupling[i] * inverse[i].solve(e.pose_gradient[i]);
    }
    Eigen::VectorXd change = right;
    if (columns_ > 0) {
      // Parameters differ by many orders of magnitude.
      const Eigen::VectorXd scale = reduced.diagonal().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
      const Eigen::MatrixXd scaled = scale.asDiagonal() * reduced * scale.asDiagonal();
      change = scale.cwiseProduct(scaled.ldlt().solve(scale.cwiseProduct(right)));
    }
    if (!change.allFinite()) return -1.0;
    double expected = -e.gradient.dot(change);
    trial_ = now_;
    for (std::size_t i = 0; i < e.pose.size(); ++i) {
      if (!used(i)) continue;
      const Vector6d move =
          -inverse[i].solve(Vector6d(e.pose_gradient[i] + e.coupling[i].transpose() * change));
      if (!move.allFinite()) return -1.0;
      expected -= e.pose_gradient[i].dot(move);
      trial_.pose_blocks[i] += move;
    }
    if (options_.lens) {
      for (std::size_t i = 0; i < lens_column_.size(); ++i) {
        trial_.lens_blocks[i] += change.segment(lens_column_[i], trial_.lens_blocks[i].size());
      }
    }
    if (options_.warp) trial_.warp += change.segment<2>(warp_column_);
    if (options_.rig) trial_.rig += change.segment<6>(rig_column_);
    if (options_.axis) {
      const double length = trial_.axis.norm();
      trial_.axis += axis_steps_ * change.segment(axis_column_, axis_steps_.cols());
      if (!options_.axis_length) trial_.axis *= length / trial_.axis.norm();
    }
    trial_.prepare();
    return expected;
  }

  bool used(std::size_t pose) const { return equations_.coupling[pose].size() > 0; }
  const Equations& equations() const { return equations_; }
  BundleState state() const { return now_.state(); }

 private:
  void linearizeAt(const BundleView& view, const Corner& corner, Linearization& out) const {
    const PoseValue* rig = view.camera == 1 ? &*trial_.rig_value : nullptr;
    linearize(*trial_.lenses[view.camera], trial_.poses[view.pose], rig, trial_.warp,
              view.travel * trial_.axis, corner, true, out);
  }

  /// Calls with each shared parameter's column and the slope of a corner's residual by it.
  template <typename Add>
  void forEachColumn(const BundleView& view, const Linearization& corner, const Add& add) const {
    if (options_.lens) {
      for (int k = 0; k < corner.d_lens.cols(); ++k) {
        add(lens_column_[view.camera] + k, corner.d_lens.col(k));
      }
    }
    if (options_.warp) {
      add(warp_column_, corner.d_k1);
      add(warp_column_ + 1, corner.d_k2);
    }
    if (options_.rig && view.camera == 1) {
      for (int k = 0; k < 6; ++k) add(rig_column_ + k, corner.d_rig.col(k));
    }
    if (options_.axis) {
      for (int k = 0; k < axis_steps_.cols(); ++k) {
        add(axis_column_ + k, -view.travel * corner.d_point * axis_steps_.col(k));
      }
    }
  }

  /// All corners of a view as one matrix [shared columns it has | pose | residual], squared at
  /// once.
  double addDense(const BundleView& view) {
    const auto count = static_cast<Eigen::Index>(view.corners->size());
    place_.clear();
    double cost = 0.0;
    Linearization corner;
    Eigen::Index width = 0;
    for (Eigen::Index i = 0; i < count; ++i) {
      linearizeAt(view, (*view.corners)[static_cast<std::size_t>(i)], corner);
      if (i == 0) {
        forEachColumn(view, corner, [&](int column, const auto&) { place_.push_back(column); });
        width = static_cast<Eigen::Index>(place_.size());
        rows_.resize(2 * count, width + 7);
      }
      auto row = rows_.middleRows<2>(2 * i);
      Eigen::Index next = 0;
      forEachColumn(view, corner, [&](int, const auto& slope) { row.col(next++) = slope; });
      row.middleCols<6>(width) = corner.d_pose;
      const Robust robust(corner.residual, options_.loss_px);
      cost += robust.cost;
      for (Eigen::Index k = 0; k < width + 6; ++k) row.col(k) = robust.chain * row.col(k);
      row.col(width + 6) = robust.residual;
    }
    if (count == 0) return 0.0;
    squares_.setZero(width + 7, width + 7);
    squares_.selfadjointView<Eigen::Lower>().rankUpdate(rows_.transpose());
    for (Eigen::Index a = 0; a < width; ++a) {
      const int column = place_[static_cast<std::size_t>(a)];
      for (Eigen::Index b = 0; b <= a; ++b) {
        sums_.shared(column, place_[static_cast<std::size_t>(b)]) += squares_(a, b);
      }
      sums_.gradient[column] += squares_(width + 6, a);
      sums_.coupling[view.pose].row(column) += squares_.block<6, 1>(width, a).transpose();
    }
    sums_.pose[view.pose] += Eigen::Matrix<double, 6, 6>(squares_.block<6, 6>(width, width))
                                 .selfadjointView<Eigen::Lower>();
    sums_.pose_gradient[view.pose] += squares_.block<1, 6>(width + 6, width).transpose();
    return cost;
  }

  /// The same corner by corner, for a grid: it has many control points, of which few matter to a
  /// corner.
  double addSparse(const BundleView& view) {
    double cost = 0.0;
    Linearization corner;
    Eigen::MatrixXd& couple = sums_.coupling[view.pose];
    for (const Corner& c : *view.corners) {
      linearizeAt(view, c, corner);
      const Robust robust(corner.residual, options_.loss_px);
      const Eigen::Matrix<double, 2, 6> d_pose = robust.chain * corner.d_pose;
      cost += robust.cost;
      place_.clear();
      slopes_.clear();
      forEachColumn(view, corner, [&](int column, const Eigen::Vector2d& slope) {
        if (slope.x() == 0.0 && slope.y() == 0.0) return;
        place_.push_back(column);
        slopes_.push_back(robust.chain * slope);
      });
      for (std::size_t a = 0; a < place_.size(); ++a) {
        for (std::size_t b = 0; b <= a; ++b) {
          sums_.shared(place_[a], place_[b]) += slopes_[a].dot(slopes_[b]);
        }
        sums_.gradient[place_[a]] += slopes_[a].dot(robust.residual);
        couple.row(place_[a]).noalias() += slopes_[a].transpose() * d_pose;
      }
      sums_.pose[view.pose].noalias() += d_pose.transpose() * d_pose;
      sums_.pose_gradient[view.pose].noalias() += d_pose.transpose() * robust.residual;
    }
    return cost;
  }

  const std::vector<BundleView>& views_;
  const BundleOptions& options_;
  Blocks now_;
  Blocks trial_;
  Equations equations_;
  Equations sums_;
  std::vector<int> lens_column_;
  std::vector<int> grid_size_;
  int warp_column_ = 0;
  int rig_column_ = 0;
  int axis_column_ = 0;
  int columns_ = 0;
  Eigen::MatrixXd axis_steps_;
  // Room to work in.
  std::vector<int> place_;
  std::vector<Eigen::Vector2d> slopes_;
  RowMajor rows_;
  Eigen::MatrixXd squares_;
};

/// One pose, everything else fixed.
class PoseSystem {
 public:
  PoseSystem(const std::vector<BundleView>& views, double loss_px, const BundleState& state)
      : views_(views),
        loss_px_(loss_px),
        state_(state),
        rig_(blockOf(state.T_right_left).data()),
        now_(blockOf(state.poses[views.front().pose])),
        trial_(now_) {}

  double build() {
    const PoseValue pose(trial_.data());
    Linearization corner;
    trial_hessian_.setZero();
    trial_gradient_.setZero();
    trial_squares_ = 0.0;
    double cost = 0.0;
    for (const BundleView& view : views_) {
      const PoseValue* rig = view.camera == 1 ? &rig_ : nullptr;
      for (const Corner& c : *view.corners) {
        linearize(*state_.lenses[view.camera], pose, rig, state_.warp, view.travel * state_.axis, c,
                  true, corner);
        const Robust robust(corner.residual, loss_px_);
        const Eigen::Matrix<double, 2, 6> slope = robust.chain * corner.d_pose;
        trial_squares_ += corner.residual.squaredNorm();
        cost += robust.cost;
        trial_hessian_.noalias() += slope.transpose() * slope;
        trial_gradient_.noalias() += slope.transpose() * robust.residual;
      }
    }
    return std::isfinite(cost) ? cost : HUGE_VAL;
  }

  void accept() {
    now_ = trial_;
    hessian_ = trial_hessian_;
    gradient_ = trial_gradient_;
    squares_ = trial_squares_;
  }

  double propose(double damping) {
    const Vector6d step = damped(hessian_, damping).ldlt().solve(-gradient_);
    trial_ = now_ + step;
    return step.allFinite() ? -gradient_.dot(step) : -1.0;
  }

  Pose pose() const { return poseOf(now_); }
  double squares() const { return squares_; }

 private:
  const std::vector<BundleView>& views_;
  double loss_px_;
  const BundleState& state_;
  PoseValue rig_;
  Vector6d now_, trial_;
  Eigen::Matrix<double, 6, 6> hessian_, trial_hessian_;
  Vector6d gradient_, trial_gradient_;
  double squares_ = 0.0;
  double trial_squares_ = 0.0;
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
  BundleSystem system(views, options, state);
  if (!minimise(system, options.max_iterations, options.tolerance)) return false;
  state = system.state();
  return true;
}

double refinePose(const std::vector<BundleView>& views, double loss_px, BundleState& state,
                  int max_iterations) {
  PoseSystem system(views, loss_px, state);
  std::size_t count = 0;
  for (const BundleView& view : views) count += view.corners->size();
  if (!minimise(system, max_iterations, 1e-12)) return HUGE_VAL;
  const double rms = std::sqrt(system.squares() / static_cast<double>(count));
  state.poses[views.front().pose] = system.pose();
  return rms;
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
  BundleOptions plain = options;
  plain.loss_px = 0.0;
  BundleSystem system(views, plain, state);
  system.build();
  system.accept();
  const Equations& equations = system.equations();
  Eigen::MatrixXd information = equations.shared;
  for (std::size_t i = 0; i < state.poses.size(); ++i) {
    if (!system.used(i)) continue;
    const Eigen::MatrixXd& coupling = equations.coupling[i];
    information.noalias() -= coupling * equations.pose[i].ldlt().solve(coupling.transpose());
  }
  return 0.5 * (information + information.transpose());
}

}  // namespace omnister::calibration
