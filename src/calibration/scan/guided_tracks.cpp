// SPDX-License-Identifier: Apache-2.0
#include "calibration/scan/guided_tracks.h"

#include <Eigen/Dense>
#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <opencv2/imgproc.hpp>

#include "calibration/scan/picture_mask.h"
#include "omnister/common/parallel.h"

namespace omnister::calibration {
namespace {

constexpr int kHalf = kGuidedHalf;
constexpr int kSide = 2 * kHalf + 1;
/// Standard deviation of the window's weights [px].
constexpr double kWindowSigma = 4.5;
/// Of the blur that makes grey values smooth enough to interpolate [px].
constexpr double kBlur = 0.8;
constexpr int kIterations = 12;
/// A window that has moved this far from where it was expected has found something else [px].
constexpr double kFarthestPx = 4.0;
/// Least weighted correlation of a window with its image.
constexpr double kLeastCorrelation = 0.85;
/// Expected slant: change of log range per radian across the line of sight.
constexpr double kSlantSigma = 2.0;
/// Distance from the black around the picture that the blur and the lens' own rim reach [px].
constexpr int kMaskMargin = 3;
/// Grey levels that image noise is not below.
constexpr double kGreyNoise = 1.0;

using Vector6 = Eigen::Matrix<double, 6, 1>;
using Matrix6 = Eigen::Matrix<double, 6, 6>;

/// Catmull and Rom's cubic through four neighbours, and its slope.
struct Cubic {
  explicit Cubic(double t) {
    const double t2 = t * t;
    const double t3 = t2 * t;
    value = {-0.5 * t3 + t2 - 0.5 * t, 1.5 * t3 - 2.5 * t2 + 1.0, -1.5 * t3 + 2.0 * t2 + 0.5 * t,
             0.5 * t3 - 0.5 * t2};
    slope = {-1.5 * t2 + 2.0 * t - 0.5, 4.5 * t2 - 5.0 * t, -4.5 * t2 + 4.0 * t + 0.5,
             1.5 * t2 - t};
  }
  std::array<double, 4> value, slope;
};

struct Sample {
  double value = 0.0;
  double dx = 0.0;
  double dy = 0.0;
};

/// @return false outside
bool sample(const cv::Mat1f& image, double x, double y, Sample& out) {
  const int x0 = static_cast<int>(std::floor(x));
  const int y0 = static_cast<int>(std::floor(y));
  if (x0 < 1 || y0 < 1 || x0 + 2 >= image.cols || y0 + 2 >= image.rows) return false;
  const Cubic cx(x - x0);
  const Cubic cy(y - y0);
  out = Sample();
  for (int j = 0; j < 4; ++j) {
    const float* row = image[y0 - 1 + j] + x0 - 1;
    double value = 0.0;
    double slope = 0.0;
    for (int i = 0; i < 4; ++i) {
      value += cx.value[i] * row[i];
      slope += cx.slope[i] * row[i];
    }
    out.value += cy.value[j] * value;
    out.dx += cy.value[j] * slope;
    out.dy += cy.slope[j] * value;
  }
  return true;
}

/// Quadratic map from window offsets to pixels through nine exact places: within a window the lens
/// is no more curved than that.
struct Warp {
  Eigen::Matrix<double, 2, 6> coefficients = Eigen::Matrix<double, 2, 6>::Zero();

