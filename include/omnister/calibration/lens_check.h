// SPDX-License-Identifier: Apache-2.0
/// @file Is a calibration still true? Boards and pairs of images seen through a lens that is given.
#pragma once

#include <Eigen/Core>
#include <opencv2/core/mat.hpp>
#include <string>
#include <vector>

#include "omnister/calibration/detections.h"
#include "omnister/common/pose.h"
#include "omnister/lens/lens_model.h"

namespace omnister {

/// Corners of boards against a lens: only the boards' poses are fitted.
struct BoardCheck {
  struct View {
    std::string name;
    std::vector<Eigen::Vector2d> residuals;  ///< observed - predicted [px]; empty: not used
    double rms_px = 0.0;
    std::string reason;  ///< why it was not used
  };
  std::vector<View> views;  ///< as many as were given
  int corners = 0;
  double rms_px = 0.0;
  double median_px = 0.0;  ///< of the 2-D error
  /// The correction that the corners would like best: rays (x, y, scale h) about a centre moved by
  /// `center_shift`. Standard deviations are those of the corners' own scatter.
  double scale = 1.0;
  double scale_sigma = 0.0;
  Eigen::Vector2d center_shift = Eigen::Vector2d::Zero();  ///< [px]
  Eigen::Vector2d center_sigma = Eigen::Vector2d::Zero();  ///< [px]
  double corrected_rms_px = 0.0;                           ///< with that correction
};

/// @throws Error when no view can be used
BoardCheck checkBoards(const LensModel& lens, const Detections& boards);

/// Features matched between two images against lenses and pose.
struct PairCheck {
  struct Match {
    Eigen::Vector2d reference, displaced;  ///< [px]
    double residual_px = 0.0;  ///< signed distance from the epipolar curve in the displaced image
    bool inlier = false;
  };
  std::vector<Match> matches;
  int inliers = 0;
  double median_px = 0.0;  ///< of |residual| over the inliers
  double rms_px = 0.0;     ///< over the inliers
  /// The small turn of the displaced camera that would lower the residuals most [rad], about its
  /// own x, y, z, and standard deviations. A turn about the baseline is seen least.
  Eigen::Vector3d turn = Eigen::Vector3d::Zero();
  Eigen::Vector3d turn_sigma = Eigen::Vector3d::Zero();
  double corrected_median_px = 0.0;  ///< with that turn
};

/// SIFT features, matched both ways; those within 15 px of their epipolar curves that meet
/// before both cameras are inliers.
/// @param reference, displaced CV_8UC1  @param T_ref_disp maps the displaced camera's coordinates
/// into the reference camera [m]
/// @throws Error for fewer than 30 inliers or a pose without baseline
PairCheck checkPair(const LensModel& reference_lens, const cv::Mat& reference,
                    const LensModel& displaced_lens, const cv::Mat& displaced,
                    const Pose& T_ref_disp);

}  // namespace omnister
