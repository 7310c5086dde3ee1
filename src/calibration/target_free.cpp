// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/target_free.h"

#include <ceres/ceres.h>
#include <ceres/evaluation_callback.h>

#include <Eigen/Dense>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <random>
#include <string>

#include "bundle.h"
#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "omnister/lens/lens_fit.h"
#include "pose_block.h"

namespace omnister {
namespace {

using calibration::blockOf;
using calibration::crossMatrix;
using calibration::poseOf;
using calibration::PoseValue;
using calibration::projectContinued;
using calibration::Vector6d;
using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

/// Rays that meet at less than this say nothing about distance [rad].
constexpr double kLeastParallax = 0.01;
/// A match between scans is as good as two descriptors' places, several times worse than a path
/// that is followed: held as firmly, it would bend the lens.
constexpr double kMatchWeight = 0.5;
constexpr double kMatchLimitPx = 4.0;
/// Two scans must share this many points to be joined.
constexpr int kLeastShared = 25;
/// log c is taken as known below this standard deviation.
constexpr double kScaleKnown = 0.02;
constexpr double kNowherePx = 1e3;
/// Off-axis angle at which the slope on the axis is taken [rad].
constexpr double kAxisAngle = 0.02;

struct Observation {
  int point = 0;
  int scan = 0;
  double travel = 0.0;  ///< stage position [m]
  Eigen::Vector2d pixel;
  double weight = 1.0;  ///< kMatchWeight in another scan than the point's own
};

/// All that is estimated. A scene point X lies at T_scan X - travel axis in the camera.
struct Estimate {
  LensPtr lens;
  Eigen::Vector3d axis = Eigen::Vector3d::UnitX();
  std::vector<Pose> T_scan;  ///< [scan]
  std::vector<Eigen::Vector3d> points;
  std::vector<Pose> T_camera_board;  ///< [board view]
};

struct Data {
  std::vector<Observation> observations;
  const Detections* boards = nullptr;
  std::optional<KnownAngle> known_angle;
  std::optional<double> pinned_slope;  ///< holds c where nothing else does [px/rad]
};

/// Image radius [px] per radian on the axis, with its gradient.
double axisSlope(const LensModel& lens, Eigen::RowVectorXd* d_parameters = nullptr) {
  JacobianParams d_off, d_on;
  const auto off = lens.project(Eigen::Vector3d(std::sin(kAxisAngle), 0.0, std::cos(kAxisAngle)),
                                nullptr, d_parameters ? &d_off : nullptr);
  const auto on = lens.project(Eigen::Vector3d::UnitZ(), nullptr, d_parameters ? &d_on : nullptr);
  if (!off || !on) return std::numeric_limits<double>::quiet_NaN();
  if (d_parameters != nullptr) *d_parameters = (d_off.row(0) - d_on.row(0)) / kAxisAngle;
  return (off->x() - on->x()) / kAxisAngle;
}

class Blocks : public ceres::EvaluationCallback {
 public:
  explicit Blocks(const Estimate& start) : start_(start), lens_block(start.lens->parameters()) {
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

  std::optional<Estimate> estimate() const {
    Estimate result;
    result.lens = start_.lens->withParameters(lens_block);
    if (!result.lens) return std::nullopt;
    result.axis = axis.normalized();
    for (const Vector6d& block : scan_blocks) result.T_scan.push_back(poseOf(block));
    for (const Vector6d& block : board_blocks) result.T_camera_board.push_back(poseOf(block));
    result.points = points;
    return result;
  }

 private:
  const Estimate& start_;

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
  PointCost(const Observation& observation, const Blocks& blocks)
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
  const Observation& observation_;
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

struct AdjustOptions {
  double loss_px = 1.0;
  bool scans = false;  ///< free the poses of all scans but the first
  int max_iterations = 50;
  int threads = 1;
};

/// Cost per observation after the adjustment, or nothing when it failed.
std::optional<double> adjust(const Data& data, const AdjustOptions& options, Estimate& estimate) {
  Blocks blocks(estimate);
  ceres::Problem::Options problem_options;
  problem_options.evaluation_callback = &blocks;
  ceres::Problem problem(problem_options);
  auto ordering = std::make_shared<ceres::ParameterBlockOrdering>();
  std::vector<bool> scan_used(blocks.scan_blocks.size(), false);
  std::vector<bool> point_used(blocks.points.size(), false);
  double* lens = blocks.lens_block.data();
  for (const Observation& o : data.observations) {
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
            new ceres::CauchyLoss(options.loss_px), lens, blocks.board_blocks[v].data());
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

Eigen::Vector3d inCamera(const Observation& o, const Estimate& estimate) {
  return estimate.T_scan[o.scan] * estimate.points[o.point] - o.travel * estimate.axis;
}

double residualOf(const Observation& o, const Estimate& estimate) {
  const auto pixel = projectContinued(*estimate.lens, inCamera(o, estimate));
  return pixel ? (*pixel - o.pixel).norm() : kNowherePx;
}

double median(std::vector<double> values) {
  if (values.empty()) return std::numeric_limits<double>::quiet_NaN();
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// Nearest point to the rays of a track in its scan's frame; nothing without parallax or behind.
std::optional<Eigen::Vector3d> triangulateTrack(const std::vector<const Observation*>& track,
                                                const LensModel& lens,
                                                const Eigen::Vector3d& axis) {
  Eigen::Matrix3d M = Eigen::Matrix3d::Zero();
  Eigen::Vector3d rhs = Eigen::Vector3d::Zero();
  std::vector<Eigen::Vector3d> rays;
  for (const Observation* o : track) {
    const auto ray = lens.unproject(o->pixel);
    if (!ray) continue;
    const Eigen::Matrix3d across = Eigen::Matrix3d::Identity() - *ray * ray->transpose();
    M += across;
    rhs += across * (o->travel * axis);
    rays.push_back(*ray);
  }
  if (rays.size() < 2) return std::nullopt;
  double parallax = 0.0;
  for (const auto& ray : rays) {
    parallax = std::max(parallax, std::atan2(ray.cross(rays[0]).norm(), ray.dot(rays[0])));
  }
  if (parallax < kLeastParallax) return std::nullopt;
  const Eigen::Vector3d point = M.ldlt().solve(rhs);
  if (!point.allFinite()) return std::nullopt;
  std::size_t k = 0;
  for (const Observation* o : track) {
    if (!lens.unproject(o->pixel)) continue;
    if ((point - o->travel * axis).dot(rays[k++]) <= 0.0) return std::nullopt;
  }
  return point;
}

std::vector<std::vector<const Observation*>> byPoint(const std::vector<Observation>& observations,
                                                     std::size_t points) {
  std::vector<std::vector<const Observation*>> result(points);
  for (const Observation& o : observations) result[o.point].push_back(&o);
  return result;
}

/// Direction of travel from the planes that each track's rays span (all contain the axis).
Eigen::Vector3d findAxis(const std::vector<std::vector<const Observation*>>& tracks,
                         const LensModel& lens) {
  std::vector<Eigen::Vector3d> normals;
  for (const auto& track : tracks) {
    if (track.size() < 2) continue;
    const auto [low, high] = std::minmax_element(
        track.begin(), track.end(),
        [](const Observation* a, const Observation* b) { return a->travel < b->travel; });
    const auto first = lens.unproject((*low)->pixel);
    const auto last = lens.unproject((*high)->pixel);
    if (first && last) normals.push_back(first->cross(*last));
  }
  Eigen::Vector3d axis = Eigen::Vector3d::UnitX();
  std::vector<double> weights(normals.size(), 1.0);
  for (int iteration = 0; iteration < 10; ++iteration) {
    Eigen::Matrix3d M = Eigen::Matrix3d::Zero();
    for (std::size_t i = 0; i < normals.size(); ++i) {
      M += weights[i] * normals[i] * normals[i].transpose();
    }
    axis = Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(M).eigenvectors().col(0);
    for (std::size_t i = 0; i < normals.size(); ++i) {
      const double error = normals[i].dot(axis) / 0.005;
      weights[i] = 1.0 / (1.0 + error * error);
    }
  }
  // Points lie before the camera for one of the two signs.
  int votes = 0;
  for (const auto& track : tracks) {
    if (triangulateTrack(track, lens, axis)) ++votes;
    if (triangulateTrack(track, lens, -axis)) --votes;
  }
  return votes >= 0 ? axis : Eigen::Vector3d(-axis);
}

/// Standard deviation of a followed feature's position along one axis [px], blind to outliers.
double noiseOf(const std::vector<Observation>& observations, const Estimate& estimate) {
  std::vector<double> residuals;
  for (const Observation& o : observations) {
    if (o.weight == 1.0) residuals.push_back(residualOf(o, estimate));
  }
  // The median of a 2-D error of standard deviation sigma an axis is 1.177 sigma.
  return median(std::move(residuals)) / 1.177;
}

/// Drops observations whose residual stands out, then points with fewer than `least` of them or
/// without parallax; renumbers the points.
void prune(std::vector<Observation>& observations, Estimate& estimate, double least_limit_px,
           std::vector<int>* point_of = nullptr) {
  const double limit = std::max(least_limit_px, 4.0 * noiseOf(observations, estimate));
  std::vector<Observation> kept;
  for (const Observation& o : observations) {
    if (residualOf(o, estimate) <= (o.weight < 1.0 ? kMatchLimitPx : limit)) kept.push_back(o);
  }
  std::vector<int> count(estimate.points.size(), 0);
  std::vector<Eigen::Vector3d> first(estimate.points.size());
  std::vector<double> parallax(estimate.points.size(), 0.0);
  for (const Observation& o : kept) {
    if (o.weight < 1.0) continue;
    // Seen along the same directions in every scan: rotate back into the scene's frame.
    const Eigen::Vector3d ray =
        (estimate.T_scan[o.scan].linear().transpose() * inCamera(o, estimate)).normalized();
    if (count[o.point]++ == 0) first[o.point] = ray;
    parallax[o.point] = std::max(
        parallax[o.point], std::atan2(ray.cross(first[o.point]).norm(), ray.dot(first[o.point])));
  }
  std::vector<int> renumbered(estimate.points.size(), -1);
  std::vector<Eigen::Vector3d> points;
  for (std::size_t p = 0; p < estimate.points.size(); ++p) {
    if (count[p] < 3 || parallax[p] < kLeastParallax) continue;
    renumbered[p] = static_cast<int>(points.size());
    points.push_back(estimate.points[p]);
  }
  observations.clear();
  for (Observation o : kept) {
    o.point = renumbered[o.point];
    if (o.point >= 0) observations.push_back(o);
  }
  estimate.points = std::move(points);
  if (point_of != nullptr) {
    for (int& p : *point_of) {
      if (p >= 0) p = renumbered[p];
    }
  }
}

/// Rays of `lens` over its field as pairs of bearing and pixel.
void sampleLens(const LensModel& lens, double max_theta, std::vector<Eigen::Vector3d>& bearings,
                std::vector<Eigen::Vector2d>& pixels) {
  for (int i = 1; i <= 60; ++i) {
    const double theta = max_theta * i / 60.0 * (1.0 - 1e-9);
    for (int j = 0; j < 12; ++j) {
      const double azimuth = 2.0 * M_PI * j / 12.0;
      const Eigen::Vector3d bearing(std::sin(theta) * std::cos(azimuth),
                                    std::sin(theta) * std::sin(azimuth), std::cos(theta));
      if (const auto pixel = lens.project(bearing)) {
        bearings.push_back(bearing);
        pixels.push_back(*pixel);
      }
    }
  }
}

LensPtr refit(const LensModel& lens, const LensStructure& structure) {
  std::vector<Eigen::Vector3d> bearings;
  std::vector<Eigen::Vector2d> pixels;
  sampleLens(lens, lens.maxTheta(), bearings, pixels);
  const LensPtr start = makeLens(structure, lens.center(), axisSlope(lens), lens.maxTheta());
  return fitLens(*start, bearings, pixels).lens;
}

double largestAngle(const std::vector<Observation>& observations, const Estimate& estimate) {
  double largest = 0.0;
  for (const Observation& o : observations) {
    const Eigen::Vector3d X = inCamera(o, estimate);
    largest = std::max(largest, std::atan2(X.head<2>().norm(), X.z()));
  }
  return largest;
}

/// The reconstruction in which rays (x, y, h) become (x, y, c h): an equal of the first where every
/// scan stands alone.
std::optional<Estimate> scaled(const Estimate& estimate, double c) {
  Estimate result = estimate;
  result.lens = scaleSurface(*estimate.lens, c);
  if (!result.lens) return std::nullopt;
  const Eigen::DiagonalMatrix<double, 3> D(1.0, 1.0, c);
  const Eigen::Vector3d axis = D * estimate.axis;
  // Stage positions are metric, so the length of the axis sets that of the scene.
  const double shrink = 1.0 / axis.norm();
  result.axis = axis * shrink;
  for (Eigen::Vector3d& point : result.points) point = shrink * (D * point);
  return result;
}

/// Affine map between two scans' scenes and which matches follow it.
struct AffineFit {
  Eigen::Matrix3d A = Eigen::Matrix3d::Identity();
  Eigen::Vector3d t = Eigen::Vector3d::Zero();
  std::vector<std::size_t> inliers;
};

struct PointMatch {
  int from = 0;  ///< point index in the first scan's scene
  int to = 0;
  const Observation* seen = nullptr;  ///< of `to`, in its own scan
};

AffineFit solveAffine(const std::vector<PointMatch>& matches,
                      const std::vector<std::size_t>& chosen,
                      const std::vector<Eigen::Vector3d>& points) {
  Eigen::Matrix4d N = Eigen::Matrix4d::Zero();
  Eigen::Matrix<double, 4, 3> rhs = Eigen::Matrix<double, 4, 3>::Zero();
  for (std::size_t i : chosen) {
    const Eigen::Vector4d x = points[matches[i].from].homogeneous();
    const Eigen::Vector3d& y = points[matches[i].to];
    // Depth errors grow with the square of range.
    const double weight = 1.0 / std::max(1e-12, std::pow(y.squaredNorm(), 2));
    N += weight * x * x.transpose();
    rhs += weight * x * y.transpose();
  }
  const Eigen::Matrix<double, 4, 3> solution = N.ldlt().solve(rhs);
  AffineFit fit;
  fit.A = solution.topRows<3>().transpose();
  fit.t = solution.row(3).transpose();
  return fit;
}

AffineFit findAffine(const std::vector<PointMatch>& matches, const Estimate& estimate) {
  constexpr double kInlierPx = 4.0;
  AffineFit best;
  if (matches.size() < static_cast<std::size_t>(kLeastShared)) return best;
  const auto inliersOf = [&](const AffineFit& fit) {
    std::vector<std::size_t> inliers;
    if (!fit.A.allFinite() || !fit.t.allFinite()) return inliers;
    for (std::size_t i = 0; i < matches.size(); ++i) {
      const Observation& o = *matches[i].seen;
      const Eigen::Vector3d X = fit.A * estimate.points[matches[i].from] + fit.t;
      const auto pixel = estimate.lens->project(X - o.travel * estimate.axis);
      if (pixel && (*pixel - o.pixel).norm() < kInlierPx) inliers.push_back(i);
    }
    return inliers;
  };
  std::mt19937 random(1);
  std::uniform_int_distribution<std::size_t> pick(0, matches.size() - 1);
  for (int trial = 0; trial < 4000; ++trial) {
    std::vector<std::size_t> sample;
    while (sample.size() < 4) {
      const std::size_t i = pick(random);
      if (std::find(sample.begin(), sample.end(), i) == sample.end()) sample.push_back(i);
    }
    AffineFit fit = solveAffine(matches, sample, estimate.points);
    fit.inliers = inliersOf(fit);
    if (fit.inliers.size() > best.inliers.size()) best = std::move(fit);
  }
  for (int iteration = 0; iteration < 5 && best.inliers.size() >= 8; ++iteration) {
    AffineFit fit = solveAffine(matches, best.inliers, estimate.points);
    fit.inliers = inliersOf(fit);
    if (fit.inliers.size() < best.inliers.size()) break;
    best = std::move(fit);
  }
  return best;
}

/// How far D^-1 A D is from a rotation.
double rotationDefect(const Eigen::Matrix3d& A, double c) {
  const Eigen::DiagonalMatrix<double, 3> D(1.0, 1.0, c);
  const Eigen::DiagonalMatrix<double, 3> inverse(1.0, 1.0, 1.0 / c);
  const Eigen::Matrix3d M = inverse * A * D;
  return (M.transpose() * M - Eigen::Matrix3d::Identity()).squaredNorm();
}

Eigen::Matrix3d nearestRotation(const Eigen::Matrix3d& M) {
  const Eigen::JacobiSVD<Eigen::Matrix3d> svd(M, Eigen::ComputeFullU | Eigen::ComputeFullV);
  Eigen::Matrix3d R = svd.matrixU() * svd.matrixV().transpose();
  if (R.determinant() < 0.0) {
    Eigen::Matrix3d U = svd.matrixU();
    U.col(2) = -U.col(2);
    R = U * svd.matrixV().transpose();
  }
  return R;
}

/// Covariance of the lens parameters with points, axis and poses eliminated; unit weight residuals.
/// The pin is left out, so that a scale that only the pin holds shows as a huge variance.
Eigen::MatrixXd lensCovariance(const Data& data, const Estimate& estimate, bool scans_free) {
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
      const Observation& o = *track[i];
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

/// Pose of a board from scratch: the best of several starts.
std::optional<Pose> boardPose(const ViewDetections& view, const Estimate& estimate) {
  // Direction of the middle of the board, and its distance from its angular size.
  std::vector<Eigen::Vector3d> rays;
  Eigen::Vector3d mean_ray = Eigen::Vector3d::Zero();
  Eigen::Vector3d mean_point = Eigen::Vector3d::Zero();
  for (std::size_t i = 0; i < view.pixels.size(); ++i) {
    const auto ray = estimate.lens->unproject(view.pixels[i]);
    if (!ray) return std::nullopt;
    rays.push_back(*ray);
    mean_ray += *ray;
    mean_point += view.points[i];
  }
  mean_ray.normalize();
  mean_point /= static_cast<double>(view.points.size());
  double size = 0.0;
  double spread = 0.0;
  for (std::size_t i = 0; i < rays.size(); ++i) {
    size = std::max(size, (view.points[i] - mean_point).norm());
    spread = std::max(spread, std::acos(std::clamp(rays[i].dot(mean_ray), -1.0, 1.0)));
  }
  if (!(spread > 1e-4) || !(size > 0.0)) return std::nullopt;
  const double distance = size / std::tan(std::min(spread, 1.2));
  Data data;
  Detections one;
  one.views = {view};
  std::optional<Pose> best;
  double best_cost = std::numeric_limits<double>::infinity();
  const Eigen::Quaterniond facing =
      Eigen::Quaterniond::FromTwoVectors(Eigen::Vector3d::UnitZ(), mean_ray);
  for (int turn = 0; turn < 8; ++turn) {
    for (const double tilt : {-0.6, 0.0, 0.6}) {
      for (const int flip : {0, 1}) {
        Pose pose = Pose::Identity();
        pose.linear() = (facing * Eigen::AngleAxisd(turn * M_PI / 4, Eigen::Vector3d::UnitZ()) *
                         Eigen::AngleAxisd(tilt + flip * M_PI, Eigen::Vector3d::UnitX()))
                            .toRotationMatrix();
        pose.translation() = distance * mean_ray - pose.linear() * mean_point;
        Estimate trial;
        trial.lens = estimate.lens;
        trial.T_camera_board = {pose};
        Blocks blocks(trial);
        ceres::Problem::Options problem_options;
        problem_options.evaluation_callback = &blocks;
        ceres::Problem problem(problem_options);
        for (std::size_t i = 0; i < view.pixels.size(); ++i) {
          problem.AddResidualBlock(new CornerCost(view.pixels[i], view.points[i], 0, blocks),
                                   new ceres::CauchyLoss(5.0), blocks.lens_block.data(),
                                   blocks.board_blocks[0].data());
        }
        problem.SetParameterBlockConstant(blocks.lens_block.data());
        ceres::Solver::Options solver;
        solver.linear_solver_type = ceres::DENSE_QR;
        solver.max_num_iterations = 30;
        solver.logging_type = ceres::SILENT;
        ceres::Solver::Summary summary;
        ceres::Solve(solver, &problem, &summary);
        if (summary.IsSolutionUsable() && summary.final_cost < best_cost) {
          best_cost = summary.final_cost;
          best = poseOf(blocks.board_blocks[0]);
        }
      }
    }
  }
  return best;
}

/// The scale c for which the boards are seen best, each with a pose of its own.
double scaleFromBoards(const Detections& boards, const Estimate& estimate, int threads) {
  const int steps = 41;
  std::vector<double> costs(steps, std::numeric_limits<double>::infinity());
  const auto scaleAt = [](int i) { return std::exp(-1.0 + 2.0 * i / (steps - 1)); };
  parallelFor(0, steps, threads, [&](std::size_t i) {
    const LensPtr lens = scaleSurface(*estimate.lens, scaleAt(static_cast<int>(i)));
    if (!lens) return;
    Estimate trial;
    trial.lens = lens;
    double cost = 0.0;
    for (const ViewDetections& view : boards.views) {
      const auto pose = boardPose(view, trial);
      if (!pose) return;
      for (std::size_t k = 0; k < view.pixels.size(); ++k) {
        const auto pixel = projectContinued(*lens, *pose * view.points[k]);
        cost += pixel ? std::min(100.0, (*pixel - view.pixels[k]).squaredNorm()) : 100.0;
      }
    }
    costs[i] = cost;
  });
  return scaleAt(static_cast<int>(std::min_element(costs.begin(), costs.end()) - costs.begin()));
}

double angleBetween(const LensModel& lens, const KnownAngle& known) {
  const auto first = lens.unproject(known.first);
  const auto second = lens.unproject(known.second);
  if (!first || !second) return std::numeric_limits<double>::quiet_NaN();
  return std::atan2(first->cross(*second).norm(), first->dot(*second));
}

double scaleFromAngle(const KnownAngle& known, const Estimate& estimate) {
  double best = 1.0;
  double best_error = std::numeric_limits<double>::infinity();
  for (int i = 0; i <= 400; ++i) {
    const double c = std::exp(-1.5 + 3.0 * i / 400.0);
    const auto first = estimate.lens->unproject(known.first);
    const auto second = estimate.lens->unproject(known.second);
    if (!first || !second) break;
    Eigen::Vector3d a = *first, b = *second;
    a.z() *= c;
    b.z() *= c;
    const double error = std::abs(std::atan2(a.cross(b).norm(), a.dot(b)) - known.angle);
    if (error < best_error) {
      best_error = error;
      best = c;
    }
  }
  return best;
}

void report(const TargetFreeOptions& options, double fraction, const std::string& stage) {
  if (options.progress) options.progress(fraction, stage);
}

std::string degrees(double radians) {
  char text[32];
  std::snprintf(text, sizeof text, "%.1f", radians * 180.0 / M_PI);
  return text;
}

}  // namespace

LensPtr scaleSurface(const LensModel& lens, double c) {
  if (!(c > 0.0) || !std::isfinite(c)) return nullptr;
  std::vector<Eigen::Vector3d> bearings;
  std::vector<Eigen::Vector2d> pixels;
  sampleLens(lens, lens.maxTheta(), bearings, pixels);
  if (bearings.empty()) return nullptr;
  double max_theta = 0.0;
  for (Eigen::Vector3d& bearing : bearings) {
    bearing.z() *= c;
    max_theta = std::max(max_theta, std::atan2(bearing.head<2>().norm(), bearing.z()));
  }
  max_theta = std::min(max_theta * (1.0 + 1e-6) + 1e-6, M_PI - 1e-3);
  try {
    const LensPtr start =
        makeLens(structureOf(lens), lens.center(), axisSlope(lens) * c, max_theta);
    const LensFit fit = fitLens(*start, bearings, pixels);
    return fit.lens && fit.rms_px <= 0.05 ? fit.lens : nullptr;
  } catch (const Error&) {
    return nullptr;
  }
}

TargetFreeResult calibrateTargetFree(const FeatureTracks& tracks,
                                     const TargetFreeOptions& options) {
  const int threads = threadCount(options.threads);
  const std::string stage = "adjusting";
  Data data;
  Estimate estimate;
  estimate.T_scan.assign(tracks.positions_m.size(), Pose::Identity());

  // Every track is a point of its own scan's scene at first.
  std::vector<int> point_of(tracks.tracks.size(), -1);
  double farthest = 0.0;
  const Eigen::Vector2d middle(0.5 * (tracks.image_size.width - 1),
                               0.5 * (tracks.image_size.height - 1));
  for (std::size_t t = 0; t < tracks.tracks.size(); ++t) {
    const FeatureTrack& track = tracks.tracks[t];
    if (track.observations.size() < 3 &&
        tracks.positions_m[track.observations.front().scan].size() > 2) {
      continue;
    }
    point_of[t] = static_cast<int>(estimate.points.size());
    for (const auto& seen : track.observations) {
      data.observations.push_back(
          {point_of[t], seen.scan, tracks.positions_m[seen.scan][seen.image], seen.pixel});
      farthest = std::max(farthest, (seen.pixel - middle).norm());
    }
    estimate.points.push_back(Eigen::Vector3d::Zero());
  }
  if (estimate.points.size() < 50) {
    throw Error(
        "only " + std::to_string(estimate.points.size()) +
        " features could be followed through the scan, expected 50 or more: is there texture, "
        "and are the steps of the stage small beside the distances?");
  }

  // A conic from several fields of view, on a part of the points; the slope on the axis is held,
  // since a straight scan leaves it open.
  struct Start {
    std::optional<double> cost;
    Estimate estimate;
    Data data;
    std::vector<int> point_of;
  };
  const std::vector<double> fields = {40.0, 55.0, 70.0, 80.0, 90.0, 100.0, 110.0, 125.0};
  std::vector<Start> starts(fields.size());
  report(options, 0.0, stage);
  parallelFor(0, fields.size(), threads, [&](std::size_t i) {
    Start& start = starts[i];
    const double theta = fields[i] * M_PI / 180.0;
    LensStructure conic;
    conic.model = "conic";
    const double slope = farthest / theta;
    start.estimate = estimate;
    start.point_of = point_of;
    try {
      start.estimate.lens = makeLens(conic, middle, slope, std::min(theta * 1.1, 2.6));
    } catch (const Error&) {
      return;
    }
    const auto rays = byPoint(data.observations, estimate.points.size());
    start.estimate.axis = findAxis(rays, *start.estimate.lens);
    std::vector<bool> good(estimate.points.size(), false);
    const std::size_t stride = std::max<std::size_t>(1, estimate.points.size() / 200);
    for (std::size_t p = 0; p < estimate.points.size(); ++p) {
      const auto point = triangulateTrack(rays[p], *start.estimate.lens, start.estimate.axis);
      if (!point) continue;
      start.estimate.points[p] = *point;
      good[p] = p % stride == 0;
    }
    for (const Observation& o : data.observations) {
      if (good[o.point]) start.data.observations.push_back(o);
    }
    start.data.pinned_slope = axisSlope(*start.estimate.lens);
    const std::size_t used = std::count(good.begin(), good.end(), true);
    if (used < 30) return;
    AdjustOptions first;
    first.loss_px = 3.0;
    first.max_iterations = 40;
    Estimate trial = start.estimate;
    const auto cost = adjust(start.data, first, trial);
    if (!cost) return;
    // Points that were not explained at all count as badly as an outlier does.
    const double share = static_cast<double>(used) * stride / estimate.points.size();
    start.cost = *cost + (1.0 - std::min(1.0, share)) * 9.0;
    start.estimate.lens = trial.lens;
    start.estimate.axis = trial.axis;
  });
  const auto better = [](const Start& a, const Start& b) {
    return a.cost.value_or(std::numeric_limits<double>::infinity()) <
           b.cost.value_or(std::numeric_limits<double>::infinity());
  };
  const Start& best = *std::min_element(starts.begin(), starts.end(), better);
  if (!best.cost) {
    throw Error(
        "no lens explains how the features moved: are the stage positions those of the images, "
        "and did the scene stand still?");
  }

  // All points, then the structure that was asked for.
  estimate.lens = best.estimate.lens;
  estimate.axis = best.estimate.axis;
  data.pinned_slope = axisSlope(*estimate.lens);
  {
    const auto rays = byPoint(data.observations, estimate.points.size());
    std::vector<bool> good(estimate.points.size(), false);
    for (std::size_t p = 0; p < estimate.points.size(); ++p) {
      const auto point = triangulateTrack(rays[p], *estimate.lens, estimate.axis);
      if (!point) continue;
      estimate.points[p] = *point;
      good[p] = true;
    }
    std::vector<Observation> kept;
    for (const Observation& o : data.observations) {
      if (good[o.point]) kept.push_back(o);
    }
    data.observations = std::move(kept);
  }
  report(options, 0.2, stage);
  AdjustOptions adjustment;
  adjustment.threads = threads;
  const auto adjustOrThrow = [&](double loss_px, bool scans) {
    adjustment.loss_px = loss_px;
    adjustment.scans = scans;
    if (!adjust(data, adjustment, estimate)) {
      throw Error("the adjustment of lens, axis and scene did not converge");
    }
  };
  adjustOrThrow(2.0, false);
  prune(data.observations, estimate, 3.0, &point_of);
  const auto widen = [&](double margin) {
    const double field = std::min(largestAngle(data.observations, estimate) * margin, M_PI - 0.05);
    if (auto lens = estimate.lens->withParameters(estimate.lens->parameters(), field)) {
      estimate.lens = lens;
    }
  };
  widen(1.01);
  if (!(structureOf(*estimate.lens).model == options.structure.model &&
        options.structure.model == "conic")) {
    estimate.lens = refit(*estimate.lens, options.structure);
    data.pinned_slope = axisSlope(*estimate.lens);
  }
  adjustOrThrow(1.0, false);
  prune(data.observations, estimate, 1.0, &point_of);
  adjustOrThrow(0.5, false);
  if (estimate.points.size() < 50) {
    throw Error(
        "only " + std::to_string(estimate.points.size()) +
        " features agree on one lens and one axis, expected 50 or more: did the scene stand "
        "still, and are the stage positions right?");
  }
  report(options, 0.5, stage);

  TargetFreeResult result;
  result.joined.assign(tracks.positions_m.size(), false);
  result.joined[0] = true;

  // Join the scans: an affine map of scene to scene, of which the one scale c makes a rotation.
  struct Joint {
    int scan = 0;
    int from = 0;
    AffineFit fit;
    std::vector<PointMatch> matches;
  };
  std::vector<Joint> joints;
  std::vector<const Observation*> sight(estimate.points.size(), nullptr);
  std::vector<int> scan_of(estimate.points.size(), 0);
  for (const Observation& o : data.observations) {
    sight[o.point] = &o;
    scan_of[o.point] = o.scan;
  }
  for (bool grown = true; grown;) {
    grown = false;
    Joint strongest;
    for (std::size_t k = 0; k < result.joined.size(); ++k) {
      if (result.joined[k]) continue;
      for (std::size_t j = 0; j < result.joined.size(); ++j) {
        if (!result.joined[j]) continue;
        Joint joint;
        joint.scan = static_cast<int>(k);
        joint.from = static_cast<int>(j);
        for (const TrackMatch& match : tracks.matches) {
          int a = point_of[match.first];
          int b = point_of[match.second];
          if (a < 0 || b < 0) continue;
          if (scan_of[a] == joint.scan && scan_of[b] == joint.from) std::swap(a, b);
          if (scan_of[a] != joint.from || scan_of[b] != joint.scan) continue;
          joint.matches.push_back({a, b, sight[b]});
        }
        joint.fit = findAffine(joint.matches, estimate);
        if (joint.fit.inliers.size() > strongest.fit.inliers.size()) strongest = std::move(joint);
      }
    }
    if (strongest.fit.inliers.size() >= static_cast<std::size_t>(kLeastShared)) {
      result.joined[strongest.scan] = true;
      joints.push_back(std::move(strongest));
      grown = true;
    }
  }
  for (std::size_t k = 1; k < result.joined.size(); ++k) {
    if (!result.joined[k]) {
      result.warnings.push_back("scan " + std::to_string(k + 1) +
                                " shares too few points with the others to be joined to them");
    }
  }

  double c = 1.0;
  if (options.known_angle) {
    if (!std::isfinite(angleBetween(*estimate.lens, *options.known_angle))) {
      throw Error("the known angle names a pixel outside the field that the features cover");
    }
    c = 1.0 / scaleFromAngle(*options.known_angle, estimate);
  } else if (!options.boards.views.empty()) {
    c = 1.0 / scaleFromBoards(options.boards, estimate, threads);
  } else if (!joints.empty()) {
    double least = std::numeric_limits<double>::infinity();
    for (int i = 0; i <= 600; ++i) {
      const double trial = std::exp(-1.5 + 3.0 * i / 600.0);
      double defect = 0.0;
      for (const Joint& joint : joints) defect += rotationDefect(joint.fit.A, trial);
      if (defect < least) {
        least = defect;
        c = trial;
      }
    }
  }
  if (c != 1.0) {
    if (auto rescaled = scaled(estimate, 1.0 / c)) {
      const double shrink =
          1.0 /
          (Eigen::Vector3d(estimate.axis.x(), estimate.axis.y(), estimate.axis.z() / c)).norm();
      estimate = std::move(*rescaled);
      const Eigen::DiagonalMatrix<double, 3> D(1.0, 1.0, c);
      const Eigen::DiagonalMatrix<double, 3> inverse(1.0, 1.0, 1.0 / c);
      for (Joint& joint : joints) {
        joint.fit.A = inverse * joint.fit.A * D;
        joint.fit.t = shrink * (inverse * joint.fit.t);
      }
      data.pinned_slope = axisSlope(*estimate.lens);
    }
  }

  // One scene for all joined scans. A point stays that of its own scan, and is seen from the other
  // scan where its match stands.
  std::vector<Observation> matched;
  for (const Joint& joint : joints) {
    Pose T = Pose::Identity();
    T.linear() = nearestRotation(joint.fit.A);
    // With the rotation given, the translation is the mean of what remains.
    Eigen::Vector3d sum = Eigen::Vector3d::Zero();
    double weights = 0.0;
    for (std::size_t i : joint.fit.inliers) {
      const PointMatch& match = joint.matches[i];
      const double weight = 1.0 / std::max(1e-12, estimate.points[match.to].squaredNorm());
      sum += weight * (estimate.points[match.to] - T.linear() * estimate.points[match.from]);
      weights += weight;
    }
    T.translation() = sum / weights;
    for (std::size_t i : joint.fit.inliers) {
      Observation seen = *joint.matches[i].seen;
      seen.point = joint.matches[i].from;
      seen.weight = kMatchWeight;
      matched.push_back(seen);
    }
    estimate.T_scan[joint.scan] = T * estimate.T_scan[joint.from];
  }
  for (std::size_t p = 0; p < estimate.points.size(); ++p) {
    estimate.points[p] = estimate.T_scan[scan_of[p]].inverse() * estimate.points[p];
  }
  data.observations.insert(data.observations.end(), matched.begin(), matched.end());

  data.known_angle = options.known_angle;
  if (!options.boards.views.empty()) {
    data.boards = &options.boards;
    for (const ViewDetections& view : options.boards.views) {
      const auto pose = boardPose(view, estimate);
      if (!pose) {
        throw InputError(view.name, "", "the board lies outside the field that the features cover");
      }
      estimate.T_camera_board.push_back(*pose);
    }
  }
  report(options, 0.6, stage);
  const bool other_information =
      !joints.empty() || data.known_angle.has_value() || data.boards != nullptr;
  // First with the scale held, so that poses and points settle; then free, if anything may fix it.
  if (!joints.empty() || data.boards != nullptr) {
    if (!data.known_angle) adjustOrThrow(3.0, true);
    prune(data.observations, estimate, 2.0);
  }
  const std::optional<double> pin = data.pinned_slope;
  const auto sigmaOfScale = [&](double noise_px) {
    const Eigen::MatrixXd covariance = lensCovariance(data, estimate, !joints.empty());
    Eigen::RowVectorXd gradient;
    const double slope = axisSlope(*estimate.lens, &gradient);
    return noise_px / slope *
           std::sqrt(std::max(0.0, (gradient * covariance * gradient.transpose())(0)));
  };
  const auto noise = [&] { return noiseOf(data.observations, estimate); };
  bool known = false;
  if (other_information) {
    known = data.known_angle.has_value() || sigmaOfScale(noise()) < kScaleKnown;
    if (known) data.pinned_slope.reset();
  }
  adjustOrThrow(1.0, true);
  prune(data.observations, estimate, 1.0);
  widen(1.01);
  report(options, 0.8, stage);
  adjustOrThrow(0.5, true);
  if (known && !data.known_angle && sigmaOfScale(noise()) >= kScaleKnown) {
    known = false;
    data.pinned_slope = pin;
    adjustOrThrow(0.5, true);
  }
  report(options, 1.0, stage);

  result.scale_sigma =
      other_information ? sigmaOfScale(noise()) : std::numeric_limits<double>::infinity();
  if (known) {
    result.scale = data.known_angle         ? SurfaceScale::kKnownAngle
                   : data.boards != nullptr ? SurfaceScale::kBoard
                                            : SurfaceScale::kRotatedScans;
  } else {
    result.scale_sigma = std::numeric_limits<double>::infinity();
    if (!joints.empty()) {
      double turn = 0.0;
      for (std::size_t k = 0; k < estimate.T_scan.size(); ++k) {
        const Eigen::Vector3d axis = estimate.T_scan[k].linear().col(2);
        turn = std::max(turn, std::acos(std::clamp(axis.z(), -1.0, 1.0)));
      }
      result.warnings.push_back(
          "the scans look along axes that differ by " + degrees(turn) +
          " degrees at most, too little to fix the scale of the surface: turn "
          "the rig by 15 degrees or more, not about the optical axis");
    }
    if (data.boards != nullptr) {
      result.warnings.push_back(
          "the board is too square to the axis to fix the scale of the surface: "
          "tilt it by 20 degrees or more");
    }
    result.warnings.push_back(
        "the surface is known up to one scale only (rays (x, y, c h), c unknown): "
        "this lens is not metric");
  }

  double squares = 0.0;
  for (const Observation& o : data.observations) {
    if (o.weight < 1.0) continue;
    const double r = residualOf(o, estimate);
    squares += r * r;
    ++result.observations;
  }
  result.points = static_cast<int>(estimate.points.size());
  result.rms_px = std::sqrt(squares / std::max(1, result.observations));
  const double field = largestAngle(data.observations, estimate);
  if (auto lens = estimate.lens->withParameters(estimate.lens->parameters(), field)) {
    estimate.lens = lens;
  }
  for (const Pose& pose : estimate.T_scan) result.T_first_scan.push_back(pose.inverse());
  result.file.image_size = tracks.image_size;
  result.file.lens = estimate.lens;
  result.file.stage_axis = estimate.axis;
  result.file.calibration.rms_px = result.rms_px;
  result.file.calibration.points = result.points;
  if (known) {
    const double sigma = noise();
    result.file.covariance = sigma * sigma * lensCovariance(data, estimate, !joints.empty());
  }
  return result;
}

}  // namespace omnister
