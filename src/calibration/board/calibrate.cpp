// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/calibrate.h"

#include <algorithm>
#include <cmath>
#include <map>

#include "calibration/board/board_scale.h"
#include "calibration/board/calibration_steps.h"
#include "calibration/board/stage_views.h"
#include "calibration/uncertainty/covariance.h"
#include "omnister/calibration/uncertainty.h"
#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/common/parallel.h"
#include "omnister/common/text.h"

namespace omnister {
namespace calibration {

namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr int kDefaultFolds = 5;
/// A richer structure must predict better than a simpler one by this part to be chosen.
constexpr double kParsimony = 0.003;
/// Held-out errors that differ by less are the same [px].
constexpr double kSamePx = 2e-5;
/// With more corners than this, every structure is well determined and trying them all takes long.
constexpr std::size_t kManyCorners = 8000;
/// With fewer corners a grid of corrections only follows the noise.
constexpr std::size_t kGridCorners = 3000;

std::string joined(const std::vector<std::string>& parts, std::size_t limit = 8) {
  std::string text;
  for (std::size_t i = 0; i < parts.size() && i < limit; ++i) {
    text += (i > 0 ? ", " : "") + parts[i];
  }
  if (parts.size() > limit) text += " and " + std::to_string(parts.size() - limit) + " more";
  return text;
}

double degrees(double radians) { return radians * 180.0 / kPi; }

bool sameCorners(const ViewDetections& a, const ViewDetections& b) {
  if (a.pixels.size() != b.pixels.size()) return false;
  for (std::size_t i = 0; i < a.pixels.size(); ++i) {
    if ((a.pixels[i] - b.pixels[i]).squaredNorm() > 1e-8 || a.points[i] != b.points[i])
      return false;
  }
  return true;
}

/// Angle between the board and the image plane.
double tilt(const Pose& T_camera_plane) {
  return std::acos(std::min(1.0, std::abs(T_camera_plane.linear()(2, 2))));
}

}  // namespace

Prepared prepareViews(const Detections& detections, bool warp, const Board* board) {
  if (detections.image_size.width <= 0 || detections.image_size.height <= 0) {
    throw Error("calibration needs the size of the images");
  }
  Prepared prepared;
  std::vector<ViewDetections> with_corners;
  for (const ViewDetections& view : detections.views) {
    if (view.pixels.size() != view.points.size()) {
      throw Error("view '" + view.name + "' has " + std::to_string(view.pixels.size()) +
                  " pixels for " + std::to_string(view.points.size()) + " board points");
    }
    for (std::size_t i = 0; i < view.pixels.size(); ++i) {
      if (!view.pixels[i].allFinite() || !view.points[i].allFinite()) {
        throw Error("view '" + view.name + "' holds a corner that is not finite");
      }
    }
  }
  prepared.input.image_size = detections.image_size;
  prepared.input.warp = warp;
  prepared.input.board = board != nullptr ? *board : makeBoard(detections.views);
  const auto leaveOut = [&](ViewResult& result, const std::string& reason) {
    result.used = false;
    result.reason = reason;
    prepared.warnings.push_back("view '" + result.name + "' is not used: " + reason);
  };
  for (std::size_t v = 0; v < detections.views.size(); ++v) {
    const ViewDetections& view = detections.views[v];
    ViewResult& result = prepared.views.emplace_back();
    result.name = view.name;
    result.T_camera_board = Pose::Identity();
    if (view.pixels.size() < 4) {
      leaveOut(result,
               "only " + std::to_string(view.pixels.size()) + " corners, at least 4 are needed");
      continue;
    }
    std::vector<Corner> corners;
    for (std::size_t i = 0; i < view.pixels.size(); ++i) {
      corners.push_back(prepared.input.board.corner(view.pixels[i], view.points[i]));
    }
    if (!spansPlane(corners, prepared.input.board)) {
      leaveOut(result, "its corners lie on one line of the board");
      continue;
    }
    const auto twin =
        std::find_if(prepared.input.index.begin(), prepared.input.index.end(), [&](int other) {
          return sameCorners(view, detections.views[static_cast<std::size_t>(other)]);
        });
    if (twin != prepared.input.index.end()) {
      leaveOut(result, "the same corners as view '" +
                           detections.views[static_cast<std::size_t>(*twin)].name + "'");
      continue;
    }
    prepared.input.names.push_back(view.name);
    prepared.input.index.push_back(static_cast<int>(v));
    prepared.input.corners.push_back(std::move(corners));
  }
  prepared.input.separate();
  if (prepared.input.corners.size() < 3) {
    throw Error("calibration needs at least 3 different views of the board, " +
                std::to_string(prepared.input.corners.size()) + " of " +
                std::to_string(detections.views.size()) + " can be used" +
                (prepared.warnings.empty() ? "" : ": " + joined(prepared.warnings, 3)));
  }
  return prepared;
}

Fit trustedFirstFit(Prepared& prepared, int threads) {
  std::vector<bool> lost;
  FitInput& input = prepared.input;
  const std::optional<Fit> first = firstFit(input, threads, &lost);
  if (!first) {
    throw Error(
        "no lens explains the corners, not even roughly: check that the board coordinates are "
        "those of "
        "this board and that corners and board points are in the same order");
  }
  // Views that contradict the lens that the others agree on.
  const auto residuals = residualsOf(input, first->state);
  std::vector<double> medians;
  double seen_from_front = 0.0;
  std::vector<double> sides;
  for (std::size_t i = 0; i < residuals.size(); ++i) {
    medians.push_back(statisticsOf({residuals[i]}).median_px);
    const Pose& pose = first->state.poses[i];
    sides.push_back(pose.linear().col(2).dot(pose.translation()) > 0.0 ? 1.0 : -1.0);
    seen_from_front += sides.back();
  }
  std::vector<double> sorted = medians;
  std::nth_element(sorted.begin(), sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2),
                   sorted.end());
  const double typical = sorted[sorted.size() / 2];
  std::vector<bool> trusted(residuals.size(), false);
  Fit fit = *first;
  fit.state.poses.clear();
  for (std::size_t i = 0; i < residuals.size(); ++i) {
    std::string reason;
    if (lost[i]) {
      reason = "no pose of the board explains its corners";
    } else if (medians[i] > 8.0 * typical + 2.0) {
      reason = "its corners are " + formatFixed(medians[i], 1) +
               " px off a lens that the others agree on (" + formatFixed(typical, 2) + " px)";
    } else if (sides[i] * seen_from_front < 0.0) {
      reason = "its corners are mirrored against those of the other views";
    }
    if (reason.empty()) {
      trusted[i] = true;
      fit.state.poses.push_back(first->state.poses[i]);
      continue;
    }
    ViewResult& view = prepared.views[static_cast<std::size_t>(input.index[i])];
    view.used = false;
    view.reason = reason;
    prepared.warnings.push_back("view '" + view.name + "' is not used: " + reason);
  }
  FitInput kept = input.subset(trusted);
  kept.separate();
  if (kept.corners.size() < 3) {
    throw Error("calibration needs at least 3 views that agree, " +
                std::to_string(kept.corners.size()) + " do: " + joined(prepared.warnings, 3));
  }
  input = std::move(kept);

