// SPDX-License-Identifier: Apache-2.0
#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <map>

#include "calibration/board/board_scale.h"
#include "calibration/board/calibration_steps.h"
#include "calibration/fit/board_turns.h"
#include "calibration/uncertainty/covariance.h"
#include "omnister/calibration/uncertainty.h"
#include "omnister/common/error.h"
#include "omnister/common/parallel.h"

namespace omnister {

namespace {

using namespace calibration;

/// Pairs needed to tell a rigid pose from chance.
constexpr std::size_t kFewestPairs = 3;

double median(std::vector<double> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

double rotationBetween(const Pose& a, const Pose& b) {
  return Eigen::AngleAxisd(a.linear().transpose() * b.linear()).angle();
}

/// One camera fitted by itself.
struct Single {
  Prepared prepared;
  Selection selection;
  std::map<int, std::size_t> place;  ///< view of the detections to view of the input
  std::string bias_warning;          ///< empty where noise explains what a richer lens would change
};

Single fitAlone(const Detections& detections, const Board& board, const CalibrationOptions& options,
                const char* side) {
  try {
    Single single;
    single.prepared = prepareViews(detections, options.board_warp, &board);
    const Fit first = agreedFirstFit(single.prepared, options);
    single.selection = selectStructure(single.prepared.input, first, options);
    const auto& index = single.prepared.input.index;
    for (std::size_t i = 0; i < index.size(); ++i) single.place[index[i]] = i;
    const FitInput& input = single.prepared.input;
    const Fit& fit = single.selection.fit;
    const LensModel& lens = *fit.state.lenses[0];
    if (const auto richer = refit(input, fit, richerThan(fit.structure))) {
      const Eigen::MatrixXd covariance =
          lensCovariance(bundleViews(input), input.freedom(), fit.state, fit.loss_px, 0);
      const double noise = projectionUncertainty(lens, covariance, input.image_size, 24).rms_px;
      const double bias =
          projectionDifference(lens, *richer->state.lenses[0], input.image_size, 24).rms_px;
      if (bias > 2.0 * noise + 1e-3) {
        single.bias_warning =
            "the model's bias exceeds its uncertainty: " + describeStructure(richer->structure) +
            " differs by " + formatFixed(bias, 3) + " px RMS, noise explains " +
            formatFixed(noise, 3) + " px";
      }
    }
    return single;
  } catch (const ContradictionError& error) {
    throw ContradictionError(std::string(side) + " camera: " + error.what());
  } catch (const Error& error) {
    throw Error(std::string(side) + " camera: " + error.what());
  }
}

/// A pair seen by both cameras.
struct Pair {
  int view = 0;          ///< in the detections
  std::size_t left = 0;  ///< place in the left input
  std::size_t right = 0;
  Pose T_left_right;
};

/// Two cameras never see a board at the same pixels: who gives one camera's images twice gets a rig
/// without a baseline.
void refuseSameCamera(const Detections& left, const Detections& right) {
  std::size_t both = 0;
  std::size_t same = 0;
  for (std::size_t i = 0; i < std::min(left.views.size(), right.views.size()); ++i) {
    const ViewDetections& l = left.views[i];
    const ViewDetections& r = right.views[i];
    if (l.pixels.size() < 4 || r.pixels.size() < 4) continue;
    ++both;
    // Copies that were stored anew have their corners a hundredth of a pixel off.
    std::size_t shared = 0;
    double squares = 0.0;
    for (std::size_t a = 0; a < l.pixels.size(); ++a) {
      for (std::size_t b = 0; b < r.pixels.size(); ++b) {
        if (l.points[a] != r.points[b]) continue;
        squares += (l.pixels[a] - r.pixels[b]).squaredNorm();
        ++shared;
        break;
      }
    }
    same += shared >= 4 && std::sqrt(squares / static_cast<double>(shared)) < 0.3;
  }
  if (both >= 2 && 2 * same > both) {
    throw Error("left and right show the board at the same pixels in " + std::to_string(same) +
                " of " + std::to_string(both) +
                " pairs: these are one camera's images twice, expected those of two cameras");
  }
}

/// Where a symmetric board was numbered from another end by the right camera, numbers it as the
/// left one does: the pose between the cameras must be the same for all pairs.
void numberAlike(const Board& board, const Single& left, Single& right, std::vector<Pair>& pairs) {
  std::vector<TurnedAnswers> views;
  for (const Pair& pair : pairs) {
    const auto& corners = right.prepared.input.corners[pair.right];
    TurnedAnswers& view = views.emplace_back();
    view.turns = turnsOf(corners, board);
    for (const int turn : view.turns) {
      std::vector<Corner> none;
      Pose pose = right.selection.fit.state.poses[pair.right];
      turnBoard(turn, board, none, pose);
      view.answers.push_back(left.selection.fit.state.poses[pair.left] * pose.inverse());
    }
  }
  const std::vector<int> turns = agreeingTurns(views, board.half.norm());
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    if (turns[i] == 0) continue;
    Pose& pose = right.selection.fit.state.poses[pairs[i].right];
    turnBoard(turns[i], board, right.prepared.input.corners[pairs[i].right], pose);
    pairs[i].T_left_right = left.selection.fit.state.poses[pairs[i].left] * pose.inverse();
  }
}

StereoCalibrationResult calibrateInUnit(const Detections& left, const Detections& right,
                                        const CalibrationOptions& options) {
  if (left.views.size() != right.views.size()) {
    throw Error("the left camera has " + std::to_string(left.views.size()) +
                " views, the right one " + std::to_string(right.views.size()) + "; expected pairs");
  }
  const auto report = [&](double fraction, const char* stage) {
    if (options.progress) options.progress(fraction, stage);
  };
  CalibrationOptions quiet = options;
  quiet.progress = {};
  report(0.0, "fitting either camera by itself");
  // One board for both, though either camera may have seen only a part of it.
  std::vector<ViewDetections> all_views = left.views;
  all_views.insert(all_views.end(), right.views.begin(), right.views.end());
  const Board board = makeBoard(all_views);
  Single l = fitAlone(left, board, quiet, "left");
  report(0.4, "fitting either camera by itself");
  Single r = fitAlone(right, board, quiet, "right");
  report(0.8, "joining the cameras");

  std::vector<Pair> pairs;
  for (const auto& [view, place] : l.place) {
    const auto other = r.place.find(view);
    if (other == r.place.end()) continue;
    Pair pair;
    pair.view = view;
    pair.left = place;
    pair.right = other->second;
    pair.T_left_right =
        l.selection.fit.state.poses[pair.left] * r.selection.fit.state.poses[pair.right].inverse();
    pairs.push_back(pair);
  }
  if (pairs.size() < kFewestPairs) {
    throw Error("only " + std::to_string(pairs.size()) +
                " pairs have the board in both images, at least 3 are needed");
  }

  numberAlike(board, l, r, pairs);

  // The pair whose pose is nearest to all others starts the joint fit: a median that outliers
  // cannot move.
  const double scale = board.half.norm();
  std::size_t center = 0;
  double least = HUGE_VAL;
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    double sum = 0.0;
    for (const Pair& pair : pairs) {
      const double distance =
          rotationBetween(pairs[i].T_left_right, pair.T_left_right) +
          (pairs[i].T_left_right.translation() - pair.T_left_right.translation()).norm() / scale;
      sum += std::min(distance, 1.0);
    }
    if (sum < least) {
      least = sum;
      center = i;
    }
  }

