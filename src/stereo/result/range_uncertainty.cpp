// SPDX-License-Identifier: Apache-2.0
#include "stereo/result/range_uncertainty.h"

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "omnister/stereo/epipolar.h"
#include "omnister/stereo/matching_limits.h"

namespace omnister {
namespace {

constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
constexpr double kLeastSine = 1e-5;  ///< nearer to the baseline there is no range to speak of
constexpr double kMostSigma = 1e6;   ///< of an inverse range [1/m], so that nothing is infinite

Eigen::Matrix3d cross(const Eigen::Vector3d& v) {
  Eigen::Matrix3d m;
  m << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
  return m;
}

/// A lens whose parameters are known to a covariance.
struct UncertainLens {
  LensPtr lens;
  Eigen::MatrixXd covariance;
  Eigen::MatrixXd rotation;  ///< 3xN: that answers a change of parameters best; empty: none does

  /// d(ray of a fixed pixel) / d(parameters), 3xN; empty where there is no ray.
  Eigen::MatrixXd rayChange(const Eigen::Vector3d& ray) const {
    JacobianParams d_parameters;
    Jacobian32 d_pixel;
    const auto pixel = lens->project(ray, nullptr, &d_parameters);
    if (!pixel || !lens->unproject(*pixel, &d_pixel)) return {};
    Eigen::MatrixXd change = -d_pixel * d_parameters;
    if (rotation.size() > 0) change -= cross(ray) * rotation;
    return change;
  }

  void takeRotationOut(cv::Size size) {
    constexpr int kColumns = 16, kRows = 12;
    const Eigen::Index count = covariance.rows();
    Eigen::Matrix3d normal = 1e-9 * Eigen::Matrix3d::Identity();
    Eigen::MatrixXd mixed = Eigen::MatrixXd::Zero(3, count);
    for (int j = 0; j < kRows; ++j) {
      for (int i = 0; i < kColumns; ++i) {
        const auto ray = lens->unproject(
            {(i + 0.5) * size.width / kColumns - 0.5, (j + 0.5) * size.height / kRows - 0.5});
        const Eigen::MatrixXd change = ray ? rayChange(*ray) : Eigen::MatrixXd();
        if (change.size() == 0) continue;
        normal += cross(*ray).transpose() * cross(*ray);
        mixed += cross(*ray).transpose() * change;
      }
    }
    rotation = normal.ldlt().solve(mixed);
  }
};

UncertainLens makeLensOf(const LensPtr& lens, const Eigen::MatrixXd& covariance,
                         const char* whose) {
  const Eigen::Index count = lens->parameters().size();
  if (covariance.rows() != count || covariance.cols() != count || !covariance.allFinite()) {
    throw Error(std::string("covariance of the ") + whose + " lens is " +
                std::to_string(covariance.rows()) + "x" + std::to_string(covariance.cols()) +
                ", expected finite numbers for its " + std::to_string(count) + " parameters");
  }
  return {lens, covariance, {}};
}

/// What one displaced camera makes of errors: d(inverse range) by everything that is uncertain.
struct Slopes {
  Eigen::RowVectorXd reference, displaced;
  Eigen::Matrix<double, 1, 6> pose = Eigen::Matrix<double, 1, 6>::Zero();
  double information = 0.0;  ///< (pixels by inverse range)^2; 0 where nothing is seen
};

/// The cameras of a geometry with what is uncertain of them.
class Cameras {
 public:
  explicit Cameras(const StereoGeometry& geometry) : geometry_(geometry) {
    const auto& displaced = geometry.displaced;
    shared_ = std::all_of(displaced.begin(), displaced.end(), [&](const auto& camera) {
      return camera.lens == geometry.reference_lens;
    });
    lenses_.resize(displaced.size() + 1);
    for (std::size_t i = 0; i < lenses_.size(); ++i) {
      const bool reference = i == 0;
      const LensPtr& lens = reference ? geometry.reference_lens : displaced[i - 1].lens;
      const Eigen::MatrixXd& covariance =
          reference ? geometry.reference_covariance : displaced[i - 1].covariance;
      if (covariance.size() == 0 || (!reference && lens == geometry.reference_lens)) continue;
      lenses_[i] = makeLensOf(lens, covariance, reference ? "reference" : "displaced");
      if (!shared_)
        lenses_[i].takeRotationOut(reference ? geometry.reference_size : displaced[i - 1].size);
    }
    for (const auto& camera : displaced) {
      if (camera.pose_covariance.size() != 0 &&
          (camera.pose_covariance.rows() != 6 || camera.pose_covariance.cols() != 6 ||
           !camera.pose_covariance.allFinite()))
        throw Error("covariance of a pose is not 6x6 finite numbers");
    }
  }