  const double diagonal = std::hypot(input.image_size.width, input.image_size.height);
  const double median = statisticsOf(residualsOf(input, fit.state)).median_px;
  if (!(median < 5e-3 * diagonal)) {
    throw Error(
        "no lens explains the corners: the best is " + formatFixed(median, 1) +
        " px off for half of them; check that the board coordinates are those of this board and "
        "that all views are from one camera at one focal length");
  }
  return fit;
}

namespace {

/// What the choice has tried so far.
struct Tried {
  LensStructure structure;
  Fit fit;
  std::optional<double> holdout;
  int parameters = 0;
};

bool sameStructure(const LensStructure& a, const LensStructure& b) {
  return a.model == b.model && a.affinity == b.affinity && a.decentring == b.decentring &&
         a.grid == b.grid && (a.model != "asphere" || a.even_terms == b.even_terms) &&
         (a.model != "spline" || (a.grid > 0 ? a.even_terms == b.even_terms : a.knots == b.knots));
}

class StructureChoice {
 public:
  StructureChoice(const FitInput& input, const CalibrationOptions& options, int folds)
      : input_(input), options_(options), folds_(folds) {}

  /// Fits and judges those not tried yet; all in parallel, each on its own.
  void consider(std::vector<LensStructure> structures, const Fit& from) {
    structures.erase(std::remove_if(structures.begin(), structures.end(),
                                    [&](const LensStructure& structure) {
                                      return std::any_of(
                                          tried_.begin(), tried_.end(), [&](const Tried& t) {
                                            return sameStructure(t.structure, structure);
                                          });
                                    }),
                     structures.end());
    std::vector<std::optional<Tried>> results(structures.size());
    parallelFor(0, structures.size(), options_.threads, [&](std::size_t i) {
      const LensStructure& structure = structures[i];
      auto fit = refit(input_, from, structure, kTrialTolerance);
      if (!fit) return;
      Tried tried;
      tried.structure = structure;
      tried.parameters = static_cast<int>(fit->state.lenses[0]->parameters().size());
      tried.fit = std::move(*fit);
      if (folds_ > 0) tried.holdout = holdoutRms(input_, tried.fit, folds_, options_.threads);
      results[i] = std::move(tried);
    });
    for (auto& result : results) {
      if (result) tried_.push_back(std::move(*result));
    }
    done_ += 1;
    if (options_.progress)
      options_.progress(std::min(0.95, 0.2 + 0.15 * done_), "choosing the lens model");
  }