  StereoCalibrationResult result;
  BundleState state;
  state.lenses = {l.selection.fit.state.lenses[0], r.selection.fit.state.lenses[0]};
  state.warp = l.selection.fit.state.warp;
  state.T_right_left = pairs[center].T_left_right.inverse();
  // One pose a board: pairs first, then boards that only one camera saw, which still tell of its
  // lens.
  struct SeenBoard {
    int view;
    std::optional<std::size_t> left, right;
  };
  std::vector<SeenBoard> boards;
  for (const Pair& pair : pairs) boards.push_back({pair.view, pair.left, pair.right});
  for (const auto& [view, place] : l.place) {
    if (r.place.count(view) == 0) boards.push_back({view, place, std::nullopt});
  }
  for (const auto& [view, place] : r.place) {
    if (l.place.count(view) == 0) boards.push_back({view, std::nullopt, place});
  }
  for (const SeenBoard& b : boards) {
    state.poses.push_back(b.left
                              ? l.selection.fit.state.poses[*b.left]
                              : pairs[center].T_left_right * r.selection.fit.state.poses[*b.right]);
  }

  const auto viewsOf = [&](std::size_t index) {
    std::vector<BundleView> views;
    BundleView view;
    view.pose = static_cast<int>(index);
    if (boards[index].left) {
      view.camera = 0;
      view.corners = &l.prepared.input.corners[*boards[index].left];
      views.push_back(view);
    }
    if (boards[index].right) {
      view.camera = 1;
      view.corners = &r.prepared.input.corners[*boards[index].right];
      views.push_back(view);
    }
    return views;
  };
  std::vector<bool> used(boards.size(), true);
  std::vector<std::string> reasons(boards.size());
  const auto allViews = [&] {
    std::vector<BundleView> views;
    for (std::size_t i = 0; i < boards.size(); ++i) {
      if (!used[i]) continue;
      for (const BundleView& view : viewsOf(i)) views.push_back(view);
    }
    return views;
  };
  const auto boardResiduals = [&](std::size_t index) {
    std::vector<std::vector<Eigen::Vector2d>> residuals;
    for (const BundleView& view : viewsOf(index)) residuals.push_back(residualsOf(view, state));
    return residuals;
  };