  /// Standard deviation of inverse range w of a pixel; NaN where no camera sees it.
  double sigma(const Eigen::Vector2d& pixel, double w) const {
    const auto ray = geometry_.reference_lens->unproject(pixel);
    if (!ray) return kNone;
    std::vector<Slopes> all(geometry_.displaced.size());
    double information = 0.0;
    for (std::size_t i = 0; i < all.size(); ++i) {
      all[i] = slopesOf(i, *ray, w);
      information += all[i].information;
    }
    if (!(information > 0.0)) return kNone;
    double variance = 0.0;
    Eigen::RowVectorXd reference;
    for (std::size_t i = 0; i < all.size(); ++i) {
      const Slopes& slopes = all[i];
      if (!(slopes.information > 0.0)) continue;
      const double share = slopes.information / information;
      const auto add = [&](const Eigen::RowVectorXd& by, Eigen::RowVectorXd* sum) {
        if (by.size() == 0) return;
        if (sum->size() == 0)
          *sum = share * by;
        else
          *sum += share * by;
      };
      add(slopes.reference, &reference);
      const UncertainLens& lens = lenses_[i + 1];
      if (slopes.displaced.size() > 0 && !lens.lens) add(slopes.displaced, &reference);
      if (slopes.displaced.size() > 0 && lens.lens)
        variance += share * share * slopes.displaced.dot(slopes.displaced * lens.covariance);
      const Eigen::MatrixXd& pose = geometry_.displaced[i].pose_covariance;
      if (pose.size() > 0) variance += share * share * slopes.pose.dot(slopes.pose * pose);
    }
    if (reference.size() > 0) variance += reference.dot(reference * lenses_[0].covariance);
    return std::min(std::sqrt(std::max(variance, 0.0)), kMostSigma);
  }

 private:
  Slopes slopesOf(std::size_t i, const Eigen::Vector3d& ray, double w) const {
    Slopes slopes;
    const StereoGeometry::Displaced& camera = geometry_.displaced[i];
    const Eigen::Vector3d t = camera.T_ref_disp.translation();
    const Eigen::Matrix3d R = camera.T_ref_disp.linear();
    const double b = t.norm();
    const Eigen::Vector3d e = t / b;
    const EpipolarCurve curve(ray, camera.T_ref_disp, *camera.lens);
    const Eigen::Vector3d seen = curve.bearing(w).normalized();
    const auto here = curve.pixel(w);
    const auto next = curve.pixel(w + 1e-4 / b);
    if (!here || !next) return slopes;
    const Eigen::Vector3d other = R * seen;
    const double sine = std::max(ray.cross(e).norm(), kLeastSine);
    const double sine_other = std::max(other.cross(e).norm(), kLeastSine);
    const double delta = curve.parallax(w);
    // d(w) = -w^2 d(range); w = sin(delta) / (b sin(theta')).
    const double scale = 1.0 / (b * sine_other * sine_other);
    const double by_theta = -scale * sine_other * std::cos(delta);
    const double by_other = scale * sine;
    // cos(theta) = ray . e, so d(theta) = -(e . d(ray) + ray . d(e)) / sin(theta).
    const Eigen::RowVector3d by_ray = -by_theta / sine * e.transpose();
    const Eigen::RowVector3d by_seen = -by_other / sine_other * e.transpose() * R;
    const bool own = lenses_[i + 1].lens != nullptr;
    if (lenses_[0].lens) {
      const Eigen::MatrixXd change = lenses_[0].rayChange(ray);
      if (change.size() == 0) return slopes;
      slopes.reference = by_ray * change;
    }
    if (own || (lenses_[0].lens && camera.lens == geometry_.reference_lens)) {
      const Eigen::MatrixXd change = lenses_[own ? i + 1 : 0].rayChange(seen);
      if (change.size() == 0) return slopes;
      slopes.displaced = by_seen * change;
    }
    if (camera.pose_covariance.size() > 0) {
      const Eigen::Matrix3d across = (Eigen::Matrix3d::Identity() - e * e.transpose()) / b;
      const Eigen::RowVector3d by_e =
          -by_theta / sine * ray.transpose() - by_other / sine_other * other.transpose();
      slopes.pose.head<3>() = by_e * across - w / b * e.transpose();
      // A small rotation turns the other ray: d(other) = rotation x other.
      slopes.pose.tail<3>() = by_other / sine_other * e.transpose() * cross(other);
    }
    const double speed = (*next - *here).norm() / (1e-4 / b);
    slopes.information = std::max(speed * speed, 1e-12);
    return slopes;
  }