  /// The simplest of those that predict best. Null when nothing could be fitted.
  const Tried* best() const {
    double least = HUGE_VAL;
    for (const Tried& tried : tried_) least = std::min(least, score(tried));
    const Tried* chosen = nullptr;
    for (const Tried& tried : tried_) {
      if (!(score(tried) <= least * (1.0 + kParsimony) + kSamePx)) continue;
      if (chosen == nullptr || tried.parameters < chosen->parameters ||
          (tried.parameters == chosen->parameters && score(tried) < score(*chosen))) {
        chosen = &tried;
      }
    }
    return chosen;
  }

  const std::vector<Tried>& tried() const { return tried_; }

 private:
  static double score(const Tried& tried) { return tried.holdout ? *tried.holdout : HUGE_VAL; }

  const FitInput& input_;
  const CalibrationOptions& options_;
  int folds_;
  int done_ = 0;
  std::vector<Tried> tried_;
};

LensStructure make(const std::string& model, int even_terms, int knots, bool affinity,
                   bool decentring) {
  LensStructure structure;
  structure.model = model;
  structure.even_terms = even_terms;
  structure.knots = knots;
  structure.affinity = affinity;
  structure.decentring = decentring && (model == "asphere" || model == "spline");
  return structure;
}

std::vector<LensStructure> radialForms(const std::string& model, bool affinity, bool decentring,
                                       bool many) {
  std::vector<LensStructure> forms;
  const bool any = model == "auto";
  if (any || model == "asphere") {
    for (const int terms : {1, 2, 3})
      forms.push_back(make("asphere", terms, 12, affinity, decentring));
  }
  if (any || model == "spline") {
    for (const int knots : many ? std::vector<int>{8, 14} : std::vector<int>{5, 7, 10, 14}) {
      forms.push_back(make("spline", 0, knots, affinity, decentring));
    }
  }
  if (any) forms.push_back(make("conic", 0, 12, affinity, false));
  if (!any && forms.empty()) forms.push_back(make(model, 0, 12, affinity, false));
  return forms;
}

}  // namespace

