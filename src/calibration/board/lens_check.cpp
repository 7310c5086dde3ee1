// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/lens_check.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <limits>
#include <opencv2/features2d.hpp>
#include <optional>

#include "calibration/fit/board.h"
#include "calibration/fit/board_pose.h"
#include "calibration/fit/bundle.h"
#include "omnister/common/error.h"

namespace omnister {
namespace {

using namespace calibration;

constexpr float kRatio = 0.75f;
/// Features further than this from the epipolar curve are wrong matches, not drift [px].
constexpr double kGatePx = 15.0;
constexpr int kLeastMatches = 30;

/// A lens whose rays are (x, y, c h) about a shifted centre, where those of `base` are (x, y, h).
class CorrectedLens final : public LensModel {
 public:
  CorrectedLens(const LensModel& base, double scale, const Eigen::Vector2d& shift)
      : base_(base), scale_(scale), shift_(shift) {}

  std::string_view model() const override { return base_.model(); }
  std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& bearing, Jacobian23* d_bearing,
                                         JacobianParams* d_parameters) const override {
    const Eigen::Vector3d inner(bearing.x(), bearing.y(), bearing.z() / scale_);
    auto pixel = base_.project(inner, d_bearing, d_parameters);
    if (!pixel) return std::nullopt;
    if (d_bearing != nullptr) d_bearing->col(2) /= scale_;
    return *pixel + shift_;
  }
  std::optional<Eigen::Vector3d> unproject(const Eigen::Vector2d& pixel,
                                           Jacobian32* d_pixel) const override {
    auto ray = base_.unproject(pixel - shift_, d_pixel);
    if (!ray) return std::nullopt;
    const Eigen::DiagonalMatrix<double, 3> D(1.0, 1.0, scale_);
    const Eigen::Vector3d scaled = D * *ray;
    const double length = scaled.norm();
    const Eigen::Vector3d unit = scaled / length;
    if (d_pixel != nullptr) {
      *d_pixel = (Eigen::Matrix3d::Identity() - unit * unit.transpose()) * (D * *d_pixel) / length;
    }
    return unit;
  }
  double maxTheta() const override {
    const double theta = base_.maxTheta();
    return std::atan2(std::sin(theta), scale_ * std::cos(theta));
  }
  std::optional<double> surfaceHeight(double x, double y) const override {
    const auto height = base_.surfaceHeight(x, y);
    if (!height) return std::nullopt;
    return scale_ * *height;
  }
  Eigen::VectorXd parameters() const override { return base_.parameters(); }
  std::vector<std::string> parameterNames() const override { return base_.parameterNames(); }
  LensPtr withParameters(const Eigen::VectorXd&, std::optional<double>) const override {
    return nullptr;
  }