  Eigen::Vector2d at(double x, double y) const {
    Vector6 basis;
    basis << 1.0, x, y, x * x, x * y, y * y;
    return coefficients * basis;
  }
};

const Eigen::Matrix<double, 6, 9>& quadraticFit() {
  static const Eigen::Matrix<double, 6, 9> fit = [] {
    Eigen::Matrix<double, 9, 6> A;
    for (int k = 0; k < 9; ++k) {
      const int column = k % 3 - 1, row = k / 3 - 1;
      const double x = kHalf * column, y = kHalf * row;
      A.row(k) << 1.0, x, y, x * x, x * y, y * y;
    }
    return Eigen::Matrix<double, 6, 9>((A.transpose() * A).ldlt().solve(A.transpose()));
  }();
  return fit;
}

struct Window {
  std::array<Eigen::Vector3d, 9> rays;  ///< of a 3 x 3 grid over the window; not normalised
  Eigen::Vector3d middle;               ///< ray [unit]
  double range = 0.0;                   ///< [m]
  Eigen::Matrix<double, 3, 2> across;   ///< unit vectors orthogonal to `middle`
};

/// @param slant change of log inverse range along Window::across
/// @param T_target_reference maps coordinates of the window's camera into the target's
std::optional<Warp> warpOf(const Window& window, const Eigen::Vector2d& slant,
                           const Pose& T_target_reference, const LensModel& lens) {
  // Points X of the plane: normal . X = 1.
  const Eigen::Vector3d normal = (window.middle + window.across * slant) / window.range;
  Eigen::Matrix<double, 9, 2> pixels;
  for (int k = 0; k < 9; ++k) {
    const double inverse = normal.dot(window.rays[k]);
    // Grazing or behind.
    if (inverse * window.range < 0.1) return std::nullopt;
    const auto pixel = lens.project(T_target_reference * Eigen::Vector3d(window.rays[k] / inverse));
    if (!pixel) return std::nullopt;
    pixels.row(k) = pixel->transpose();
  }
  Warp warp;
  warp.coefficients = (quadraticFit() * pixels).transpose();
  return warp;
}

struct Scan {
  std::vector<cv::Mat1f> images;    ///< blurred
  std::size_t middle = 0;           ///< index of the image in the middle of the travel
  std::vector<std::size_t> chosen;  ///< images that other scans' windows are looked for in
};

/// One image that a window is aligned with.
struct Target {
  int scan = 0;
  std::size_t image = 0;
  Pose T_target_reference;
  Warp warp;
  Eigen::Vector2d shift = Eigen::Vector2d::Zero();
  double correlation = 0.0;
  double step = 1e9;  ///< length of the last step [px]
  bool alive = true;
};

struct Normal {
  Eigen::Matrix4d local = Eigen::Matrix4d::Zero();  ///< shift, gain, offset
  Eigen::Matrix<double, 4, 2> mixed = Eigen::Matrix<double, 4, 2>::Zero();
  Eigen::Matrix2d slant = Eigen::Matrix2d::Zero();
  Eigen::Vector4d local_rhs = Eigen::Vector4d::Zero();
  Eigen::Vector2d slant_rhs = Eigen::Vector2d::Zero();
};

class Aligner {
 public:
  Aligner(const std::vector<Scan>& scans, const cv::Mat1b& outside, const FeatureTracks& tracks,
          const KnownScene& scene)
      : scans_(scans), outside_(outside), tracks_(tracks), scene_(scene) {
    double sum = 0.0;
    for (int y = -kHalf; y <= kHalf; ++y) {
      for (int x = -kHalf; x <= kHalf; ++x) {
        const double weight = std::exp(-0.5 * (x * x + y * y) / (kWindowSigma * kWindowSigma));
        weights_[(y + kHalf) * kSide + x + kHalf] = weight;
        sum += weight;
      }
    }
    for (double& weight : weights_) weight /= sum;
  }