Selection selectStructure(const FitInput& input, const Fit& first,
                          const CalibrationOptions& options) {
  const int views = static_cast<int>(input.corners.size());
  const bool choose = !options.structure;
  int folds = options.folds;
  if (folds == 0 && choose) folds = kDefaultFolds;
  const int all_views = input.index.back() + 1;
  folds = std::min(folds, all_views);
  const bool many = input.cornerCount() > kManyCorners;

  Selection selection;
  StructureChoice choice(input, options, folds);
  if (!choose) {
    choice.consider({*options.structure}, first);
  } else if (views < 5) {
    // Too few views to hold any back from the fit: the least that is known to serve wide lenses.
    const std::string model = options.model == "auto" ? "conic" : options.model;
    choice.consider({make(model, model == "asphere" ? 1 : 0, 5, false, false)}, first);
  } else {
    const std::string& model = options.model;
    const bool rich = model == "auto" || model == "asphere" || model == "spline";
    // A middling radial form first decides what it carries besides; then the form; then once more
    // what it carries, since the two depend on each other.
    const std::string middling = model == "auto" ? "asphere" : model;
    std::vector<LensStructure> carried;
    for (const bool affinity : {false, true}) {
      carried.push_back(make(middling, 1, 7, affinity, false));
      if (rich) carried.push_back(make(middling, 1, 7, affinity, true));
    }
    choice.consider(many ? std::vector<LensStructure>{carried.front(), carried.back()} : carried,
                    first);
    const Tried* best = choice.best();
    if (best != nullptr && rich) {
      const LensStructure found = best->structure;
      const Fit from = best->fit;
      choice.consider(radialForms(model, found.affinity, found.decentring, many), from);
      best = choice.best();
      if (best != nullptr && !many) {
        const LensStructure form = best->structure;
        const Fit start = best->fit;
        std::vector<LensStructure> last;
        for (const bool affinity : {false, true}) {
          for (const bool decentring : {false, true}) {
            last.push_back(make(form.model, form.even_terms, form.knots, affinity, decentring));
          }
        }
        choice.consider(last, start);
        best = choice.best();
      }
      // What no radial surface can say, where there are corners enough to tell: a coarse grid of
      // corrections first, and a finer one where that helps.
      if (best != nullptr && model != "asphere" && input.cornerCount() >= kGridCorners) {
        for (const int side : {6, 9}) {
          LensStructure grid = best->structure;
          const Fit start = best->fit;
          if (grid.model != "asphere" && grid.grid == 0) grid.even_terms = 2;
          grid.model = "spline";
          grid.grid = side;
          choice.consider({grid}, start);
          best = choice.best();
          if (best->structure.grid != side) break;
        }
      }
    }
  }

  const Tried* chosen = choice.best();
  if (chosen == nullptr && !choice.tried().empty()) chosen = &choice.tried().front();
  if (chosen == nullptr) {
    throw Error("the adjustment of model '" +
                (options.structure ? options.structure->model : options.model) +
                "' did not converge on these views");
  }
  for (const Tried& tried : choice.tried()) {
    CandidateResult candidate;
    candidate.structure = tried.structure;
    candidate.rms_px = statisticsOf(residualsOf(input, tried.fit.state)).rms_px;
    candidate.holdout_rms_px = tried.holdout;
    candidate.chosen = &tried == chosen;
    selection.candidates.push_back(candidate);
  }
  selection.fit = chosen->fit;
  polish(input, selection.fit);
  selection.holdout_rms_px = chosen->holdout;
  return selection;
}

void refuseUndetermined(const FitInput& input, const BundleState& state, const LensModel& lens,
                        const Eigen::MatrixXd& covariance, cv::Size image_size) {
  const ProjectionField field = projectionUncertainty(lens, covariance, image_size, 24);
  const double diagonal = std::hypot(image_size.width, image_size.height);
  const double limit = 4e-3 * diagonal;
  double largest = 0.0;
  for (const Pose& pose : state.poses) largest = std::max(largest, tilt(pose));
  // Boards all square to the axis fix nothing but ratios (Johnson 1997, sec. 4.3, took them for
  // metric); whatever else then settles the scale is the model's prejudice.
  // Steps of a stage that lead towards the board settle it too.
  const bool towards =
      input.stage && std::abs(state.axis.normalized().z()) > std::sin(3.0 * kPi / 180.0);
  const bool all_square = degrees(largest) < 3.0 && !towards;
  if (field.rms_px <= limit && !all_square) return;
  double low_x = HUGE_VAL;
  double high_x = -HUGE_VAL;
  double low_y = HUGE_VAL;
  double high_y = -HUGE_VAL;
  for (const auto& view : input.corners) {
    for (const Corner& corner : view) {
      low_x = std::min(low_x, corner.pixel.x());
      high_x = std::max(high_x, corner.pixel.x());
      low_y = std::min(low_y, corner.pixel.y());
      high_y = std::max(high_y, corner.pixel.y());
    }
  }
  const double covered =
      (high_x - low_x) * (high_y - low_y) / (1.0 * image_size.width * image_size.height);
  const std::string verdict = "the views do not determine the lens (projection uncertain by " +
                              formatFixed(field.rms_px, 1) + " px): ";
  if (all_square || degrees(largest) < 10.0) {
    throw Error(
        verdict + "every board is square to the optical axis (largest tilt " +
        formatFixed(degrees(largest), 1) +
        " degrees), which leaves the scale of the lens open; tilt some by 20 degrees or more");
  }
  if (covered < 0.15) {
    throw Error(verdict + "the corners cover only " + formatFixed(100.0 * covered, 0) +
                " % of the image; show the board in all of it");
  }
  throw Error(verdict +
              "add views with the board tilted by 20 degrees or more about different axes, in "
              "all parts of the image");
}

