// SPDX-License-Identifier: Apache-2.0
/// @file One lens structure fitted to one camera's views, and how well it predicts unseen ones.
#pragma once

#include <opencv2/core/types.hpp>
#include <optional>
#include <string>
#include <vector>

#include "calibration/fit/board.h"
#include "calibration/fit/bundle.h"
#include "omnister/calibration/detections.h"
#include "omnister/lens/lens_models.h"

namespace omnister::calibration {

/// The views that a fit uses, in the order of the detections.
struct FitInput {
  cv::Size image_size;
  Board board;
  std::vector<std::string> names;
  std::vector<int> index;  ///< place in the detections: view i is in fold i mod K
  std::vector<std::vector<Corner>> corners;
  /// Which of BundleState::poses each view has, and the stage's position less that of the first
  /// view on a stage. Without a stage every view has its own pose.
  std::vector<int> pose;
  std::vector<double> travel;
  bool stage = false;  ///< some views share poses: BundleState::axis is estimated
  bool warp = true;

  std::size_t cornerCount() const;
  /// What an adjustment of the lens is to free.
  BundleOptions freedom() const;
  /// The views that `keep` marks. Poses keep their numbers.
  FitInput subset(const std::vector<bool>& keep) const;
  /// Every view with a pose of its own and no stage.
  void separate();
};

struct Fit {
  LensStructure structure;
  BundleState state;      ///< one lens; poses as FitInput::pose says
  double sigma_px = 0.0;  ///< robust standard deviation of one coordinate of a residual [px]
  double loss_px = 0.0;   ///< scale of the loss at the end [px]
};

/// Figures of a set of residuals.
struct ResidualStatistics {
  double rms_px = 0.0;     ///< root mean square of the 2-D error, all corners
  double median_px = 0.0;  ///< of the 2-D error
  double sigma_px = 0.0;   ///< median / 1.1774: what one coordinate scatters by, outliers apart
};
ResidualStatistics statisticsOf(const std::vector<std::vector<Eigen::Vector2d>>& residuals);

/// "asphere r^6 + affinity + decentring"
std::string describeStructure(const LensStructure& structure);

/// Throws Error for a structure that no lens can have.
void checkStructure(const LensStructure& structure);

std::vector<BundleView> bundleViews(const FitInput& input);

std::vector<std::vector<Eigen::Vector2d>> residualsOf(const FitInput& input,
                                                      const BundleState& state);

/// A conic fitted without any prior knowledge; views without a pose keep the identity and are told
/// in `lost`. @return nullopt when nothing explains the corners
std::optional<Fit> firstFit(const FitInput& input, int threads, std::vector<bool>* lost);

/// Relative change of the cost at which a fit has converged to rounding, and one that is only
/// compared with others: a thousandth of what noise makes of the cost. Rich structures on narrow
/// fields have valleys in which no more than that can be gained in any number of steps.
inline constexpr double kPolishTolerance = 1e-10;
inline constexpr double kTrialTolerance = 1e-6;

/// Fits `structure`, started from another fit of the same views.
std::optional<Fit> refit(const FitInput& input, const Fit& from, const LensStructure& structure,
                         double tolerance = kPolishTolerance);

/// Brings a fit of refit() to kPolishTolerance; left as it is where that fails.
void polish(const FitInput& input, Fit& fit);

/// Root mean square 2-D error over folds: each fold's views are predicted by lens and warp fitted
/// to the others, with only their poses refitted by plain least squares over all corners. Folds
/// with no view are left out. @return nullopt when a fold cannot be fitted
std::optional<double> holdoutRms(const FitInput& input, const Fit& fit, int folds, int threads);

/// Largest off-axis angle of the corners that the fit explains [rad].
double outermostAngle(const FitInput& input, const BundleState& state, double sigma_px);

/// The same lens over another field, or over the largest below it where its surface stays
/// one-to-one.
LensPtr withField(const LensPtr& lens, double max_theta);

/// Pixels per radian on the axis.
double focalLength(const LensModel& lens);

}  // namespace omnister::calibration