  FeatureTrack measure(const FeatureTrack& track, const Eigen::Vector3d& point) const {
    FeatureTrack result;
    const int home = track.observations.front().scan;
    const Scan& scan = scans_[home];
    const Pose T_reference = cameraPose(home, scan.middle);
    const auto expected = scene_.lens->project(T_reference * point);
    if (!expected) return result;
    const int cx = static_cast<int>(std::lround(expected->x()));
    const int cy = static_cast<int>(std::lround(expected->y()));
    const cv::Mat1f& image = scan.images[scan.middle];
    const cv::Rect patch(cx - kHalf, cy - kHalf, kSide, kSide);
    if ((patch & cv::Rect(0, 0, image.cols, image.rows)) != patch) return result;
    if (cv::countNonZero(outside_(patch)) > 0) return result;

    Window window;
    for (int k = 0; k < 9; ++k) {
      const int column = k % 3 - 1, row = k / 3 - 1;
      const auto ray = scene_.lens->unproject({cx + kHalf * column, cy + kHalf * row});
      if (!ray) return result;
      window.rays[k] = *ray;
    }
    window.middle = window.rays[4];
    window.range = (T_reference * point).norm();
    window.across.col(0) = window.middle.unitOrthogonal();
    window.across.col(1) = window.middle.cross(window.across.col(0));

    std::array<double, kSide * kSide> grey;
    double mean = 0.0;
    for (int y = 0; y < kSide; ++y) {
      for (int x = 0; x < kSide; ++x) {
        grey[y * kSide + x] = image(cy - kHalf + y, cx - kHalf + x);
        mean += weights_[y * kSide + x] * grey[y * kSide + x];
      }
    }
    double contrast = 0.0;
    for (int k = 0; k < kSide * kSide; ++k) {
      grey[k] -= mean;
      contrast += weights_[k] * grey[k] * grey[k];
    }
    if (contrast < 4.0 * kGreyNoise * kGreyNoise) return result;

    std::vector<Target> targets = targetsOf(home, T_reference);
    Eigen::Vector2d slant = Eigen::Vector2d::Zero();
    for (int iteration = 0; iteration < kIterations; ++iteration) {
      // The slant follows once the places have settled a little.
      const bool free_slant = iteration >= 2;
      std::vector<Normal> normals(targets.size());
      Eigen::Matrix2d H = Eigen::Matrix2d::Zero();
      Eigen::Vector2d rhs = Eigen::Vector2d::Zero();
      for (std::size_t t = 0; t < targets.size(); ++t) {
        Target& target = targets[t];
        if (!target.alive) continue;
        target.alive = accumulate(window, slant, grey, contrast, target, normals[t]);
        if (!target.alive || !free_slant || target.correlation < kLeastCorrelation) continue;
        const Eigen::Matrix<double, 4, 2> solved = normals[t].local.ldlt().solve(normals[t].mixed);
        H += normals[t].slant - normals[t].mixed.transpose() * solved;
        rhs += normals[t].slant_rhs - solved.transpose() * normals[t].local_rhs;
      }
      Eigen::Vector2d slant_step = Eigen::Vector2d::Zero();
      if (free_slant) {
        const double prior = kGreyNoise * kGreyNoise / (kSlantSigma * kSlantSigma) /
                             (2.0 * M_PI * kWindowSigma * kWindowSigma);
        slant_step = (H + prior * Eigen::Matrix2d::Identity()).ldlt().solve(rhs - prior * slant);
        if (!slant_step.allFinite()) slant_step.setZero();
        const double longest = 0.5;
        if (slant_step.norm() > longest) slant_step *= longest / slant_step.norm();
      }
      bool settled = free_slant && slant_step.norm() < 1e-3;
      for (std::size_t t = 0; t < targets.size(); ++t) {
        Target& target = targets[t];
        if (!target.alive) continue;
        const Eigen::Vector4d step = normals[t].local.ldlt().solve(
            Eigen::Vector4d(normals[t].local_rhs - normals[t].mixed * slant_step));
        Eigen::Vector2d move = step.head<2>();
        if (!move.allFinite()) {
          target.alive = false;
          continue;
        }
        if (move.norm() > 1.5) move *= 1.5 / move.norm();
        target.shift += move;
        target.step = move.norm();
        target.alive = target.shift.norm() < kFarthestPx;
        if (target.alive && target.step > 2e-3) settled = false;
      }
      slant += slant_step;
      if (slant.norm() > 4.0) return result;
      if (settled) break;
    }

    result.observations.push_back({home, static_cast<int>(scan.middle), Eigen::Vector2d(cx, cy)});
    for (Target& target : targets) {
      Normal unused;
      if (!target.alive || target.step > 0.02 ||
          !accumulate(window, slant, grey, contrast, target, unused) ||
          target.correlation < kLeastCorrelation) {
        continue;
      }
      const Eigen::Vector2d pixel = exactMiddle(window, target) + target.shift;
      result.observations.push_back({target.scan, static_cast<int>(target.image), pixel});
    }
    if (result.observations.size() < 3) result.observations.clear();
    return result;
  }

 private:
  /// Scene to camera.
  Pose cameraPose(int scan, std::size_t image) const {
    Pose pose = scene_.T_scan[scan];
    pose.translation() -= tracks_.positions_m[scan][image] * scene_.axis;
    return pose;
  }

  std::vector<Target> targetsOf(int home, const Pose& T_reference) const {
    std::vector<Target> targets;
    const auto add = [&](std::size_t s, std::size_t image) {
      Target target;
      target.scan = static_cast<int>(s);
      target.image = image;
      target.T_target_reference = cameraPose(target.scan, image) * T_reference.inverse();
      targets.push_back(target);
    };
    for (std::size_t s = 0; s < scans_.size(); ++s) {
      if (static_cast<int>(s) == home) {
        for (std::size_t i = 0; i < scans_[s].images.size(); ++i) {
          if (i != scans_[s].middle) add(s, i);
        }
      } else if (scene_.joined[s] && scene_.joined[home]) {
        for (std::size_t i : scans_[s].chosen) add(s, i);
      }
    }
    return targets;
  }

  Eigen::Vector2d exactMiddle(const Window& window, const Target& target) const {
    const auto pixel = scene_.lens->project(target.T_target_reference *
                                            Eigen::Vector3d(window.range * window.middle));
    return pixel ? *pixel : target.warp.at(0.0, 0.0);
  }