LensStructure richerThan(const LensStructure& structure) {
  LensStructure richer = structure;
  if (richer.grid > 0) {
    richer.grid = std::min(12, richer.grid + 2);
  } else if (richer.model == "spline") {
    richer.knots = std::min(32, richer.knots + 4);
  } else if (richer.model == "asphere") {
    richer.even_terms = richer.even_terms + 1;
    if (richer.even_terms > 3) {
      richer.model = "spline";
      richer.knots = 10;
    }
  } else {
    richer.model = "asphere";
    richer.even_terms = 1;
  }
  return richer;
}

namespace {

/// Coverage of the image about the centre of distortion.
void warnOfCoverage(const FitInput& input, const LensModel& lens,
                    std::vector<std::string>& warnings) {
  const Eigen::Vector2d center = lens.center();
  const double width = input.image_size.width;
  const double height = input.image_size.height;
  constexpr int kSectors = 8;
  std::vector<double> reach(kSectors, 0.0);
  for (const auto& view : input.corners) {
    for (const Corner& corner : view) {
      const Eigen::Vector2d offset = corner.pixel - center;
      const double turn = std::atan2(offset.y(), offset.x()) / (2.0 * kPi) + 1.0;
      const int sector = static_cast<int>(std::floor(turn * kSectors)) % kSectors;
      reach[sector] = std::max(reach[sector], offset.norm());
    }
  }
  static constexpr const char* kNames[kSectors] = {"right to lower right", "lower right to bottom",
                                                   "bottom to lower left", "lower left to left",
                                                   "left to upper left",   "upper left to top",
                                                   "top to upper right",   "upper right to right"};
  std::vector<std::string> bare;
  const double half = 0.25 * std::min(width, height);
  for (int i = 0; i < kSectors; ++i) {
    if (reach[i] < half) bare.emplace_back(kNames[i]);
  }
  if (!bare.empty()) {
    warnings.push_back("no corner lies in the outer image towards " + joined(bare) +
                       ": the lens is extrapolated there");
  }
}

/// Standard deviation of focalLength().
double heightSigma(const LensModel& lens, const Eigen::MatrixXd& covariance) {
  const Eigen::VectorXd values = lens.parameters();
  Eigen::VectorXd slope = Eigen::VectorXd::Zero(values.size());
  for (Eigen::Index i = 0; i < values.size(); ++i) {
    // A step that the data would not notice, so that the numbers stay those of a lens.
    const double step = 1e-3 * std::sqrt(std::max(covariance(i, i), 0.0)) + 1e-9;
    Eigen::VectorXd low = values;
    Eigen::VectorXd high = values;
    low[i] -= step;
    high[i] += step;
    const LensPtr below = lens.withParameters(low);
    const LensPtr above = lens.withParameters(high);
    if (!below || !above) return std::nan("");
    slope[i] = (focalLength(*above) - focalLength(*below)) / (2.0 * step);
  }
  return std::sqrt(std::max(0.0, slope.dot(covariance * slope)));
}

}  // namespace