 private:
  const LensModel& base_;
  double scale_;
  Eigen::Vector2d shift_;
};

double medianOf(std::vector<double> values) {
  if (values.empty()) return std::numeric_limits<double>::quiet_NaN();
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// One usable view with its board pose; the pose follows every change of the lens.
struct PosedView {
  std::size_t view = 0;
  std::vector<Corner> corners;
  Pose pose;
};

/// All residuals through the lens after (scale, shift), every pose refitted.
Eigen::VectorXd residualsAfter(const LensModel& lens, double scale, const Eigen::Vector2d& shift,
                               const std::vector<PosedView>& views) {
  Eigen::Index size = 0;
  for (const PosedView& view : views) size += 2 * static_cast<Eigen::Index>(view.corners.size());
  Eigen::VectorXd out(size);
  const auto corrected = std::make_shared<CorrectedLens>(lens, scale, shift);
  Eigen::Index row = 0;
  for (const PosedView& view : views) {
    BundleView bundle;
    bundle.corners = &view.corners;
    BundleState state;
    state.lenses = {corrected};
    state.poses = {view.pose};
    refinePose({bundle}, 0.0, state);
    for (const Eigen::Vector2d& residual : residualsOf(bundle, state)) {
      out.segment<2>(row) = residual;
      row += 2;
    }
  }
  return out;
}

double rmsOf(const Eigen::VectorXd& residuals) {
  return std::sqrt(2.0 * residuals.squaredNorm() / std::max<Eigen::Index>(1, residuals.size()));
}

}  // namespace

BoardCheck checkBoards(const LensModel& lens, const Detections& boards) {
  BoardCheck result;
  std::vector<PosedView> posed;
  for (std::size_t v = 0; v < boards.views.size(); ++v) {
    const ViewDetections& view = boards.views[v];
    BoardCheck::View entry;
    entry.name = view.name;
    if (view.pixels.size() < 6) {
      entry.reason = view.pixels.empty() ? "no board found" : "fewer than 6 corners";
    } else if (const auto pose = boardPose(view, lens)) {
      PosedView use;
      use.view = v;
      use.pose = *pose;
      for (std::size_t i = 0; i < view.pixels.size(); ++i) {
        use.corners.push_back({view.pixels[i], view.points[i], Eigen::Vector2d::Zero()});
      }
      posed.push_back(std::move(use));
    } else {
      entry.reason = "outside the field of the lens, or its corners lie on one line";
    }
    result.views.push_back(std::move(entry));
  }
  if (posed.empty()) throw Error("no view shows a board inside the field of the lens");

  const Eigen::VectorXd now = residualsAfter(lens, 1.0, Eigen::Vector2d::Zero(), posed);
  std::vector<double> lengths;
  Eigen::Index row = 0;
  for (const PosedView& view : posed) {
    BoardCheck::View& entry = result.views[view.view];
    double sum = 0.0;
    for (std::size_t i = 0; i < view.corners.size(); ++i, row += 2) {
      entry.residuals.push_back(-now.segment<2>(row));
      lengths.push_back(now.segment<2>(row).norm());
      sum += lengths.back() * lengths.back();
    }
    entry.rms_px = std::sqrt(sum / static_cast<double>(view.corners.size()));
    result.corners += static_cast<int>(view.corners.size());
  }
  result.rms_px = rmsOf(now);
  result.median_px = medianOf(lengths);

  // Gauss and Newton on (log scale, shift); poses follow within residualsAfter().
  Eigen::Vector3d p = Eigen::Vector3d::Zero();
  Eigen::Matrix3d information = Eigen::Matrix3d::Identity();
  Eigen::VectorXd residuals = now;
  const auto at = [&](const Eigen::Vector3d& q) {
    return residualsAfter(lens, std::exp(q[0]), q.tail<2>(), posed);
  };
  const Eigen::Vector3d steps(1e-4, 0.02, 0.02);
  for (int iteration = 0; iteration < 4; ++iteration) {
    Eigen::MatrixXd J(residuals.size(), 3);
    for (int k = 0; k < 3; ++k) {
      Eigen::Vector3d high = p, low = p;
      high[k] += steps[k];
      low[k] -= steps[k];
      J.col(k) = (at(high) - at(low)) / (2.0 * steps[k]);
    }
    information = J.transpose() * J;
    const Eigen::Vector3d change = information.ldlt().solve(J.transpose() * residuals);
    if (!change.allFinite() || std::abs(change[0]) > 0.5) break;
    const Eigen::VectorXd next = at(p - change);
    if (!(next.squaredNorm() < residuals.squaredNorm())) break;
    p -= change;
    residuals = next;
    if (std::abs(change[0]) < 1e-7 && change.tail<2>().norm() < 1e-4) break;
  }
  result.scale = std::exp(p[0]);
  result.center_shift = p.tail<2>();
  result.corrected_rms_px = rmsOf(residuals);
  const double freedom =
      std::max(1.0, static_cast<double>(residuals.size()) - 6.0 * posed.size() - 3.0);
  const double variance = residuals.squaredNorm() / freedom;
  const Eigen::Matrix3d covariance = variance * information.inverse();
  result.scale_sigma = std::sqrt(std::max(0.0, covariance(0, 0)));
  result.center_sigma = covariance.diagonal().tail<2>().cwiseMax(0.0).cwiseSqrt();
  return result;
}

PairCheck checkPair(const LensModel& reference_lens, const cv::Mat& reference,
                    const LensModel& displaced_lens, const cv::Mat& displaced,
                    const Pose& T_ref_disp) {
  const Eigen::Vector3d t = T_ref_disp.translation();
  if (!(t.norm() > 0.0)) throw Error("the pose has no baseline, so no epipolar curves");
  const auto sift = cv::SIFT::create(6000);
  std::vector<cv::KeyPoint> keys[2];
  cv::Mat descriptors[2];
  sift->detectAndCompute(reference, cv::noArray(), keys[0], descriptors[0]);
  sift->detectAndCompute(displaced, cv::noArray(), keys[1], descriptors[1]);
  const auto best = [&](int from, int to) {
    std::vector<int> out(static_cast<std::size_t>(descriptors[from].rows), -1);
    if (descriptors[from].rows == 0 || descriptors[to].rows < 2) return out;
    std::vector<std::vector<cv::DMatch>> nearest;
    cv::BFMatcher(cv::NORM_L2).knnMatch(descriptors[from], descriptors[to], nearest, 2);
    for (std::size_t i = 0; i < nearest.size(); ++i) {
      if (nearest[i].size() == 2 && nearest[i][0].distance < kRatio * nearest[i][1].distance) {
        out[i] = nearest[i][0].trainIdx;
      }
    }
    return out;
  };
  const std::vector<int> forth = best(0, 1);
  const std::vector<int> back = best(1, 0);

  struct Rays {
    Eigen::Vector3d reference, displaced;
    double px_per_rad = 0.0;
  };
  PairCheck result;
  std::vector<Rays> rays;
  for (std::size_t i = 0; i < forth.size(); ++i) {
    if (forth[i] < 0 || back[static_cast<std::size_t>(forth[i])] != static_cast<int>(i)) continue;
    const cv::Point2f a = keys[0][i].pt;
    const cv::Point2f b = keys[1][static_cast<std::size_t>(forth[i])].pt;
    const auto ray_a = reference_lens.unproject({a.x, a.y});
    Jacobian32 d;
    const auto ray_b = displaced_lens.unproject({b.x, b.y}, &d);
    if (!ray_a || !ray_b) continue;
    // Along the baseline every pixel is on the curve.
    if (ray_a->cross(t.normalized()).norm() < 0.05) continue;
    result.matches.push_back({{a.x, a.y}, {b.x, b.y}, 0.0, false});
    const double rad_per_px = std::sqrt(0.5) * d.norm();
    rays.push_back({*ray_a, *ray_b, 1.0 / std::max(rad_per_px, 1e-9)});
  }
  const auto residualAt = [&](std::size_t i, const Eigen::Vector3d& turn) {
    const double angle = turn.norm();
    const Eigen::Matrix3d extra = angle > 0.0
                                      ? Eigen::AngleAxisd(angle, turn / angle).toRotationMatrix()
                                      : Eigen::Matrix3d(Eigen::Matrix3d::Identity());
    const Eigen::Vector3d b = T_ref_disp.linear() * (extra * rays[i].displaced);
    return std::asin(std::clamp(t.cross(rays[i].reference).normalized().dot(b), -1.0, 1.0)) *
           rays[i].px_per_rad;
  };
  std::vector<double> sizes;
  for (std::size_t i = 0; i < rays.size(); ++i) {
    PairCheck::Match& match = result.matches[i];
    match.residual_px = residualAt(i, Eigen::Vector3d::Zero());
    // The two rays meet before both cameras.
    const Eigen::Vector3d b = T_ref_disp.linear() * rays[i].displaced;
    const Eigen::Vector3d n = rays[i].reference.cross(b);
    const bool meet = t.cross(b).dot(n) > 0.0 && t.cross(rays[i].reference).dot(n) > 0.0;
    const bool far = n.norm() < 2.0 / rays[i].px_per_rad;
    match.inlier = std::abs(match.residual_px) < kGatePx && (meet || far);
    if (!match.inlier) continue;
    ++result.inliers;
    sizes.push_back(std::abs(match.residual_px));
    result.rms_px += match.residual_px * match.residual_px;
  }
  if (result.inliers < kLeastMatches) {
    throw Error("only " + std::to_string(result.inliers) + " of " +
                std::to_string(result.matches.size()) +
                " matched features lie near their epipolar curves, expected 30 or more: is the "
                "pose that of these images, the right way round, and is there texture?");
  }
  result.median_px = medianOf(sizes);
  result.rms_px = std::sqrt(result.rms_px / result.inliers);

  Eigen::Matrix3d information = Eigen::Matrix3d::Identity();
  double scale_px = std::max(0.1, 1.5 * result.median_px);
  double squares = 0.0;
  for (int iteration = 0; iteration < 15; ++iteration) {
    information.setZero();
    Eigen::Vector3d rhs = Eigen::Vector3d::Zero();
    squares = 0.0;
    std::vector<double> now;
    for (std::size_t i = 0; i < rays.size(); ++i) {
      if (!result.matches[i].inlier) continue;
      const double r = residualAt(i, result.turn);
      now.push_back(std::abs(r));
      Eigen::Vector3d J;
      for (int k = 0; k < 3; ++k) {
        Eigen::Vector3d high = result.turn;
        high[k] += 1e-5;
        J[k] = (residualAt(i, high) - r) / 1e-5;
      }
      const double weight = 1.0 / (1.0 + r * r / (scale_px * scale_px));
      information += weight * J * J.transpose();
      rhs += weight * r * J;
      squares += weight * r * r;
    }
    scale_px = std::max(0.1, 1.5 * medianOf(now));
    const Eigen::Vector3d change = information.ldlt().solve(rhs);
    if (!change.allFinite()) break;
    result.turn -= change;
    if (change.norm() < 1e-8) break;
  }
  const double variance = squares / std::max(1, result.inliers - 3);
  result.turn_sigma = (variance * information.inverse()).diagonal().cwiseMax(0.0).cwiseSqrt();
  std::vector<double> corrected;
  for (std::size_t i = 0; i < rays.size(); ++i) {
    if (result.matches[i].inlier) corrected.push_back(std::abs(residualAt(i, result.turn)));
  }
  result.corrected_median_px = medianOf(corrected);
  return result;
}

}  // namespace omnister
