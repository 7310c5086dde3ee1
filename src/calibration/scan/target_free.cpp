// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/target_free.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <string>

#include "calibration/fit/board_pose.h"
#include "calibration/fit/bundle.h"
#include "calibration/scan/guided_tracks.h"
#include "calibration/scan/scan_adjustment.h"
#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "omnister/lens/lens_fit.h"

namespace omnister {
namespace {

using namespace calibration;

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

double median(std::vector<double> values) {
  if (values.empty()) return std::numeric_limits<double>::quiet_NaN();
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// Nearest point to the rays of a track in its scan's frame; nothing without parallax or behind.
std::optional<Eigen::Vector3d> triangulateTrack(const std::vector<const ScanObservation*>& track,
                                                const LensModel& lens,
                                                const Eigen::Vector3d& axis) {
  Eigen::Matrix3d M = Eigen::Matrix3d::Zero();
  Eigen::Vector3d rhs = Eigen::Vector3d::Zero();
  std::vector<Eigen::Vector3d> rays;
  for (const ScanObservation* o : track) {
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
  for (const ScanObservation* o : track) {
    if (!lens.unproject(o->pixel)) continue;
    if ((point - o->travel * axis).dot(rays[k++]) <= 0.0) return std::nullopt;
  }
  return point;
}

/// Direction of travel from the planes that each track's rays span (all contain the axis).
Eigen::Vector3d findAxis(const std::vector<std::vector<const ScanObservation*>>& tracks,
                         const LensModel& lens) {
  std::vector<Eigen::Vector3d> normals;
  for (const auto& track : tracks) {
    if (track.size() < 2) continue;
    const auto [low, high] = std::minmax_element(
        track.begin(), track.end(),
        [](const ScanObservation* a, const ScanObservation* b) { return a->travel < b->travel; });
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
double noiseOf(const std::vector<ScanObservation>& observations, const ScanEstimate& estimate) {
  std::vector<double> residuals;
  for (const ScanObservation& o : observations) {
    if (o.weight == 1.0) residuals.push_back(residualOf(o, estimate));
  }
  // The median of a 2-D error of standard deviation sigma an axis is 1.177 sigma.
  return median(std::move(residuals)) / 1.177;
}

/// Drops observations whose residual stands out, then points with fewer than `least` of them or
/// without parallax; renumbers the points.
void prune(std::vector<ScanObservation>& observations, ScanEstimate& estimate,
           double least_limit_px, std::vector<int>* point_of = nullptr) {
  const double limit = std::max(least_limit_px, 4.0 * noiseOf(observations, estimate));
  std::vector<ScanObservation> kept;
  for (const ScanObservation& o : observations) {
    if (residualOf(o, estimate) <= (o.weight < 1.0 ? kMatchLimitPx : limit)) kept.push_back(o);
  }
  std::vector<int> count(estimate.points.size(), 0);
  std::vector<Eigen::Vector3d> first(estimate.points.size());
  std::vector<double> parallax(estimate.points.size(), 0.0);
  for (const ScanObservation& o : kept) {
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
  for (ScanObservation o : kept) {
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

double largestAngle(const std::vector<ScanObservation>& observations,
                    const ScanEstimate& estimate) {
  double largest = 0.0;
  for (const ScanObservation& o : observations) {
    const Eigen::Vector3d X = inCamera(o, estimate);
    largest = std::max(largest, std::atan2(X.head<2>().norm(), X.z()));
  }
  return largest;
}

/// The reconstruction in which rays (x, y, h) become (x, y, c h): an equal of the first where every
/// scan stands alone.
std::optional<ScanEstimate> scaled(const ScanEstimate& estimate, double c) {
  ScanEstimate result = estimate;
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
  const ScanObservation* seen = nullptr;  ///< of `to`, in its own scan
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

AffineFit findAffine(const std::vector<PointMatch>& matches, const ScanEstimate& estimate) {
  constexpr double kInlierPx = 4.0;
  AffineFit best;
  if (matches.size() < static_cast<std::size_t>(kLeastShared)) return best;
  const auto inliersOf = [&](const AffineFit& fit) {
    std::vector<std::size_t> inliers;
    if (!fit.A.allFinite() || !fit.t.allFinite()) return inliers;
    for (std::size_t i = 0; i < matches.size(); ++i) {
      const ScanObservation& o = *matches[i].seen;
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

/// The scale c for which the boards are seen best, each with a pose of its own.
double scaleFromBoards(const Detections& boards, const ScanEstimate& estimate, int threads) {
  const int steps = 41;
  std::vector<double> costs(steps, std::numeric_limits<double>::infinity());
  const auto scaleAt = [](int i) { return std::exp(-1.0 + 2.0 * i / (steps - 1)); };
  parallelFor(0, steps, threads, [&](std::size_t i) {
    const LensPtr lens = scaleSurface(*estimate.lens, scaleAt(static_cast<int>(i)));
    if (!lens) return;
    double cost = 0.0;
    for (const ViewDetections& view : boards.views) {
      const auto pose = boardPose(view, *lens);
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

double scaleFromAngle(const KnownAngle& known, const ScanEstimate& estimate) {
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

/// A scene that has been put together, before its last adjustment.
struct Reconstruction {
  ScanData data;
  ScanEstimate estimate;
  std::vector<int> point_of;  ///< [track] index of its point; -1 where it was dropped
  std::vector<bool> joined;   ///< [scan]
  std::vector<std::string> warnings;

  bool severalScans() const { return std::count(joined.begin(), joined.end(), true) > 1; }
};

void adjustOrThrow(Reconstruction& scene, double loss_px, bool scans, int threads) {
  AdjustOptions options;
  options.threads = threads;
  options.loss_px = loss_px;
  options.scans = scans;
  if (!adjust(scene.data, options, scene.estimate)) {
    throw Error("the adjustment of lens, axis and scene did not converge");
  }
}

/// Reaches out to the farthest observation and some pixels beyond.
void fitField(Reconstruction& scene, double margin_px) {
  const LensModel& lens = *scene.estimate.lens;
  double field = largestAngle(scene.data.observations, scene.estimate);
  // The slope out there, not that on the axis: it may be half of it.
  const auto radius = [&](double theta) {
    const auto pixel =
        projectContinued(lens, Eigen::Vector3d(std::sin(theta), 0.0, std::cos(theta)));
    return pixel ? (*pixel - lens.center()).norm() : 0.0;
  };
  const double slope = (radius(field) - radius(field - 0.02)) / 0.02;
  if (slope > 0.0) field += std::min(margin_px / slope, 0.2);
  field = std::min(field, M_PI - 0.05);
  if (auto fitted = lens.withParameters(lens.parameters(), field)) scene.estimate.lens = fitted;
}

/// Where residuals stop counting in full [px]: a few times the noise.
double lossOf(const Reconstruction& scene) {
  return std::clamp(4.0 * noiseOf(scene.data.observations, scene.estimate), 0.08, 0.5);
}

/// A part of the points with all their observations.
Reconstruction sampled(const Reconstruction& scene, std::size_t points) {
  const std::size_t stride = std::max<std::size_t>(1, scene.estimate.points.size() / points);
  Reconstruction result = scene;
  result.data.observations.clear();
  result.estimate.points.clear();
  for (std::size_t p = 0; p < scene.estimate.points.size(); p += stride) {
    result.estimate.points.push_back(scene.estimate.points[p]);
  }
  for (ScanObservation o : scene.data.observations) {
    if (o.point % stride != 0) continue;
    o.point /= static_cast<int>(stride);
    result.data.observations.push_back(o);
  }
  result.point_of.clear();
  return result;
}

/// Gives the lens what the observations ask for beyond its structure: a further even term or a
/// radial spline, and, where scans from several directions make them observable, affinity and
/// decentring. Taken is what lowers the robust sum of squares by far more than chance would.
void growStructure(Reconstruction& scene, bool scale_known, int threads) {
  Reconstruction part = sampled(scene, 700);
  const double sigma = noiseOf(part.data.observations, part.estimate);
  const double loss = lossOf(part);
  const auto chiSquared = [&](Reconstruction& trial) -> std::optional<double> {
    AdjustOptions options;
    options.threads = threads;
    options.loss_px = loss;
    options.scans = true;
    const auto cost = adjust(trial.data, options, trial.estimate);
    if (!cost) return std::nullopt;
    return 2.0 * *cost * static_cast<double>(trial.data.observations.size()) / (sigma * sigma);
  };
  auto least = chiSquared(part);
  if (!least) return;
  const double observations = static_cast<double>(part.data.observations.size());
  for (;;) {
    const LensStructure now = structureOf(*part.estimate.lens);
    std::vector<LensStructure> candidates;
    if (now.model == "asphere" && now.even_terms < 3) {
      candidates.push_back(now);
      ++candidates.back().even_terms;
    } else if (now.model == "asphere" && scale_known) {
      // Some lenses turn up at the rim as no compact surface does. One scan alone is too weak to
      // tell that from a stage that is not quite straight.
      candidates.push_back(now);
      candidates.back().model = "spline";
      candidates.back().even_terms = 0;
      candidates.back().knots = 12;
    }
    if (scale_known && part.severalScans()) {
      if (!now.affinity) {
        candidates.push_back(now);
        candidates.back().affinity = true;
      }
      if (now.model != "conic" && !now.decentring) {
        candidates.push_back(now);
        candidates.back().decentring = true;
      }
    }
    std::optional<Reconstruction> best;
    double best_value = *least;
    for (const LensStructure& candidate : candidates) {
      Reconstruction trial = part;
      try {
        trial.estimate.lens = refit(*part.estimate.lens, candidate);
      } catch (const Error&) {
        continue;
      }
      const auto value = chiSquared(trial);
      const double further = static_cast<double>(trial.estimate.lens->parameters().size() -
                                                 part.estimate.lens->parameters().size());
      // Four times Schwarz' criterion: errors of one feature are alike in several images.
      if (!value || *least - *value < 4.0 * further * std::log(observations)) continue;
      if (*value < best_value) {
        best_value = *value;
        best = std::move(trial);
      }
    }
    if (!best) break;
    part = std::move(*best);
    least = best_value;
  }
  scene.estimate.lens = part.estimate.lens;
  scene.estimate.axis = part.estimate.axis;
  scene.estimate.T_scan = part.estimate.T_scan;
  scene.estimate.T_camera_board = part.estimate.T_camera_board;
}

/// The last adjustments: with the scale of the surface free if anything fixes it, held otherwise.
/// @param settled the scene comes from an adjustment like this one
TargetFreeResult conclude(Reconstruction& scene, const FeatureTracks& tracks,
                          const TargetFreeOptions& options, bool settled) {
  const int threads = threadCount(options.threads);
  const std::string stage = settled ? "adjusting again" : "adjusting";
  ScanData& data = scene.data;
  ScanEstimate& estimate = scene.estimate;
  const bool several = scene.severalScans();
  data.pinned_slope = axisSlope(*estimate.lens);
  data.known_angle = options.known_angle;
  estimate.T_camera_board.clear();
  if (!options.boards.views.empty()) {
    data.boards = &options.boards;
    for (const ViewDetections& view : options.boards.views) {
      const auto pose = boardPose(view, *estimate.lens);
      if (!pose) {
        throw InputError(view.name, "", "the board lies outside the field that the features cover");
      }
      estimate.T_camera_board.push_back(*pose);
    }
  }
  report(options, 0.6, stage);
  const bool other_information = several || data.known_angle || data.boards != nullptr;
  // First with the scale held, so that poses and points settle; then free, if anything may fix it.
  if (!settled && (several || data.boards != nullptr)) {
    if (!data.known_angle) adjustOrThrow(scene, 3.0, true, threads);
    prune(data.observations, estimate, 2.0, &scene.point_of);
  }
  if (settled) {
    adjustOrThrow(scene, 0.5, true, threads);
    prune(data.observations, estimate, 0.5, &scene.point_of);
    if (estimate.points.size() < 50) {
      throw Error("only " + std::to_string(estimate.points.size()) +
                  " features could be measured again, expected 50 or more");
    }
  }
  const auto sigmaOfScale = [&](double noise_px) {
    const Eigen::MatrixXd covariance = lensCovariance(data, estimate, several);
    Eigen::RowVectorXd gradient;
    const double slope = axisSlope(*estimate.lens, &gradient);
    return noise_px / slope *
           std::sqrt(std::max(0.0, (gradient * covariance * gradient.transpose())(0)));
  };
  const auto noise = [&] { return noiseOf(data.observations, estimate); };
  const std::optional<double> pin = data.pinned_slope;
  bool known = false;
  if (other_information) {
    known = data.known_angle.has_value() || sigmaOfScale(noise()) < kScaleKnown;
    if (known) data.pinned_slope.reset();
  }
  adjustOrThrow(scene, settled ? lossOf(scene) : 1.0, true, threads);
  if (settled && options.grow) growStructure(scene, known, threads);
  prune(data.observations, estimate, settled ? 0.3 : 1.0, &scene.point_of);
  fitField(scene, 5.0);
  report(options, 0.8, stage);
  adjustOrThrow(scene, lossOf(scene), true, threads);
  if (known && !data.known_angle && sigmaOfScale(noise()) >= kScaleKnown) {
    known = false;
    data.pinned_slope = pin;
    adjustOrThrow(scene, lossOf(scene), true, threads);
  }
  report(options, 1.0, stage);

  TargetFreeResult result;
  result.joined = scene.joined;
  result.scan_warnings = scene.warnings;
  result.warnings = scene.warnings;
  result.scale_sigma =
      other_information ? sigmaOfScale(noise()) : std::numeric_limits<double>::infinity();
  if (known) {
    result.scale = data.known_angle         ? SurfaceScale::kKnownAngle
                   : data.boards != nullptr ? SurfaceScale::kBoard
                                            : SurfaceScale::kRotatedScans;
  } else {
    result.scale_sigma = std::numeric_limits<double>::infinity();
    if (several) {
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
  for (const ScanObservation& o : data.observations) {
    if (o.weight < 1.0) continue;
    const double r = residualOf(o, estimate);
    squares += r * r;
    ++result.observations;
  }
  result.points = static_cast<int>(estimate.points.size());
  result.rms_px = std::sqrt(squares / std::max(1, result.observations));
  // The windows were seen that far out.
  fitField(scene, settled ? kGuidedHalf : 0.0);
  for (const Pose& pose : estimate.T_scan) result.T_first_scan.push_back(pose.inverse());
  result.file.image_size = tracks.image_size;
  result.file.lens = estimate.lens;
  result.file.stage_axis = estimate.axis;
  result.file.calibration.rms_px = result.rms_px;
  result.file.calibration.points = result.points;
  if (known) {
    const double sigma = noise();
    result.file.covariance = sigma * sigma * lensCovariance(data, estimate, several);
  }
  result.track_points.resize(scene.point_of.size());
  for (std::size_t t = 0; t < scene.point_of.size(); ++t) {
    if (scene.point_of[t] >= 0) result.track_points[t] = estimate.points[scene.point_of[t]];
  }
  return result;
}

/// Measures all features again through the lens that is known by now, and adjusts anew.
TargetFreeResult refine(const std::vector<StageScan>& scans, const FeatureTracks& tracks,
                        const TargetFreeResult& first, const TargetFreeOptions& options) {
  KnownScene known;
  known.lens = first.file.lens;
  // Windows reach beyond the farthest point that was followed.
  {
    const double field = std::min(known.lens->maxTheta() + 0.1, M_PI - 0.05);
    if (auto wider = known.lens->withParameters(known.lens->parameters(), field)) {
      known.lens = wider;
    }
  }
  known.axis = *first.file.stage_axis;
  known.joined = first.joined;
  known.points = first.track_points;
  for (const Pose& pose : first.T_first_scan) known.T_scan.push_back(pose.inverse());
  report(options, 0.0, "measuring through the lens");
  const FeatureTracks measured = measureGuided(scans, tracks, known, options.threads);
  report(options, 1.0, "measuring through the lens");
  Reconstruction scene;
  scene.joined = first.joined;
  scene.warnings = first.scan_warnings;
  scene.estimate.lens = known.lens;
  scene.estimate.axis = known.axis;
  scene.estimate.T_scan = known.T_scan;
  scene.point_of.assign(measured.tracks.size(), -1);
  for (std::size_t t = 0; t < measured.tracks.size(); ++t) {
    if (measured.tracks[t].observations.empty()) continue;
    scene.point_of[t] = static_cast<int>(scene.estimate.points.size());
    scene.estimate.points.push_back(*first.track_points[t]);
    for (const auto& seen : measured.tracks[t].observations) {
      scene.data.observations.push_back(
          {scene.point_of[t], seen.scan, measured.positions_m[seen.scan][seen.image], seen.pixel});
    }
  }
  if (scene.estimate.points.size() < 50) {
    throw Error("only " + std::to_string(scene.estimate.points.size()) +
                " features could be measured again, expected 50 or more");
  }
  fitField(scene, 5.0);
  return conclude(scene, tracks, options, true);
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
  Reconstruction scene;
  ScanData& data = scene.data;
  ScanEstimate& estimate = scene.estimate;
  std::vector<int>& point_of = scene.point_of;
  estimate.T_scan.assign(tracks.positions_m.size(), Pose::Identity());

  // Every track is a point of its own scan's scene at first.
  point_of.assign(tracks.tracks.size(), -1);
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
    ScanEstimate estimate;
    ScanData data;
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
    for (const ScanObservation& o : data.observations) {
      if (good[o.point]) start.data.observations.push_back(o);
    }
    start.data.pinned_slope = axisSlope(*start.estimate.lens);
    const std::size_t used = std::count(good.begin(), good.end(), true);
    if (used < 30) return;
    AdjustOptions first;
    first.loss_px = 3.0;
    first.max_iterations = 40;
    ScanEstimate trial = start.estimate;
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
    std::vector<ScanObservation> kept;
    for (const ScanObservation& o : data.observations) {
      if (good[o.point]) kept.push_back(o);
    }
    data.observations = std::move(kept);
  }
  report(options, 0.2, stage);
  adjustOrThrow(scene, 2.0, false, threads);
  prune(data.observations, estimate, 3.0, &point_of);
  fitField(scene, 5.0);
  if (!(structureOf(*estimate.lens).model == options.structure.model &&
        options.structure.model == "conic")) {
    estimate.lens = refit(*estimate.lens, options.structure);
    data.pinned_slope = axisSlope(*estimate.lens);
  }
  adjustOrThrow(scene, 1.0, false, threads);
  prune(data.observations, estimate, 1.0, &point_of);
  adjustOrThrow(scene, 0.5, false, threads);
  if (estimate.points.size() < 50) {
    throw Error(
        "only " + std::to_string(estimate.points.size()) +
        " features agree on one lens and one axis, expected 50 or more: did the scene stand "
        "still, and are the stage positions right?");
  }
  report(options, 0.5, stage);

  scene.joined.assign(tracks.positions_m.size(), false);
  scene.joined[0] = true;

  // Join the scans: an affine map of scene to scene, of which the one scale c makes a rotation.
  struct Joint {
    int scan = 0;
    int from = 0;
    AffineFit fit;
    std::vector<PointMatch> matches;
  };
  std::vector<Joint> joints;
  std::vector<const ScanObservation*> sight(estimate.points.size(), nullptr);
  std::vector<int> scan_of(estimate.points.size(), 0);
  for (const ScanObservation& o : data.observations) {
    sight[o.point] = &o;
    scan_of[o.point] = o.scan;
  }
  for (bool grown = true; grown;) {
    grown = false;
    Joint strongest;
    for (std::size_t k = 0; k < scene.joined.size(); ++k) {
      if (scene.joined[k]) continue;
      for (std::size_t j = 0; j < scene.joined.size(); ++j) {
        if (!scene.joined[j]) continue;
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
      scene.joined[strongest.scan] = true;
      joints.push_back(std::move(strongest));
      grown = true;
    }
  }
  for (std::size_t k = 1; k < scene.joined.size(); ++k) {
    if (!scene.joined[k]) {
      scene.warnings.push_back("scan " + std::to_string(k + 1) +
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
  std::vector<ScanObservation> matched;
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
      ScanObservation seen = *joint.matches[i].seen;
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

  return conclude(scene, tracks, options, false);
}

TargetFreeResult calibrateTargetFree(const std::vector<StageScan>& scans,
                                     const TrackingOptions& tracking,
                                     const TargetFreeOptions& options) {
  const FeatureTracks tracks = trackFeatures(scans, tracking, options.progress);
  TargetFreeResult result = calibrateTargetFree(tracks, options);
  TargetFreeOptions last = options;
  last.grow = false;
  result = refine(scans, tracks, result, options);
  return refine(scans, tracks, result, last);
}

}  // namespace omnister
