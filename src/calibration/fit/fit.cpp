// SPDX-License-Identifier: Apache-2.0
#include "calibration/fit/fit.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <numeric>

#include "calibration/fit/start.h"
#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "omnister/lens/lens_fit.h"

namespace omnister::calibration {

namespace {

constexpr double kPi = 3.14159265358979323846;
/// Scale of the loss in standard deviations: beyond it a corner counts less and less.
constexpr double kLossSigmas = 3.0;
/// The loss never gets so narrow that rounding decides who is an outlier [px].
constexpr double kLeastLossPx = 0.01;
/// Room beyond the outermost corner during the fit. Little, since the surface is held one-to-one
/// over all of the field, which the best surface need not be far beyond the corners.
constexpr double kFitMargin = 1.005;
/// Room beyond the outermost corner in the end, where the surface stays one-to-one so far.
constexpr double kFieldMargin = 1.05;
constexpr double kLargestField = kPi - 0.02;

double medianOf(std::vector<double> values) {
  if (values.empty()) return 0.0;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

double lossFor(double sigma_px) { return std::max(kLossSigmas * sigma_px, kLeastLossPx); }

/// Field to fit over, given the outermost corner.
double fieldFor(double outermost, const std::string& model, double margin = kFitMargin) {
  const double field = std::min(margin * outermost, kLargestField);
  // A sphere seen from above ends at 90 degrees.
  return model == "spherical" ? std::min(field, 0.5 * kPi - 2e-3) : field;
}

/// Directions over a field, denser in angle than in azimuth since lenses are nearly round.
std::vector<Eigen::Vector3d> directions(double max_theta) {
  std::vector<Eigen::Vector3d> result = {Eigen::Vector3d::UnitZ()};
  for (int ring = 1; ring <= 24; ++ring) {
    const double theta = max_theta * ring / 24.0;
    for (int step = 0; step < 12; ++step) {
      const double azimuth = 2.0 * kPi * (step + 0.5 * (ring % 2)) / 12.0;
      result.emplace_back(std::sin(theta) * std::cos(azimuth), std::sin(theta) * std::sin(azimuth),
                          std::cos(theta));
    }
  }
  return result;
}

/// Adjusts until loss and field are those that the corners ask for.
bool settle(const FitInput& input, const std::vector<BundleView>& views, BundleOptions options,
            Fit& fit) {
  constexpr int kRounds = 4;
  const double tolerance = options.tolerance;
  for (int round = 0; round < kRounds; ++round) {
    options.loss_px = lossFor(fit.sigma_px);
    options.tolerance = round == 0 ? std::max(1e-5, tolerance) : tolerance;
    if (!adjust(views, options, fit.state)) return false;
    fit.loss_px = options.loss_px;
    fit.sigma_px = statisticsOf(residualsOf(input, fit.state)).sigma_px;
    // A corner outside the field is only roughly predicted: move the edge behind the last one.
    const double field =
        fieldFor(outermostAngle(input, fit.state, fit.sigma_px), fit.structure.model);
    LensPtr& lens = fit.state.lenses[0];
    const double before = lens->maxTheta();
    if (field > 0.0) lens = withField(lens, field);
    const bool steady = lens->maxTheta() <= before + 1e-4;
    if (round > 0 && steady && lossFor(fit.sigma_px) > 0.8 * fit.loss_px) break;
  }
  return std::isfinite(fit.sigma_px);
}

/// Gives the fitted lens the field that it is to have in the end.
void widen(const FitInput& input, Fit& fit) {
  const double reached =
      fieldFor(outermostAngle(input, fit.state, fit.sigma_px), fit.structure.model, kFieldMargin);
  if (reached > 0.0) fit.state.lenses[0] = withField(fit.state.lenses[0], reached);
}

}  // namespace

std::size_t FitInput::cornerCount() const {
  std::size_t count = 0;
  for (const auto& view : corners) count += view.size();
  return count;
}

BundleOptions FitInput::freedom() const {
  BundleOptions options;
  options.warp = warp;
  options.axis = stage;
  return options;
}

FitInput FitInput::subset(const std::vector<bool>& keep) const {
  FitInput kept = *this;
  kept.names.clear();
  kept.index.clear();
  kept.corners.clear();
  kept.pose.clear();
  kept.travel.clear();
  for (std::size_t i = 0; i < corners.size(); ++i) {
    if (!keep[i]) continue;
    kept.names.push_back(names[i]);
    kept.index.push_back(index[i]);
    kept.corners.push_back(corners[i]);
    kept.pose.push_back(pose[i]);
    kept.travel.push_back(travel[i]);
  }
  return kept;
}

void FitInput::separate() {
  stage = false;
  pose.resize(corners.size());
  std::iota(pose.begin(), pose.end(), 0);
  travel.assign(corners.size(), 0.0);
}

ResidualStatistics statisticsOf(const std::vector<std::vector<Eigen::Vector2d>>& residuals) {
  std::vector<double> lengths;
  double squares = 0.0;
  for (const auto& view : residuals) {
    for (const Eigen::Vector2d& residual : view) {
      squares += residual.squaredNorm();
      lengths.push_back(residual.norm());
    }
  }
  ResidualStatistics statistics;
  if (lengths.empty()) return statistics;
  statistics.rms_px = std::sqrt(squares / static_cast<double>(lengths.size()));
  statistics.median_px = medianOf(std::move(lengths));
  statistics.sigma_px = statistics.median_px / 1.17741;  // median of a Rayleigh distribution
  return statistics;
}

std::string describeStructure(const LensStructure& structure) {
  std::string text = structure.model;
  if (structure.model == "asphere") {
    text += structure.even_terms == 0 ? "" : " r^" + std::to_string(2 + 2 * structure.even_terms);
  }
  if (structure.model == "spline" && structure.grid > 0) {
    const std::string side = std::to_string(structure.grid);
    text += ": asphere";
    text += structure.even_terms == 0 ? "" : " r^" + std::to_string(2 + 2 * structure.even_terms);
    text += " + " + side + "x" + side + " grid";
  } else if (structure.model == "spline") {
    text += " of " + std::to_string(structure.knots) + " knots";
  }
  if (structure.affinity) text += " + affinity";
  if (structure.decentring) text += " + decentring";
  return text;
}

void checkStructure(const LensStructure& structure) {
  makeLens(structure, Eigen::Vector2d(500.0, 500.0), 300.0, 1.0);
}

std::vector<BundleView> bundleViews(const FitInput& input) {
  std::vector<BundleView> views(input.corners.size());
  for (std::size_t i = 0; i < views.size(); ++i) {
    views[i].corners = &input.corners[i];
    views[i].pose = input.pose[i];
    views[i].travel = input.travel[i];
  }
  return views;
}

std::vector<std::vector<Eigen::Vector2d>> residualsOf(const FitInput& input,
                                                      const BundleState& state) {
  std::vector<std::vector<Eigen::Vector2d>> residuals;
  residuals.reserve(input.corners.size());
  for (const BundleView& view : bundleViews(input)) {
    residuals.push_back(residualsOf(view, state));
  }
  return residuals;
}

double focalLength(const LensModel& lens) {
  Jacobian23 jacobian;
  const auto pixel = lens.project(Eigen::Vector3d::UnitZ(), &jacobian);
  if (!pixel) throw Error("the lens has no image of its own axis");
  return std::sqrt(std::abs(jacobian.leftCols<2>().determinant()));
}

LensPtr withField(const LensPtr& lens, double max_theta) {
  if (LensPtr wider = lens->withParameters(lens->parameters(), max_theta)) return wider;
  double low = std::min(lens->maxTheta(), max_theta);
  double high = max_theta;
  LensPtr best = lens->withParameters(lens->parameters(), low);
  for (int i = 0; i < 20 && high - low > 1e-4; ++i) {
    const double middle = 0.5 * (low + high);
    if (LensPtr wider = lens->withParameters(lens->parameters(), middle)) {
      best = wider;
      low = middle;
    } else {
      high = middle;
    }
  }
  return best ? best : lens;
}

double outermostAngle(const FitInput& input, const BundleState& state, double sigma_px) {
  const double limit = std::max(5.0 * sigma_px, 0.05);
  double outermost = 0.0;
  for (const BundleView& view : bundleViews(input)) {
    const auto residuals = residualsOf(view, state);
    for (std::size_t i = 0; i < residuals.size(); ++i) {
      if (residuals[i].norm() > limit) continue;
      const Eigen::Vector3d X = cornerInCamera(view, state, (*view.corners)[i]);
      outermost = std::max(outermost, std::atan2(X.head<2>().norm(), X.z()));
    }
  }
  return outermost;
}

std::optional<Fit> firstFit(const FitInput& input, int threads, std::vector<bool>* lost) {
  const Eigen::Vector2d center(0.5 * (input.image_size.width - 1),
                               0.5 * (input.image_size.height - 1));
  const double good_px = 1e-3 * std::hypot(input.image_size.width, input.image_size.height);
  const auto views = bundleViews(input);
  std::optional<Fit> best;
  for (const Start& start : findStarts(input.corners, input.image_size, threads)) {
    Fit fit;
    fit.structure = LensStructure();
    fit.structure.model = "conic";
    const double field = std::min(1.15 * start.max_theta, kLargestField);
    const double sampled = std::min(field, 0.98 * start.profile.maxTheta());
    LensPtr lens = makeLens(fit.structure, center, start.profile.focal_px, field);
    const auto bearings = directions(std::min(start.max_theta, sampled));
    std::vector<Eigen::Vector2d> pixels;
    for (const Eigen::Vector3d& bearing : bearings) {
      const double rho = bearing.head<2>().norm();
      const double theta = std::atan2(rho, bearing.z());
      pixels.push_back(center);
      if (rho > 0.0) pixels.back() += start.profile.radius(theta) / rho * bearing.head<2>();
    }
    lens = fitLens(*lens, bearings, pixels).lens;
    fit.state.lenses = {lens};
    fit.state.poses.assign(views.size(), Pose::Identity());
    std::vector<char> without(views.size(), 0);
    std::vector<double> medians(views.size(), 0.0);
    // Every view writes only its own pose; the copy of the state is what refinePose works on.
    parallelFor(0, views.size(), threads, [&](std::size_t i) {
      const auto pose =
          poseFromBearings(bearingsOf(start.profile, center, input.corners[i]), input.corners[i]);
      if (!pose) {
        without[i] = 1;
        return;
      }
      BundleState single;
      single.lenses = fit.state.lenses;
      single.poses = {*pose};
      BundleView view = views[i];
      view.pose = 0;
      refinePose({view}, std::max(1.0, start.score_px), single);
      fit.state.poses[i] = single.poses[0];
      medians[i] = statisticsOf({residualsOf(view, single)}).median_px;
    });
    std::vector<BundleView> usable;
    std::vector<double> found;
    for (std::size_t i = 0; i < views.size(); ++i) {
      if (!without[i]) found.push_back(medians[i]);
    }
    if (found.size() < 3) continue;
    // A view far worse than its fellows would pull the first lens away from them.
    const double typical = medianOf(found);
    for (std::size_t i = 0; i < views.size(); ++i) {
      if (!without[i] && medians[i] <= 10.0 * typical + 5.0) usable.push_back(views[i]);
    }
    BundleOptions options;
    options.warp = false;
    options.max_iterations = 100;
    fit.sigma_px = std::max(typical, 0.3);
    bool done = true;
    for (int round = 0; round < 3 && done; ++round) {
      options.loss_px = lossFor(fit.sigma_px);
      options.tolerance = round < 2 ? 1e-4 : 1e-6;
      done = adjust(usable, options, fit.state);
      if (!done) break;
      std::vector<std::vector<Eigen::Vector2d>> residuals;
      for (const BundleView& view : usable) residuals.push_back(residualsOf(view, fit.state));
      fit.sigma_px = statisticsOf(residuals).sigma_px;
      fit.loss_px = options.loss_px;
      // The corners may have moved outwards or inwards of the field that the start guessed.
      const double outermost = outermostAngle(input, fit.state, 3.0 * fit.sigma_px);
      if (outermost > 0.0) {
        fit.state.lenses[0] = withField(fit.state.lenses[0], fieldFor(outermost, "conic"));
      }
    }
    if (!done || !std::isfinite(fit.sigma_px)) continue;
    if (!best || fit.sigma_px < best->sigma_px) {
      best = fit;
      if (lost != nullptr) lost->assign(without.begin(), without.end());
    }
    if (best->sigma_px < good_px) break;
  }
  if (!best) return std::nullopt;
  // Views left aside above get their pose from the fitted lens.
  for (const BundleView& view : views) {
    if (lost != nullptr && (*lost)[view.pose]) continue;
    refinePose({view}, std::max(best->loss_px, 1.0), best->state);
  }
  return best;
}

std::optional<Fit> refit(const FitInput& input, const Fit& from, const LensStructure& structure,
                         double tolerance) {
  const LensModel& known = *from.state.lenses[0];
  const double outermost = outermostAngle(input, from.state, from.sigma_px);
  if (!(outermost > 0.0)) return std::nullopt;
  const double field = fieldFor(outermost, structure.model);
  Fit fit = from;
  fit.structure = structure;
  LensPtr lens = makeLens(structure, known.center(), focalLength(known), field);
  std::vector<Eigen::Vector3d> bearings;
  std::vector<Eigen::Vector2d> pixels;
  for (const Eigen::Vector3d& bearing : directions(0.999 * field)) {
    const auto pixel = projectContinued(known, bearing);
    if (!pixel) continue;
    bearings.push_back(bearing);
    pixels.push_back(*pixel);
  }
  // A grid's control points start at zero: they are for what nothing else can say.
  LensFitOptions base;
  base.parameters =
      static_cast<int>(lens->parameters().size()) - 2 * structure.grid * structure.grid;
  lens = fitLens(*lens, bearings, pixels, base).lens;
  fit.state.lenses = {lens};

  const auto views = bundleViews(input);
  BundleOptions options = input.freedom();
  // A poorer structure than the one before explains less: start with the loss it deserves.
  std::vector<std::vector<BundleView>> sights(fit.state.poses.size());
  for (const BundleView& view : views) sights[view.pose].push_back(view);
  for (const auto& sight : sights) {
    if (!sight.empty()) refinePose(sight, 0.0, fit.state, 3);
  }
  fit.sigma_px = std::max(from.sigma_px, statisticsOf(residualsOf(input, fit.state)).sigma_px);
  options.tolerance = tolerance;
  if (!settle(input, views, options, fit)) return std::nullopt;
  widen(input, fit);
  return fit;
}

void polish(const FitInput& input, Fit& fit) {
  Fit polished = fit;
  BundleOptions options = input.freedom();
  options.tolerance = kPolishTolerance;
  if (!settle(input, bundleViews(input), options, polished)) return;
  widen(input, polished);
  fit = std::move(polished);
}

std::optional<double> holdoutRms(const FitInput& input, const Fit& fit, int folds, int threads) {
  const auto views = bundleViews(input);
  struct Sum {
    double squares = 0.0;
    std::size_t count = 0;
    bool failed = false;
  };
  std::vector<Sum> sums(static_cast<std::size_t>(folds));
  parallelFor(0, sums.size(), threads, [&](std::size_t fold) {
    Sum& sum = sums[fold];
    std::vector<BundleView> known;
    std::vector<BundleView> unseen;
    for (std::size_t i = 0; i < views.size(); ++i) {
      const bool held_out = input.index[i] % folds == static_cast<int>(fold);
      (held_out ? unseen : known).push_back(views[i]);
    }
    if (unseen.empty()) return;
    BundleState state = fit.state;
    BundleOptions options = input.freedom();
    options.loss_px = fit.loss_px;
    options.tolerance = kTrialTolerance;
    if (known.size() < 3 || !adjust(known, options, state)) {
      sum.failed = true;
      return;
    }
    for (const BundleView& view : unseen) {
      refinePose({view}, 0.0, state);
      for (const Eigen::Vector2d& residual : residualsOf(view, state)) {
        sum.squares += residual.squaredNorm();
        ++sum.count;
      }
    }
  });
  double squares = 0.0;
  std::size_t count = 0;
  for (const Sum& sum : sums) {
    if (sum.failed) return std::nullopt;
    squares += sum.squares;
    count += sum.count;
  }
  if (count == 0 || !std::isfinite(squares)) return std::nullopt;
  return std::sqrt(squares / static_cast<double>(count));
}

}  // namespace omnister::calibration