  const double alone = std::max(l.selection.fit.sigma_px, r.selection.fit.sigma_px);
  BundleOptions bundle;
  bundle.warp = options.board_warp;
  bundle.rig = true;
  double sigma = std::max(alone, 0.01);
  double loss = 0.0;
  for (int round = 0; round < 4; ++round) {
    // First only the pose between the cameras moves; then pairs that contradict it are named and
    // left out; then everything moves.
    bundle.lens = round > 0;
    bundle.warp = options.board_warp && round > 0;
    loss = std::max(3.0 * sigma * (round == 0 ? 4.0 : 1.0), 0.01);
    bundle.loss_px = loss;
    bundle.tolerance = round < 2 ? 1e-6 : 1e-10;
    if (!adjust(allViews(), bundle, state)) {
      throw Error("the joint adjustment of both cameras did not converge on these pairs");
    }
    std::vector<std::vector<Eigen::Vector2d>> residuals;
    for (const BundleView& view : allViews()) residuals.push_back(residualsOf(view, state));
    sigma = std::max(statisticsOf(residuals).sigma_px, 1e-4);
    if (round == 3) break;
    std::vector<double> pair_rms;
    for (std::size_t i = 0; i < pairs.size(); ++i) {
      if (!used[i]) {
        // A pair once left out is judged again by the pose that the others found.
        refinePose(viewsOf(i), loss, state);
      }
      pair_rms.push_back(statisticsOf(boardResiduals(i)).rms_px);
    }
    const double typical = median(pair_rms);
    for (std::size_t i = 0; i < pairs.size(); ++i) {
      const auto each = boardResiduals(i);
      // Both cameras see the board well by themselves, yet not at one place: the rig moved, or the
      // two images are not of one instant.
      const double limit = (round == 0 ? 4.0 : 2.5) * typical + 0.02;
      used[i] = pair_rms[i] <= limit;
      reasons[i] = used[i] ? ""
                           : "the pair is " + formatFixed(pair_rms[i], 2) +
                                 " px off the pose between the "
                                 "cameras that the others agree on (" +
                                 formatFixed(typical, 2) + " px)";
    }
    const auto kept =
        std::count(used.begin(), used.begin() + static_cast<std::ptrdiff_t>(pairs.size()), true);
    if (kept < static_cast<long>(kFewestPairs) || kept * 2 < static_cast<long>(pairs.size())) {
      throw Error(
          "only " + std::to_string(kept) + " of " + std::to_string(pairs.size()) +
          " pairs agree on one pose between the cameras; were the images of each pair taken at "
          "one instant, and is the rig rigid?");
    }
  }

  // A robust fit may serve one camera and give up the other: the pairs as wholes tell.
  std::vector<double> pair_rms;
  for (std::size_t i = 0; i < pairs.size(); ++i)
    pair_rms.push_back(statisticsOf(boardResiduals(i)).rms_px);
  const double typical_pair = median(pair_rms);
  if (typical_pair > 5.0 * alone + 1.0) {
    throw Error("no pairs agree on one pose between the cameras: together they fit to " +
                formatFixed(typical_pair, 1) + " px, each camera by itself to " +
                formatFixed(alone, 2) + " px; are left and right images in the same order?");
  }