CalibrationResult assembleResult(const Prepared& prepared, const Selection& selection,
                                 const CalibrationOptions& options,
                                 const Eigen::MatrixXd& covariance,
                                 const std::optional<Fit>& richer) {
  const FitInput& input = prepared.input;
  const Fit& fit = selection.fit;
  CalibrationResult result;
  result.views = prepared.views;
  result.warnings = prepared.warnings;
  result.candidates = selection.candidates;
  result.holdout_rms_px = selection.holdout_rms_px;
  result.board_warp = fit.state.warp;
  const auto residuals = residualsOf(input, fit.state);
  const ResidualStatistics statistics = statisticsOf(residuals);
  result.rms_px = statistics.rms_px;
  result.points = static_cast<int>(input.cornerCount());

  std::vector<double> view_rms;
  for (std::size_t i = 0; i < residuals.size(); ++i) {
    ViewResult& view = result.views[static_cast<std::size_t>(input.index[i])];
    Pose T_camera_plane = fit.state.poses[static_cast<std::size_t>(input.pose[i])];
    T_camera_plane.translation() -= input.travel[i] * fit.state.axis;
    view.T_camera_board = T_camera_plane * input.board.T_plane_board;
    view.residuals = residuals[i];
    view.rms_px = statisticsOf({residuals[i]}).rms_px;
    view_rms.push_back(view.rms_px);
  }
  std::vector<double> sorted = view_rms;
  std::nth_element(sorted.begin(), sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2),
                   sorted.end());
  const double typical = sorted[sorted.size() / 2];
  std::vector<std::string> outliers;
  int outlier_count = 0;
  const double outlier_limit = std::max(6.0 * statistics.sigma_px, 0.05);
  for (std::size_t i = 0; i < residuals.size(); ++i) {
    const auto far =
        std::count_if(residuals[i].begin(), residuals[i].end(),
                      [&](const auto& residual) { return residual.norm() > outlier_limit; });
    if (view_rms[i] > 3.0 * typical + 0.02 && far * 4 >= static_cast<long>(residuals[i].size())) {
      result.warnings.push_back("view '" + input.names[i] +
                                "' fits badly: " + formatFixed(view_rms[i], 2) + " px where " +
                                formatFixed(typical, 2) + " px is typical");
    } else if (far > 0) {
      outliers.push_back("'" + input.names[i] + "' (" + std::to_string(far) + ")");
    }
    outlier_count += static_cast<int>(far);
  }
  if (!outliers.empty()) {
    result.warnings.push_back(std::to_string(outlier_count) + " of " +
                              std::to_string(result.points) + " corners lie more than " +
                              formatFixed(outlier_limit, 2) + " px off and hardly count: views " +
                              joined(outliers));
  }
  const LensPtr lens = fit.state.lenses[0];
  result.height_px = focalLength(*lens);
  result.height_sigma_px = heightSigma(*lens, covariance);
  warnOfCoverage(input, *lens, result.warnings);

  const ProjectionField uncertainty = projectionUncertainty(*lens, covariance, input.image_size);
  auto& notes = result.file.calibration.notes;
  notes["uncertainty_rms_px"] = formatFixed(uncertainty.rms_px, 4);
  notes["uncertainty_max_px"] = formatFixed(uncertainty.max_px, 4);
  result.uncertainty_rms_px = uncertainty.rms_px;
  result.uncertainty_max_px = uncertainty.max_px;
  std::vector<double> distances;
  for (const BundleView& view : bundleViews(input)) {
    const Corner middle{Eigen::Vector2d::Zero(), Eigen::Vector3d::Zero(), Eigen::Vector2d::Zero()};
    distances.push_back(cornerInCamera(view, fit.state, middle).norm());
  }
  std::nth_element(distances.begin(),
                   distances.begin() + static_cast<std::ptrdiff_t>(distances.size() / 2),
                   distances.end());
  const double near = distances[distances.size() / 2];
  for (const double times : {1.0, 2.0, 10.0, HUGE_VAL}) {
    if (!(near > 0.0)) break;
    const ProjectionField at =
        projectionUncertaintyAt(*lens, covariance, input.image_size, near, times * near, 24);
    result.depth_uncertainty.push_back({times * near, at.rms_px, at.max_px});
  }
  if (uncertainty.rms_px > 1.0) {
    result.warnings.push_back(
        "the projection is uncertain by " + formatFixed(uncertainty.rms_px, 1) +
        " px: add views with the board tilted, and in all parts of the image");
  }
  if (richer) {
    const ProjectionField bias =
        projectionDifference(*lens, *richer->state.lenses[0], input.image_size);
    result.bias_rms_px = bias.rms_px;
    result.bias_against = describeStructure(richer->structure);
    notes["bias_rms_px"] = formatFixed(bias.rms_px, 4);
    notes["bias_against"] = result.bias_against;
    if (bias.rms_px > 2.0 * uncertainty.rms_px + 1e-3) {
      result.warnings.push_back(
          "the model's bias exceeds its uncertainty: " + describeStructure(richer->structure) +
          " differs by " + formatFixed(bias.rms_px, 3) + " px RMS, noise explains " +
          formatFixed(uncertainty.rms_px, 3) + " px");
    }
  }
  notes["structure"] = describeStructure(fit.structure);
  if (selection.candidates.size() > 1 && selection.holdout_rms_px) {
    notes["selection"] = "simplest within 0.3 % of the least held-out error among " +
                         std::to_string(selection.candidates.size()) +
                         " structures; holdout_rms_px is the chosen one's over the same folds";
  }
  if (input.warp) {
    notes["board_warp"] = formatNumber(fit.state.warp[0]) + " " + formatNumber(fit.state.warp[1]);
  }
  if (options.folds > 0 || selection.holdout_rms_px) {
    notes["folds"] = std::to_string(options.folds > 0 ? options.folds : kDefaultFolds);
  }

  LensFile& file = result.file;
  file.image_size = input.image_size;
  file.lens = lens;
  file.covariance = covariance;
  file.calibration.rms_px = result.rms_px;
  file.calibration.holdout_rms_px = result.holdout_rms_px;
  file.calibration.views = static_cast<int>(input.corners.size());
  file.calibration.points = result.points;
  file.calibration.date = currentDate();
  return result;
}