  StereoGeometry geometry_;
  bool shared_ = true;                 ///< one lens for all
  std::vector<UncertainLens> lenses_;  ///< the reference, then each displaced one with its own
};

}  // namespace

bool hasCovariance(const StereoGeometry& geometry) {
  return geometry.reference_covariance.size() > 0 ||
         std::any_of(geometry.displaced.begin(), geometry.displaced.end(), [](const auto& camera) {
           return camera.covariance.size() > 0 || camera.pose_covariance.size() > 0;
         });
}

RangeUncertainty::RangeUncertainty(const StereoGeometry& geometry, double min_range, int threads)
    : size_(geometry.reference_size),
      nodes_((size_.width - 1) / kStep + 2, (size_.height - 1) / kStep + 2),
      most_(1.0 / min_range),
      threads_(threads) {
  if (!(min_range > 0.0) || !std::isfinite(min_range))
    throw Error("least range of an uncertainty is not positive");
  const Cameras cameras(geometry);
  const std::size_t row_length = static_cast<std::size_t>(nodes_.width) * kLevels;
  std::vector<double> known(row_length * nodes_.height, kNone);
  parallelFor(0, static_cast<std::size_t>(nodes_.height), threads, [&](std::size_t j) {
    for (int i = 0; i < nodes_.width; ++i) {
      // The last nodes lie at the edge of the image.
      const Eigen::Vector2d pixel(std::min(i * kStep, size_.width - 1),
                                  std::min(static_cast<int>(j) * kStep, size_.height - 1));
      for (int k = 0; k < kLevels; ++k)
        known[j * row_length + i * kLevels + k] = cameras.sigma(pixel, most_ * k / (kLevels - 1));
    }
  });
  // Where nothing is seen, what the neighbours say, ring by ring: pixels between nodes at the edge
  // of a field are inside it.
  std::size_t missing = std::count_if(known.begin(), known.end(), [](double x) { return x != x; });
  if (missing == known.size()) std::fill(known.begin(), known.end(), 0.0), missing = 0;
  while (missing > 0) {
    std::vector<double> filled = known;
    for (int j = 0; j < nodes_.height; ++j) {
      for (int i = 0; i < nodes_.width; ++i) {
        for (int k = 0; k < kLevels; ++k) {
          const std::size_t at = j * row_length + i * kLevels + k;
          if (known[at] == known[at]) continue;
          double sum = 0.0;
          int count = 0;
          const auto take = [&](int x, int y, int level) {
            if (x < 0 || y < 0 || level < 0 || x >= nodes_.width || y >= nodes_.height ||
                level >= kLevels)
              return;
            const double value = known[y * row_length + x * kLevels + level];
            if (value != value) return;
            sum += value;
            ++count;
          };
          for (const auto& [x, y] : {std::pair(-1, 0), std::pair(1, 0), std::pair(0, -1),
                                     std::pair(0, 1), std::pair(0, 0)}) {
            take(i + x, j + y, k);
            if (x == 0 && y == 0) {
              take(i, j, k - 1);
              take(i, j, k + 1);
            }
          }
          if (count == 0) continue;
          filled[at] = sum / count;
          --missing;
        }
      }
    }
    known = std::move(filled);
  }
  table_.assign(known.begin(), known.end());
}

double RangeUncertainty::sigma(double u, double v, double range) const {
  const double x = std::clamp(u, 0.0, size_.width - 1.0) / kStep;
  const double y = std::clamp(v, 0.0, size_.height - 1.0) / kStep;
  const double z = std::min(1.0 / (range * most_), 1.0) * (kLevels - 1);
  const int i = std::min(static_cast<int>(x), nodes_.width - 2);
  const int j = std::min(static_cast<int>(y), nodes_.height - 2);
  const int k = std::min(static_cast<int>(z), kLevels - 2);
  double sum = 0.0;
  for (int corner = 0; corner < 8; ++corner) {
    const int a = corner & 1, b = corner >> 1 & 1, c = corner >> 2;
    const double weight =
        (a ? x - i : 1 - x + i) * (b ? y - j : 1 - y + j) * (c ? z - k : 1 - z + k);
    const std::size_t at = static_cast<std::size_t>(j + b) * nodes_.width + i + a;
    sum += weight * table_[at * kLevels + k + c];
  }
  return range * range * sum;
}

void RangeUncertainty::addTo(MatchResult* match) const {
  const std::size_t row_length = static_cast<std::size_t>(nodes_.width) * kLevels;
  parallelFor(
      0, static_cast<std::size_t>(size_.height), threads_,
      [&](std::size_t v) {
        const float y = static_cast<float>(v) / kStep;
        const int j = std::min(static_cast<int>(y), nodes_.height - 2);
        const float below = y - static_cast<float>(j);
        std::vector<float> line(row_length);
        for (std::size_t n = 0; n < row_length; ++n) {
          const float* node = &table_[j * row_length + n];
          line[n] = node[0] + below * (node[row_length] - node[0]);
        }
        const float* range = match->range.ptr<float>(static_cast<int>(v));
        float* sigma = match->sigma.ptr<float>(static_cast<int>(v));
        const float to_level = static_cast<float>((kLevels - 1) / most_);
        for (int u = 0; u < size_.width; ++u) {
          const float r = range[u];
          if (r != r) continue;
          const float z = std::min(to_level / r, static_cast<float>(kLevels - 1));
          const int k = std::min(static_cast<int>(z), kLevels - 2);
          const int i = std::min(u / kStep, nodes_.width - 2);
          const float across = static_cast<float>(u - i * kStep) / kStep;
          const float* left = &line[static_cast<std::size_t>(i) * kLevels + k];
          const float deep = z - static_cast<float>(k);
          const float here = left[0] + deep * (left[1] - left[0]);
          const float next = left[kLevels] + deep * (left[kLevels + 1] - left[kLevels]);
          const float own = r * r * (here + across * (next - here));
          sigma[u] = std::sqrt(sigma[u] * sigma[u] + own * own);
        }
      },
      8);
}

namespace {

class CalibratedMatcher : public Matcher {
 public:
  CalibratedMatcher(std::unique_ptr<Matcher> matcher, RangeUncertainty uncertainty)
      : matcher_(std::move(matcher)), uncertainty_(std::move(uncertainty)) {}

  MatchResult match(const cv::Mat& reference, const std::vector<cv::Mat>& displaced) override {
    MatchResult result = matcher_->match(reference, displaced);
    uncertainty_.addTo(&result);
    return result;
  }
  bool setPrior(const cv::Mat& prior) override { return matcher_->setPrior(prior); }

 private:
  std::unique_ptr<Matcher> matcher_;
  RangeUncertainty uncertainty_;
};

}  // namespace

std::unique_ptr<Matcher> withCalibrationSigma(std::unique_ptr<Matcher> matcher,
                                              const StereoGeometry& geometry,
                                              const MatcherOptions& options) {
  if (!hasCovariance(geometry)) return matcher;
  const double min_range = checkMatching(geometry, options).min_range;
  return std::make_unique<CalibratedMatcher>(
      std::move(matcher), RangeUncertainty(geometry, min_range, options.threads));
}

}  // namespace omnister