  // Either camera's result, with the joint figures.
  const auto finish = [&](Single& single, int camera, const Eigen::MatrixXd& covariance) {
    FitInput& input = single.prepared.input;
    Selection selection = single.selection;
    std::vector<std::size_t> kept;
    std::vector<Pose> poses;
    for (std::size_t i = 0; i < boards.size(); ++i) {
      const auto& place = camera == 0 ? boards[i].left : boards[i].right;
      if (!place) continue;
      if (!used[i]) {
        ViewResult& view = single.prepared.views[static_cast<std::size_t>(boards[i].view)];
        view.used = false;
        view.reason = reasons[i];
        continue;
      }
      kept.push_back(i);
    }
    std::sort(kept.begin(), kept.end(),
              [&](std::size_t a, std::size_t b) { return boards[a].view < boards[b].view; });
    FitInput joined = input;
    joined.names.clear();
    joined.index.clear();
    joined.corners.clear();
    for (const std::size_t i : kept) {
      const std::size_t place = camera == 0 ? *boards[i].left : *boards[i].right;
      joined.names.push_back(input.names[place]);
      joined.index.push_back(boards[i].view);
      joined.corners.push_back(input.corners[place]);
      poses.push_back(camera == 0 ? state.poses[i] : state.T_right_left * state.poses[i]);
    }
    joined.separate();
    input = std::move(joined);
    selection.fit.state.lenses = {state.lenses[static_cast<std::size_t>(camera)]};
    selection.fit.state.poses = std::move(poses);
    selection.fit.state.warp = state.warp;
    const double outermost = outermostAngle(input, selection.fit.state, sigma);
    const double field = std::max(1.05 * outermost, 1e-3);
    selection.fit.state.lenses[0] = withField(selection.fit.state.lenses[0], std::min(field, 3.12));
    refuseUndetermined(input, selection.fit.state, *selection.fit.state.lenses[0], covariance,
                       input.image_size);
    CalibrationResult camera_result =
        assembleResult(single.prepared, selection, options, covariance, std::nullopt);
    if (!single.bias_warning.empty()) camera_result.warnings.push_back(single.bias_warning);
    camera_result.file.camera_name = camera == 0 ? "left" : "right";
    return camera_result;
  };
  const std::vector<BundleView> joint = allViews();
  const std::array<Eigen::MatrixXd, 2> covariances = {
      lensCovariance(joint, bundle, state, loss, 0), lensCovariance(joint, bundle, state, loss, 1)};
  result.left = finish(l, 0, covariances[0]);
  result.right = finish(r, 1, covariances[1]);
  result.T_left_right = state.T_right_left.inverse();
  double squares = 0.0;
  double count = 0.0;
  for (const CalibrationResult* camera : {&result.left, &result.right}) {
    squares += camera->rms_px * camera->rms_px * camera->points;
    count += camera->points;
  }
  result.rms_px = std::sqrt(squares / count);
  if (options.folds > 0) {
    struct Sum {
      double squares = 0.0;
      double count = 0.0;
      bool failed = false;
    };
    std::vector<Sum> sums(static_cast<std::size_t>(options.folds));
    parallelFor(0, sums.size(), options.threads, [&](std::size_t fold) {
      std::vector<BundleView> known;
      std::vector<std::size_t> unseen;
      for (std::size_t i = 0; i < boards.size(); ++i) {
        if (!used[i]) continue;
        const bool held_out = boards[i].view % options.folds == static_cast<int>(fold);
        if (held_out && i < pairs.size()) unseen.push_back(i);
        if (held_out) continue;
        for (const BundleView& view : viewsOf(i)) known.push_back(view);
      }
      if (unseen.empty()) return;
      BundleState without = state;
      BundleOptions refit_options = bundle;
      refit_options.tolerance = 1e-8;
      if (!adjust(known, refit_options, without)) {
        sums[fold].failed = true;
        return;
      }
      for (const std::size_t i : unseen) {
        const std::vector<BundleView> pair = viewsOf(i);
        refinePose(pair, 0.0, without);
        for (const BundleView& view : pair) {
          for (const Eigen::Vector2d& residual : residualsOf(view, without)) {
            sums[fold].squares += residual.squaredNorm();
            sums[fold].count += 1.0;
          }
        }
      }
    });
    Sum total;
    for (const Sum& sum : sums) {
      total.squares += sum.squares;
      total.count += sum.count;
      total.failed = total.failed || sum.failed;
    }
    if (!total.failed && total.count > 0.0) {
      result.holdout_rms_px = std::sqrt(total.squares / total.count);
    }
  }
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    if (used[i]) continue;
    result.warnings.push_back("pair '" + left.views[static_cast<std::size_t>(boards[i].view)].name +
                              "' and '" +
                              right.views[static_cast<std::size_t>(boards[i].view)].name +
                              "' is not used: " + reasons[i]);
  }
  for (const auto& [camera, side] :
       {std::pair(&result.left, "left: "), std::pair(&result.right, "right: ")}) {
    for (const std::string& warning : camera->warnings) result.warnings.push_back(side + warning);
  }
  const double baseline = result.T_left_right.translation().norm();
  if (baseline < 1e-3 * board.half.norm() &&
      Eigen::AngleAxisd(result.T_left_right.linear()).angle() < 1e-3) {
    throw Error(
        "both cameras come out in one place, looking one way: left and right seem to be images of "
        "one camera, expected those of two");
  }
  if (sigma > 1.5 * alone + 0.01) {
    result.warnings.push_back(
        "the cameras together fit " + formatFixed(sigma / std::max(alone, 1e-6), 1) +
        " times worse than each by itself: the rig is not quite rigid, or the "
        "images of a pair are not of one instant");
  }
  report(1.0, "joining the cameras");
  return result;
}

}  // namespace

StereoCalibrationResult calibrateStereo(const Detections& left, const Detections& right,
                                        const CalibrationOptions& options) {
  refuseSameCamera(left, right);
  const double unit = fittingUnit({&left, &right});
  StereoCalibrationResult result =
      calibrateInUnit(inUnit(left, unit), inUnit(right, unit), options);
  fromUnit(result.left, unit);
  fromUnit(result.right, unit);
  result.T_left_right.translation() *= unit;
  return result;
}

}  // namespace omnister