namespace {

CalibrationResult calibrateInUnit(const Detections& detections, const CalibrationOptions& options) {
  const auto& names = lensModelNames();
  if (!options.structure && options.model != "auto" &&
      std::find(names.begin(), names.end(), options.model) == names.end()) {
    throw Error("unknown lens model '" + options.model + "'");
  }
  if (options.structure) checkStructure(*options.structure);
  if (options.folds < 0 || options.folds == 1) throw Error("folds must be 0 or at least 2");
  if (options.folds > static_cast<int>(detections.views.size())) {
    throw Error(std::to_string(options.folds) + " folds of " +
                std::to_string(detections.views.size()) +
                " views, expected at most as many folds as views");
  }
  const auto report = [&](double fraction, const char* stage) {
    if (options.progress) options.progress(fraction, stage);
  };
  report(0.0, "finding a first lens");
  Prepared prepared = prepareViews(detections, options.board_warp);
  Fit first = agreedFirstFit(prepared, options);
  if (hasStage(detections)) first = joinByStage(detections, prepared, first);
  FitInput& input = prepared.input;
  report(0.2, "choosing the lens model");

  // What no structure can mend is told before any choice.
  const auto views = bundleViews(input);
  const BundleOptions free = input.freedom();
  refuseUndetermined(input, first.state, *first.state.lenses[0],
                     lensCovariance(views, free, first.state, first.loss_px, 0, kDoubtSigmaPx),
                     input.image_size);

  const Selection selection = selectStructure(input, first, options);
  const Fit& fit = selection.fit;
  const Eigen::MatrixXd covariance = lensCovariance(views, free, fit.state, fit.loss_px, 0);
  refuseUndetermined(input, fit.state, *fit.state.lenses[0],
                     lensCovariance(views, free, fit.state, fit.loss_px, 0, kDoubtSigmaPx),
                     input.image_size);

  report(0.96, "estimating uncertainty");
  // The next richer model tells what the chosen one cannot say.
  const auto compared = refit(input, fit, richerThan(fit.structure), kTrialTolerance);
  CalibrationResult result = assembleResult(prepared, selection, options, covariance, compared);
  if (input.stage) {
    const StageResult stage = judgeStage(input, fit, result.warnings);
    result.file.stage_axis = stage.axis;
    auto& notes = result.file.calibration.notes;
    notes["stage_axis_sigma_rad"] = formatNumber(stage.axis_sigma_rad);
    notes["stage_scale"] = formatNumber(stage.scale);
    notes["stage_scale_sigma"] = formatNumber(stage.scale_sigma);
    result.stage = stage;
  }
  report(1.0, "estimating uncertainty");
  return result;
}

}  // namespace
}  // namespace calibration

CalibrationResult calibrate(const Detections& detections, const CalibrationOptions& options) {
  const double unit = calibration::fittingUnit({&detections});
  CalibrationResult result =
      calibration::calibrateInUnit(calibration::inUnit(detections, unit), options);
  calibration::fromUnit(result, unit);
  return result;
}

}  // namespace omnister
