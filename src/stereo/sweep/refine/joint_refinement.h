// SPDX-License-Identifier: Apache-2.0
/// @file The last step of matching with several positions: every image that sees a point has its
/// say in where it lies.
///
/// Around a good inverse range w the grey values of all positions are linear in a change of it.
/// Each pixel is moved along its own ray, so that a window follows the surface whatever its slant,
/// and the change that makes the images of the window most alike, in the sense of least squares, is
/// found in closed form (Lucas and Kanade 1981). The grey values of a pixel in all positions, the
/// reference among them, are noisy copies of one unknown: their mean is taken out, so that the
/// reference's noise is not counted once for each position. Positions whose window does not fit are
/// left out (hidden there); the better half always stays.
#pragma once

#include <opencv2/core/mat.hpp>
#include <vector>

#include "omnister/stereo/cloud.h"
#include "omnister/stereo/matcher.h"
#include "stereo/sweep/grid/geometry.h"

namespace omnister {

/// Pixels of directions in front of a lens, by table; right to a few thousandths of a pixel.
class ProjectionTable {
 public:
  /// @throws Error for a lens without an image of its own axis
  ProjectionTable(const sweep::WideLens& lens, cv::Size size, int threads);

  /// For `count` directions of any length > 0: pixels, NaN outside the field.
  void project(const float* dx, const float* dy, const float* dz, int count, float* u,
               float* v) const;
  double focalPx() const { return focal_px_; }  ///< pixels per radian on the axis

 private:
  double focal_px_ = 0.0;
  float cos_max_ = -1.0f;
  float scale_ = 0.0f, middle_ = 0.0f;  ///< of tan(theta / 2) to nodes
  int nodes_ = 0;
  std::vector<cv::Vec2f> table_;
};

class JointRefinement {
 public:
  /// @param scale images are reduced so many times first: 1, 2, ...; a reduced pixel u covers the
  /// pixels [u scale, (u + 1) scale)
  /// @param prior_px standard deviation of what it starts from, in the widest reduced image [px]
  JointRefinement(const StereoGeometry& geometry, int threads, int scale = 1,
                  float prior_px = 0.5f);

  /// Other positions for the same reference.
  void setDisplaced(const std::vector<StereoGeometry::Displaced>& displaced);

  /// Improves inverse ranges in place.
  /// @param reference, displaced CV_8UC1, in full size; the others are as large as reduced images
  /// @param inverse CV_32FC1, one over range along the ray [1/m]; NaN where unknown
  /// @param weight [in, out] CV_32FC1, one over the variance of inverse [m^2]
  /// @param support CV_8UC1, how many positions found that range
  /// @return pixels that no position confirms; they are NaN afterwards
  std::size_t refine(const cv::Mat& reference, const std::vector<cv::Mat>& displaced,
                     const cv::Mat& support, cv::Mat* inverse, cv::Mat* weight) const;

 private:
  struct Strip;
  void raysOf(int y, int width, Strip* strip) const;
  std::size_t refineStrip(int begin, int end, const cv::Mat& reference,
                          const std::vector<cv::Mat>& displaced, const cv::Mat& support,
                          const cv::Mat& inverse, const cv::Mat& weight, cv::Mat* inverse_out,
                          cv::Mat* weight_out, Strip* strip) const;

  StereoGeometry geometry_;
  int threads_;
  int scale_;
  float prior_px_;
  PointMaker rays_;
  struct Table {
    LensPtr lens;
    cv::Size size;
    ProjectionTable table;
  };
  std::vector<Table> tables_;          ///< by lens and image size
  std::vector<std::size_t> table_of_;  ///< by displaced image
  float widest_ = 0;  ///< movement in the widest position by inverse range on the axis [px m]
};

}  // namespace omnister