  /// Normal equations of the grey values of one image; also its correlation with the window.
  /// @return false when the window does not lie in the image
  bool accumulate(const Window& window, const Eigen::Vector2d& slant,
                  const std::array<double, kSide * kSide>& grey, double contrast, Target& target,
                  Normal& normal) const {
    constexpr double kDelta = 0.05;
    const auto warp = warpOf(window, slant, target.T_target_reference, *scene_.lens);
    const auto warp_x =
        warpOf(window, slant + Eigen::Vector2d(kDelta, 0), target.T_target_reference, *scene_.lens);
    const auto warp_y =
        warpOf(window, slant + Eigen::Vector2d(0, kDelta), target.T_target_reference, *scene_.lens);
    if (!warp || !warp_x || !warp_y) return false;
    target.warp = *warp;
    const Scan& scan = scans_[target.scan];
    const cv::Mat1f& image = scan.images[target.image];
    std::array<Sample, kSide * kSide> samples;
    double mean = 0.0;
    for (int y = -kHalf; y <= kHalf; ++y) {
      for (int x = -kHalf; x <= kHalf; ++x) {
        const int k = (y + kHalf) * kSide + x + kHalf;
        const Eigen::Vector2d at = warp->at(x, y) + target.shift;
        if (!sample(image, at.x(), at.y(), samples[k])) return false;
        if (outside_(cvRound(at.y()), cvRound(at.x())) != 0) return false;
        mean += weights_[k] * samples[k].value;
      }
    }
    double variance = 0.0;
    double covariance = 0.0;
    for (int k = 0; k < kSide * kSide; ++k) {
      samples[k].value -= mean;
      variance += weights_[k] * samples[k].value * samples[k].value;
      covariance += weights_[k] * samples[k].value * grey[k];
    }
    if (!(variance > 0.0) || !(covariance > 0.0)) return false;
    target.correlation = covariance / std::sqrt(variance * contrast);
    // The window's grey values are predicted as gain x image + offset.
    const double gain = covariance / variance;
    const Eigen::Matrix<double, 2, 6> d_x = (warp_x->coefficients - warp->coefficients) / kDelta;
    const Eigen::Matrix<double, 2, 6> d_y = (warp_y->coefficients - warp->coefficients) / kDelta;
    Matrix6 H = Matrix6::Zero();
    Vector6 rhs = Vector6::Zero();
    for (int y = -kHalf; y <= kHalf; ++y) {
      for (int x = -kHalf; x <= kHalf; ++x) {
        const int k = (y + kHalf) * kSide + x + kHalf;
        const Sample& s = samples[k];
        Vector6 basis;
        basis << 1.0, x, y, x * x, x * y, y * y;
        const Eigen::RowVector2d gradient(gain * s.dx, gain * s.dy);
        Vector6 J;
        J << gradient.transpose(), s.value, 1.0, gradient * (d_x * basis), gradient * (d_y * basis);
        const double residual = grey[k] - gain * s.value;
        H += weights_[k] * J * J.transpose();
        rhs += weights_[k] * residual * J;
      }
    }
    normal.local = H.topLeftCorner<4, 4>();
    normal.mixed = H.topRightCorner<4, 2>();
    normal.slant = H.bottomRightCorner<2, 2>();
    normal.local_rhs = rhs.head<4>();
    normal.slant_rhs = rhs.tail<2>();
    return true;
  }

  const std::vector<Scan>& scans_;
  const cv::Mat1b& outside_;
  const FeatureTracks& tracks_;
  const KnownScene& scene_;
  std::array<double, kSide * kSide> weights_;
};

Scan prepare(const StageScan& scan) {
  Scan result;
  std::vector<std::size_t> order(scan.images.size());
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) {
    return scan.positions_m[a] < scan.positions_m[b];
  });
  result.middle = order[order.size() / 2];
  result.chosen = {order.front(), result.middle, order.back()};
  std::sort(result.chosen.begin(), result.chosen.end());
  result.chosen.erase(std::unique(result.chosen.begin(), result.chosen.end()), result.chosen.end());
  for (const cv::Mat& image : scan.images) {
    cv::Mat gray = image;
    if (image.channels() == 3) cv::cvtColor(image, gray, cv::COLOR_BGR2GRAY);
    cv::Mat1f smooth;
    gray.convertTo(smooth, CV_32F);
    cv::GaussianBlur(smooth, smooth, cv::Size(), kBlur);
    result.images.push_back(smooth);
  }
  return result;
}

}  // namespace

FeatureTracks measureGuided(const std::vector<StageScan>& scans, const FeatureTracks& tracks,
                            const KnownScene& scene, int threads) {
  std::vector<Scan> prepared(scans.size());
  parallelFor(0, scans.size(), threads, [&](std::size_t s) { prepared[s] = prepare(scans[s]); });
  const cv::Mat1b outside = outsidePicture(scans, kMaskMargin);
  const Aligner aligner(prepared, outside, tracks, scene);
  std::vector<FeatureTrack> measured(tracks.tracks.size());
  parallelFor(
      0, measured.size(), threads,
      [&](std::size_t t) {
        if (scene.points[t]) measured[t] = aligner.measure(tracks.tracks[t], *scene.points[t]);
      },
      16);
  FeatureTracks result;
  result.image_size = tracks.image_size;
  result.positions_m = tracks.positions_m;
  result.tracks = std::move(measured);
  return result;
}

}  // namespace omnister::calibration
