// SPDX-License-Identifier: Apache-2.0
#include "calibration/board/stage_views.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <tuple>

#include "calibration/fit/board_turns.h"
#include "calibration/uncertainty/covariance.h"
#include "omnister/common/error.h"
#include "omnister/common/numbers.h"

namespace omnister::calibration {

namespace {

/// Pairs of views that may tell the axis at the start; more would only take time.
constexpr std::size_t kMostPairs = 600;
/// A stage whose unit differs from the board's by more than this is not in metres.
constexpr double kLargestScaleError = 0.1;
/// Steps between lengths that no ruler tells apart are not remarked upon.
constexpr double kScaleRemark = 5e-4;

/// Positions closer than this part of the board's size are one.
constexpr double kSamePosition = 1e-6;

double medianOf(std::vector<double> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

std::string hundredths(double value) { return formatNumber(std::round(100.0 * value) / 100.0); }

std::string percent(double ratio) { return formatNumber(std::round(1e4 * ratio) / 1e2) + " %"; }

/// The way of the camera for one unit of travel by the poses of single views: the answer of the
/// pair of views that is nearest to those of all others, a median that outliers cannot move.
Eigen::Vector3d axisOfPairs(const std::vector<std::vector<std::size_t>>& placements,
                            const std::vector<double>& travel, const std::vector<Pose>& poses) {
  std::vector<Eigen::Vector3d> answers;
  for (const auto& views : placements) {
    double low = HUGE_VAL;
    double high = -HUGE_VAL;
    for (const std::size_t i : views) {
      low = std::min(low, travel[i]);
      high = std::max(high, travel[i]);
    }
    for (std::size_t a = 0; a < views.size(); ++a) {
      for (std::size_t b = 0; b < a; ++b) {
        const double step = travel[views[a]] - travel[views[b]];
        if (!(high > low) || std::abs(step) < 0.5 * (high - low)) continue;
        answers.emplace_back((poses[views[b]].translation() - poses[views[a]].translation()) /
                             step);
      }
    }
  }
  const std::size_t stride = answers.size() / kMostPairs + 1;
  double least = HUGE_VAL;
  Eigen::Vector3d axis = answers.front();
  for (std::size_t i = 0; i < answers.size(); i += stride) {
    double sum = 0.0;
    for (std::size_t k = 0; k < answers.size(); k += stride) {
      sum += std::min(1.0, (answers[i] - answers[k]).norm());
    }
    if (sum < least) {
      least = sum;
      axis = answers[i];
    }
  }
  return axis;
}

[[noreturn]] void refuseUnits(double scale) {
  throw Error("by the board the camera moved " + formatNumber(std::round(scale * 1e4) / 1e4) +
              " times as far as the stage positions say: are both in metres?");
}

/// A stage does not turn the camera: where a symmetric board was numbered from different ends in
/// views of one placement, numbers it alike.
Fit numberedAlike(const Fit& alone, const std::vector<std::vector<std::size_t>>& placements,
                  FitInput& input) {
  Fit fit = alone;
  for (const auto& placement : placements) {
    std::vector<TurnedAnswers> views;
    for (const std::size_t i : placement) {
      TurnedAnswers& view = views.emplace_back();
      view.turns = turnsOf(input.corners[i], input.board);
      for (const int turn : view.turns) {
        std::vector<Corner> none;
        Pose pose = fit.state.poses[i];
        turnBoard(turn, input.board, none, pose);
        pose.translation().setZero();
        view.answers.push_back(pose);
      }
    }
    const std::vector<int> turns = agreeingTurns(views, 1.0);
    for (std::size_t k = 0; k < placement.size(); ++k) {
      const std::size_t i = placement[k];
      if (turns[k] != 0) {
        turnBoard(turns[k], input.board, input.corners[i], fit.state.poses[i]);
      }
    }
  }
  return fit;
}

/// Length of a free axis and its standard deviation.
std::pair<double, double> scaleOf(const FitInput& input, const BundleState& state, double loss_px) {
  BundleOptions options = input.freedom();
  options.axis_length = true;
  const Eigen::MatrixXd covariance = sharedCovariance(bundleViews(input), options, state, loss_px);
  const Eigen::Vector3d direction = state.axis.normalized();
  const double variance = direction.dot(covariance.bottomRightCorner<3, 3>() * direction);
  return {state.axis.norm(), std::sqrt(std::max(0.0, variance))};
}

}  // namespace

bool hasStage(const Detections& detections) {
  return std::any_of(detections.views.begin(), detections.views.end(),
                     [](const ViewDetections& view) { return view.stage.has_value(); });
}

Fit joinByStage(const Detections& detections, Prepared& prepared, const Fit& alone) {
  FitInput& input = prepared.input;
  const double same = kSamePosition * input.board.half.norm();
  std::map<std::string, std::vector<std::size_t>> by_board;
  std::vector<double> travel(input.corners.size(), 0.0);
  std::optional<double> origin;
  for (std::size_t i = 0; i < input.corners.size(); ++i) {
    const auto& stage = detections.views[static_cast<std::size_t>(input.index[i])].stage;
    if (!stage) continue;
    if (!origin) origin = stage->position_m;
    travel[i] = stage->position_m - *origin;
    by_board[stage->board].push_back(i);
  }
  std::vector<std::vector<std::size_t>> placements;
  bool moved = false;
  for (const auto& [board, views] : by_board) {
    placements.push_back(views);
    for (const std::size_t i : views) {
      moved = moved || std::abs(travel[i] - travel[views.front()]) > same;
    }
  }
  if (!moved) {
    throw Error(
        "no placement of the board is seen from two different stage positions, so the stage tells "
        "nothing; leave the board where it is while the stage moves");
  }

  const Fit first = numberedAlike(alone, placements, input);
  const Eigen::Vector3d axis = axisOfPairs(placements, travel, first.state.poses);
  // Boards square to the axis leave the scale along it open in single views, so only what no such
  // scale explains is refused here.
  if (!(axis.norm() > 0.1 && axis.norm() < 10.0)) refuseUnits(axis.norm());

  Fit fit = first;
  fit.state.axis = axis;
  fit.state.poses.clear();
  input.stage = true;
  input.travel = travel;
  std::vector<bool> placed(input.corners.size(), false);
  for (const auto& views : placements) {
    // Where the board stood when the stage was at its origin, by the view nearest to the median.
    Eigen::Vector3d middle;
    const auto placeOf = [&](std::size_t i) -> Eigen::Vector3d {
      return first.state.poses[i].translation() + travel[i] * axis;
    };
    for (int k = 0; k < 3; ++k) {
      std::vector<double> values;
      for (const std::size_t i : views) values.push_back(placeOf(i)[k]);
      middle[k] = medianOf(values);
    }
    const std::size_t nearest =
        *std::min_element(views.begin(), views.end(), [&](std::size_t a, std::size_t b) {
          return (placeOf(a) - middle).norm() < (placeOf(b) - middle).norm();
        });
    Pose pose = first.state.poses[nearest];
    pose.translation() = placeOf(nearest);
    for (const std::size_t i : views) {
      input.pose[i] = static_cast<int>(fit.state.poses.size());
      placed[i] = true;
    }
    fit.state.poses.push_back(pose);
  }
  const auto release = [&](std::size_t i) {
    input.pose[i] = static_cast<int>(fit.state.poses.size());
    input.travel[i] = 0.0;
    fit.state.poses.push_back(first.state.poses[i]);
    refinePose({bundleViews(input)[i]}, fit.loss_px, fit.state);
  };
  for (std::size_t i = 0; i < placed.size(); ++i) {
    if (!placed[i]) release(i);
  }

  const auto adjustOnce = [&](bool length, double tolerance) {
    // What was fitted before explains less now: the loss that this deserves.
    fit.sigma_px = std::max(statisticsOf(residualsOf(input, fit.state)).sigma_px, 1e-4);
    fit.loss_px = 3.0 * std::max(fit.sigma_px, 0.01);
    BundleOptions options = input.freedom();
    options.axis_length = length;
    options.warp = false;
    options.loss_px = fit.loss_px;
    options.max_iterations = 100;
    options.tolerance = tolerance;
    if (!adjust(bundleViews(input), options, fit.state)) {
      throw Error("the adjustment with the stage positions did not converge");
    }
  };
  // Once with the stage's unit free, to tell a wrong unit from a wrong lens.
  for (const double tolerance : {1e-5, 1e-6}) adjustOnce(true, tolerance);
  const auto [scale, scale_sigma] = scaleOf(input, fit.state, fit.loss_px);
  if (std::abs(scale - 1.0) > kLargestScaleError + 5.0 * scale_sigma) refuseUnits(scale);
  fit.state.axis.normalize();

  std::size_t told = 0;
  for (const auto& views : placements) told += views.size();
  std::size_t contradicting = 0;
  for (int round = 0; round < 4; ++round) {
    adjustOnce(false, round == 0 ? 1e-5 : 1e-8);
    if (round == 0) continue;
    const auto residuals = residualsOf(input, fit.state);
    std::vector<double> rms;
    for (const auto& view : residuals) rms.push_back(statisticsOf({view}).rms_px);
    const double typical = medianOf(rms);
    const double limit = (round == 1 ? 5.0 : 3.0) * typical + 0.02;
    bool changed = false;
    for (std::size_t i = 0; i < rms.size(); ++i) {
      if (!placed[i] || rms[i] <= limit) continue;
      // A few corners that fit nowhere are no fault of the stage.
      if (statisticsOf({residuals[i]}).median_px < 0.5 * limit) continue;
      placed[i] = false;
      changed = true;
      ++contradicting;
      prepared.warnings.push_back("view '" + input.names[i] + "' is " + hundredths(rms[i]) +
                                  " px off where its stage position puts it (" +
                                  hundredths(typical) +
                                  " px is typical), so the board has a pose of its own there");
      release(i);
    }
    if (round > 1 && !changed) break;
  }
  if (2 * contradicting > told) {
    throw Error("only " + std::to_string(told - contradicting) + " of " + std::to_string(told) +
                " views agree with their stage positions; did the board stay where it was while "
                "the stage moved?");
  }
  fit.sigma_px = statisticsOf(residualsOf(input, fit.state)).sigma_px;
  return fit;
}

StageResult judgeStage(const FitInput& input, const Fit& fit, std::vector<std::string>& warnings) {
  const auto views = bundleViews(input);
  StageResult result;
  result.axis = fit.state.axis.normalized();
  const Eigen::MatrixXd fixed = sharedCovariance(views, input.freedom(), fit.state, fit.loss_px);
  result.axis_sigma_rad = std::sqrt(std::max(0.0, fixed.bottomRightCorner<2, 2>().trace()));
  std::vector<int> sharing(fit.state.poses.size(), 0);
  for (const int pose : input.pose) ++sharing[static_cast<std::size_t>(pose)];
  for (const int count : sharing) {
    if (count < 2) continue;
    result.boards += 1;
    result.views += count;
  }
  BundleOptions options = input.freedom();
  options.axis_length = true;
  options.loss_px = fit.loss_px;
  BundleState state = fit.state;
  if (!adjust(views, options, state)) return result;
  std::tie(result.scale, result.scale_sigma) = scaleOf(input, state, fit.loss_px);
  const double error = std::abs(result.scale - 1.0);
  if (error > 4.0 * result.scale_sigma && error > kScaleRemark) {
    warnings.push_back("by the board the camera moved " + percent(result.scale) +
                       " of what the stage positions say (known to " + percent(result.scale_sigma) +
                       "): the board's squares or the stage's steps are not of the length given");
  }
  return result;
}

}  // namespace omnister::calibration
