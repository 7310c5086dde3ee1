// SPDX-License-Identifier: Apache-2.0
#include "calibration/agreement/view_agreement.h"

#include <Eigen/Dense>
#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <numeric>
#include <optional>
#include <random>
#include <utility>

#include "calibration/fit/start.h"
#include "omnister/common/parallel.h"
#include "omnister/common/text.h"

namespace omnister::calibration {
namespace {

constexpr std::size_t kFewestViews = 3;
/// A view speaks against the common lens where another centre and scale would lower its RMS by this
/// factor, and by more than the corners' scatter explains.
constexpr double kSpeaksAgainst = 1.25;
constexpr double kLeastF = 6.0;
/// So much better lenses of their own must be for a split to count.
constexpr double kSplitGain = 1.3;

double medianOf(std::vector<double> values) {
  if (values.empty()) return 0.0;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// The centre and scale that one view would like beside those of the lens, its pose free.
struct Wish {
  Eigen::Vector3d change = Eigen::Vector3d::Zero();  ///< centre [px], log of the scale
  Eigen::Matrix3d weight = Eigen::Matrix3d::Zero();  ///< its information, in 1/px^2
  bool against = false;
};

Wish wishOf(const BundleView& view, const BundleState& state) {
  const LensModel& lens = *state.lenses[0];
  const auto& corners = *view.corners;
  const auto count = static_cast<Eigen::Index>(corners.size());
  Eigen::MatrixXd slope = Eigen::MatrixXd::Zero(2 * count, 9);
  Eigen::VectorXd residual = Eigen::VectorXd::Zero(2 * count);
  Eigen::Index rows = 0;
  for (const Corner& corner : corners) {
    const Eigen::Vector3d X = cornerInCamera(view, state, corner);
    Jacobian23 jacobian;
    const auto pixel = projectContinued(lens, X, &jacobian);
    if (!pixel) continue;
    Eigen::Matrix3d cross;
    cross << 0, -X.z(), X.y(), X.z(), 0, -X.x(), -X.y(), X.x(), 0;
    slope.block<2, 3>(rows, 0) = -jacobian * cross;
    slope.block<2, 3>(rows, 3) = jacobian;
    slope.block<2, 2>(rows, 6).setIdentity();
    slope.block<2, 1>(rows, 8) = *pixel - lens.center();
    residual.segment<2>(rows) = corner.pixel - *pixel;
    rows += 2;
  }
  Wish wish;
  if (rows < 16) return wish;
  const Eigen::MatrixXd J = slope.topRows(rows);
  const Eigen::VectorXd r = residual.head(rows);
  // Board and pixels have units of their own: columns of length one.
  Eigen::VectorXd scale = J.colwise().norm().transpose().cwiseMax(1e-12);
  const Eigen::MatrixXd unit = J * scale.cwiseInverse().asDiagonal();
  Eigen::MatrixXd normal = unit.transpose() * unit;
  normal.diagonal().array() += 1e-9;
  const Eigen::LDLT<Eigen::MatrixXd> pose(normal.topLeftCorner<6, 6>());
  const Eigen::MatrixXd across = normal.topRightCorner<6, 3>();
  const Eigen::VectorXd right = unit.transpose() * r;
  const Eigen::Matrix3d reduced =
      normal.bottomRightCorner<3, 3>() - across.transpose() * pose.solve(across);
  const Eigen::Vector3d reduced_right =
      right.tail<3>() - across.transpose() * pose.solve(right.head<6>());
  const Eigen::Vector3d step = reduced.ldlt().solve(reduced_right);
  const double before = r.squaredNorm() - right.head<6>().dot(pose.solve(right.head<6>()));
  const double after = before - step.dot(reduced_right);
  const Eigen::Vector3d own = scale.tail<3>();
  wish.change = step.cwiseQuotient(own);
  wish.weight = own.asDiagonal() * reduced * own.asDiagonal();
  const double freedom = static_cast<double>(rows) - 9.0;
  if (step.allFinite() && after > 0.0 && freedom > 0.0) {
    const double F = (before - after) / 3.0 / (after / freedom);
    wish.against = F > kLeastF && before > kSpeaksAgainst * kSpeaksAgainst * after;
  }
  return wish;
}

std::vector<Wish> wishesOf(const FitInput& input, const Fit& fit) {
  std::vector<Wish> wishes;
  for (const BundleView& view : bundleViews(input)) wishes.push_back(wishOf(view, fit.state));
  return wishes;
}

bool suspicious(const std::vector<Wish>& wishes) {
  const auto against = static_cast<std::size_t>(
      std::count_if(wishes.begin(), wishes.end(), [](const Wish& wish) { return wish.against; }));
  return against >= kFewestViews && 8 * against >= wishes.size();
}

using Marks = std::vector<bool>;

/// Two groups of wishes (k-means with each wish's own weight); true: the second.
Marks twoGroups(const std::vector<Wish>& wishes) {
  const auto cost = [](const Wish& wish, const Eigen::Vector3d& mean) {
    const Eigen::Vector3d off = wish.change - mean;
    return off.dot(wish.weight * off);
  };
  Marks best(wishes.size(), false);
  double least = HUGE_VAL;
  const std::size_t stride = std::max<std::size_t>(1, wishes.size() / 12);
  for (std::size_t a = 0; a < wishes.size(); a += stride) {
    for (std::size_t b = a + stride; b < wishes.size(); b += stride) {
      std::array<Eigen::Vector3d, 2> means = {wishes[a].change, wishes[b].change};
      Marks marks(wishes.size(), false);
      double sum = 0.0;
      for (int round = 0; round < 10; ++round) {
        sum = 0.0;
        std::array<Eigen::Matrix3d, 2> weights = {Eigen::Matrix3d::Zero(), Eigen::Matrix3d::Zero()};
        std::array<Eigen::Vector3d, 2> sums = {Eigen::Vector3d::Zero(), Eigen::Vector3d::Zero()};
        for (std::size_t i = 0; i < wishes.size(); ++i) {
          const double first = cost(wishes[i], means[0]);
          const double second = cost(wishes[i], means[1]);
          marks[i] = second < first;
          sum += std::min(first, second);
          weights[marks[i]] += wishes[i].weight;
          sums[marks[i]] += wishes[i].weight * wishes[i].change;
        }
        for (std::size_t k = 0; k < 2; ++k) {
          if (weights[k].determinant() > 0.0) means[k] = weights[k].ldlt().solve(sums[k]);
        }
      }
      if (sum < least) {
        least = sum;
        best = marks;
      }
    }
  }
  return best;
}

Marks inverted(Marks marks) {
  marks.flip();
  return marks;
}

std::size_t countOf(const Marks& marks) {
  return static_cast<std::size_t>(std::count(marks.begin(), marks.end(), true));
}

LensStructure richStructure(std::size_t views) {
  LensStructure structure;
  structure.model = "asphere";
  structure.even_terms = views >= 6 ? 2 : 1;
  structure.decentring = views >= 6;
  structure.affinity = views >= 6;
  return structure;
}

/// RMS of one view with a lens that is given, its pose refitted.
double rmsUnder(const std::vector<Corner>& corners, const LensPtr& lens,
                const Eigen::Vector2d& warp) {
  std::vector<Eigen::Vector3d> bearings;
  std::vector<Corner> seen;
  for (const Corner& corner : corners) {
    if (const auto bearing = lens->unproject(corner.pixel)) {
      bearings.push_back(*bearing);
      seen.push_back(corner);
    }
  }
  const auto start = poseFromBearings(bearings, seen);
  if (!start) return HUGE_VAL;
  BundleState state;
  state.lenses = {lens};
  state.warp = warp;
  state.poses = {*start};
  BundleView view;
  view.corners = &corners;
  refinePose({view}, 2.0, state);
  return refinePose({view}, 0.0, state);
}

/// The same over some views: root of the mean square over corners, and by view.
std::vector<double> rmsUnder(const FitInput& input, const Fit& fit, int threads) {
  std::vector<double> rms(input.corners.size());
  parallelFor(0, rms.size(), threads, [&](std::size_t i) {
    rms[i] = rmsUnder(input.corners[i], fit.state.lenses[0], fit.state.warp);
  });
  return rms;
}

/// A lens for the marked views alone, by the rich structure.
std::optional<Fit> fitOf(const FitInput& input, const Marks& marks, const Fit& from) {
  const FitInput part = input.subset(marks);
  if (part.corners.size() < kFewestViews) return std::nullopt;
  return refit(part, from, richStructure(part.corners.size()), kTrialTolerance);
}

double rmsOf(const FitInput& input, const Marks& marks, const Fit& fit) {
  return statisticsOf(residualsOf(input.subset(marks), fit.state)).rms_px;
}

/// Whether lenses of their own serve both sets clearly better than the common one does, and neither
/// lens serves the other set.
bool contradict(const FitInput& input, const Marks& first, const Fit& a, const Marks& second,
                const Fit& b, double together_px, int threads) {
  const std::vector<double> under_a = rmsUnder(input, a, threads);
  const std::vector<double> under_b = rmsUnder(input, b, threads);
  double squares = 0.0;
  double corners = 0.0;
  std::size_t clear = 0;
  std::size_t all = 0;
  double typical = 0.0;
  {
    std::vector<double> own;
    for (std::size_t i = 0; i < first.size(); ++i) {
      if (first[i]) own.push_back(under_a[i]);
      if (second[i]) own.push_back(under_b[i]);
    }
    typical = medianOf(own);
  }
  for (std::size_t i = 0; i < first.size(); ++i) {
    if (!first[i] && !second[i]) continue;
    const double own = first[i] ? under_a[i] : under_b[i];
    const double other = first[i] ? under_b[i] : under_a[i];
    // A view that fits nowhere is no witness.
    if (own > 4.0 * typical) continue;
    const auto n = static_cast<double>(input.corners[i].size());
    squares += own * own * n;
    corners += n;
    ++all;
    clear += other > kSplitGain * own;
  }
  if (all == 0 || corners == 0.0) return false;
  const double apart_px = std::sqrt(squares / corners);
  return together_px > kSplitGain * apart_px && 10 * clear >= 7 * all;
}

struct Change {
  const char* name;
  bool mirror;
  Eigen::Vector2d (*pixel)(const Eigen::Vector2d&, const cv::Size&);
};

const std::array<Change, 5> kChanges = {{
    {"turned by 180 degrees", false,
     [](const Eigen::Vector2d& p, const cv::Size& s) {
       return Eigen::Vector2d(s.width - 1 - p.x(), s.height - 1 - p.y());
     }},
    {"mirrored left to right", true,
     [](const Eigen::Vector2d& p, const cv::Size& s) {
       return Eigen::Vector2d(s.width - 1 - p.x(), p.y());
     }},
    {"mirrored top to bottom", true,
     [](const Eigen::Vector2d& p, const cv::Size& s) {
       return Eigen::Vector2d(p.x(), s.height - 1 - p.y());
     }},
    {"turned by 90 degrees to the right", false,
     [](const Eigen::Vector2d& p, const cv::Size& s) {
       return Eigen::Vector2d(p.y(), s.width - 1 - p.x());
     }},
    {"turned by 90 degrees to the left", false,
     [](const Eigen::Vector2d& p, const cv::Size& s) {
       return Eigen::Vector2d(s.height - 1 - p.y(), p.x());
     }},
}};

/// What, done to the pictures of the views, lets the lens fit them as well as their own does.
std::string changeThatFits(const FitInput& input, const std::vector<std::size_t>& views,
                           const Fit& lens, double own_px) {
  std::string name;
  double least = 1.5 * own_px + 0.02;
  for (const Change& change : kChanges) {
    // A quarter turn keeps only square pictures.
    const bool quarter = std::string(change.name).find("90") != std::string::npos;
    if (quarter && input.image_size.width != input.image_size.height) continue;
    std::vector<double> rms;
    for (const std::size_t view : views) {
      std::vector<Corner> corners = input.corners[view];
      for (Corner& corner : corners) {
        corner.pixel = change.pixel(corner.pixel, input.image_size);
        if (change.mirror) corner.point.x() = -corner.point.x();
      }
      rms.push_back(rmsUnder(corners, lens.state.lenses[0], lens.state.warp));
    }
    // The first that fits is the likeliest, unless another fits clearly better.
    const double typical = medianOf(rms);
    if (typical < (name.empty() ? least : 0.8 * least)) {
      least = typical;
      name = change.name;
    }
  }
  return name;
}

ViewGroup groupOf(const FitInput& input, const Marks& marks, const Fit& fit) {
  ViewGroup group;
  for (std::size_t i = 0; i < marks.size(); ++i) {
    if (marks[i]) group.views.push_back(i);
  }
  group.rms_px = rmsOf(input, marks, fit);
  return group;
}

Agreement allAgree(std::size_t views, double rms_px) {
  Agreement agreement;
  ViewGroup& group = agreement.groups.emplace_back();
  group.views.resize(views);
  std::iota(group.views.begin(), group.views.end(), std::size_t{0});
  group.rms_px = rms_px;
  agreement.together_px = rms_px;
  return agreement;
}

/// Splits off what does not fit the fit of the rest, and again within each part.
void split(const FitInput& input, const Marks& part, const Fit& from, int depth, int threads,
           std::vector<std::pair<Marks, Fit>>& groups) {
  const auto common = fitOf(input, part, from);
  if (!common) return;
  const FitInput own = input.subset(part);
  const std::vector<Wish> wishes = wishesOf(own, *common);
  if (depth > 2 || own.corners.size() < 2 * kFewestViews || !suspicious(wishes)) {
    groups.emplace_back(part, *common);
    return;
  }
  std::vector<std::size_t> place;
  for (std::size_t i = 0; i < part.size(); ++i) {
    if (part[i]) place.push_back(i);
  }
  const double together_px = rmsOf(input, part, *common);
  Marks second(part.size(), false);
  const Marks guess = twoGroups(wishes);
  for (std::size_t i = 0; i < place.size(); ++i) second[place[i]] = guess[i];
  std::optional<Fit> a, b;
  Marks first;
  for (int round = 0; round < 5; ++round) {
    first = part;
    for (std::size_t i = 0; i < part.size(); ++i) first[i] = part[i] && !second[i];
    a = fitOf(input, first, *common);
    b = fitOf(input, second, *common);
    if (!a || !b) break;
    const std::vector<double> under_a = rmsUnder(input, *a, threads);
    const std::vector<double> under_b = rmsUnder(input, *b, threads);
    Marks next(part.size(), false);
    for (std::size_t i = 0; i < part.size(); ++i) next[i] = part[i] && under_b[i] < under_a[i];
    if (next == second) break;
    second = std::move(next);
  }
  if (!a || !b || countOf(first) < kFewestViews || countOf(second) < kFewestViews ||
      !contradict(input, first, *a, second, *b, together_px, threads)) {
    groups.emplace_back(part, *common);
    return;
  }
  split(input, first, *a, depth + 1, threads, groups);
  split(input, second, *b, depth + 1, threads, groups);
}

Agreement toldApart(const FitInput& input, std::vector<std::pair<Marks, Fit>> groups,
                    double together_px) {
  std::stable_sort(groups.begin(), groups.end(), [](const auto& a, const auto& b) {
    return countOf(a.first) > countOf(b.first);
  });
  Agreement agreement;
  agreement.together_px = together_px;
  for (const auto& [marks, fit] : groups) {
    ViewGroup group = groupOf(input, marks, fit);
    if (!agreement.groups.empty()) {
      group.change = changeThatFits(input, group.views, groups.front().second, group.rms_px);
    }
    agreement.groups.push_back(std::move(group));
  }
  return agreement;
}

}  // namespace

Agreement viewAgreement(const FitInput& input, const Fit& fit, int threads) {
  FitInput apart = input;
  apart.separate();
  const std::size_t views = apart.corners.size();
  if (views < 2 * kFewestViews || !suspicious(wishesOf(apart, fit))) {
    return allAgree(views, statisticsOf(residualsOf(apart, fit.state)).rms_px);
  }
  std::vector<std::pair<Marks, Fit>> groups;
  const Marks all(views, true);
  const auto common = fitOf(apart, all, fit);
  if (!common) return allAgree(views, fit.sigma_px);
  const double together_px = rmsOf(apart, all, *common);
  split(apart, all, *common, 0, threads, groups);
  std::size_t told = 0;
  for (const auto& group : groups) told += countOf(group.first);
  if (groups.size() < 2 || told < views) return allAgree(views, together_px);
  return toldApart(apart, std::move(groups), together_px);
}

Agreement agreementOfRest(const FitInput& input, const std::vector<bool>& kept, const Fit& fit,
                          int threads) {
  FitInput apart = input;
  apart.separate();
  const Marks rest = inverted(kept);
  FitInput others = apart.subset(rest);
  others.separate();
  const Agreement same = allAgree(input.corners.size(), fit.sigma_px);
  if (others.corners.size() < kFewestViews) return same;
  auto own = firstFit(others, threads, nullptr);
  if (!own) return same;
  if (auto richer = refit(others, *own, richStructure(others.corners.size()), kTrialTolerance)) {
    own = std::move(richer);
  }
  const double own_px = statisticsOf(residualsOf(others, own->state)).rms_px;
  const std::vector<double> under = rmsUnder(others, fit, threads);
  // As good as a picture lets corners be found, and much better than the others' lens.
  if (own_px > 2e-3 * std::hypot(input.image_size.width, input.image_size.height) ||
      medianOf(under) < 2.0 * kSplitGain * own_px) {
    return same;
  }
  Agreement agreement;
  agreement.together_px = medianOf(under);
  std::array<ViewGroup, 2> groups;
  for (std::size_t i = 0; i < kept.size(); ++i) groups[kept[i] ? 0 : 1].views.push_back(i);
  const FitInput first = apart.subset(kept);
  std::vector<double> own_first = rmsUnder(first, fit, threads);
  groups[0].rms_px = medianOf(own_first);
  groups[1].rms_px = own_px;
  groups[1].change = changeThatFits(apart, groups[1].views, fit, own_px);
  agreement.groups = {groups[0], groups[1]};
  return agreement;
}

Agreement viewAgreementFromFew(const FitInput& input, int threads) {
  constexpr std::size_t kFew = 5;
  constexpr int kTrials = 12;
  FitInput apart = input;
  apart.separate();
  const std::size_t views = apart.corners.size();
  if (views < 2 * kFewestViews) return allAgree(views, 0.0);
  const double good_px = 1e-3 * std::hypot(input.image_size.width, input.image_size.height);
  std::vector<std::pair<Marks, Fit>> groups;
  Marks left(views, true);
  std::mt19937 random(1);
  while (countOf(left) >= kFewestViews && groups.size() < 4) {
    std::vector<std::size_t> open;
    for (std::size_t i = 0; i < views; ++i) {
      if (left[i]) open.push_back(i);
    }
    Marks best(views, false);
    std::optional<Fit> best_fit;
    for (int trial = 0; trial < kTrials; ++trial) {
      Marks few(views, false);
      // Folders mix by turns or one after the other: every second, either half, then any.
      const std::size_t stride = trial == 0 ? 2 : 1;
      const std::size_t start = trial == 2 ? open.size() / 2 : 0;
      if (trial < 3) {
        for (std::size_t i = start; i < open.size() && countOf(few) < kFew; i += stride)
          few[open[i]] = true;
      } else {
        std::vector<std::size_t> shuffled = open;
        std::shuffle(shuffled.begin(), shuffled.end(), random);
        for (std::size_t i = 0; i < std::min(kFewestViews + 1, shuffled.size()); ++i)
          few[shuffled[i]] = true;
      }
      FitInput part = apart.subset(few);
      part.separate();
      if (part.corners.size() < kFewestViews) continue;
      auto fit = firstFit(part, threads, nullptr);
      if (!fit || fit->sigma_px > good_px) continue;
      const std::vector<double> under = rmsUnder(apart, *fit, threads);
      Marks agree(views, false);
      for (std::size_t i = 0; i < views; ++i) agree[i] = left[i] && under[i] < 4.0 * good_px;
      if (countOf(agree) > countOf(best)) {
        best = agree;
        best_fit = std::move(fit);
      }
      if (2 * countOf(best) > open.size() + 2) break;
    }
    if (!best_fit || countOf(best) < kFewestViews) break;
    FitInput part = apart.subset(best);
    part.separate();
    auto fit = firstFit(part, threads, nullptr);
    if (!fit) break;
    // Poses stand by the numbers of all views from here on.
    BundleState state = fit->state;
    state.poses.assign(views, Pose::Identity());
    std::size_t next = 0;
    for (std::size_t i = 0; i < views; ++i) {
      if (best[i]) state.poses[i] = fit->state.poses[next++];
    }
    fit->state = std::move(state);
    groups.emplace_back(best, *fit);
    for (std::size_t i = 0; i < views; ++i) left[i] = left[i] && !best[i];
  }
  if (groups.size() < 2) return allAgree(views, 0.0);
  double together_px = 0.0;
  for (const double rms : rmsUnder(apart, groups.front().second, threads)) {
    if (std::isfinite(rms)) together_px = std::max(together_px, rms);
  }
  return toldApart(apart, std::move(groups), together_px);
}

std::string describeContradiction(const FitInput& input, const Agreement& agreement) {
  const auto names = [&](const ViewGroup& group) {
    constexpr std::size_t kMost = 60;
    std::string text;
    for (std::size_t i = 0; i < group.views.size() && i < kMost; ++i) {
      text += (i > 0 ? ", " : "") + input.names[group.views[i]];
    }
    if (group.views.size() > kMost) {
      text += " and " + std::to_string(group.views.size() - kMost) + " more";
    }
    return text;
  };
  std::string text = "the views contradict each other: ";
  for (std::size_t g = 0; g < agreement.groups.size(); ++g) {
    const ViewGroup& group = agreement.groups[g];
    text += (g > 0 ? "; " : "") + std::to_string(group.views.size()) + " of them agree on " +
            (g > 0 ? "another" : "one") + " lens to " + formatFixed(group.rms_px, 2) + " px (" +
            names(group) + ")";
    if (!group.change.empty()) text += ", as if their images were " + group.change;
  }
  text += "; one lens for all is " + formatFixed(agreement.together_px, 2) + " px off";
  bool told = true;
  for (std::size_t g = 1; g < agreement.groups.size(); ++g) {
    told = told && !agreement.groups[g].change.empty();
  }
  if (!told) {
    text +=
        ". Two cameras in one folder, another focus or zoom, or images cropped or scaled do that";
  }
  return text;
}

}  // namespace omnister::calibration
