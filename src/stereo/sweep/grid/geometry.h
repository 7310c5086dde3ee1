// SPDX-License-Identifier: Apache-2.0
/// @file Epipolar coordinates of a pair of wide-angle images, and the grids laid along them.
///
/// With e the unit baseline, a ray has phi, the angle of its epipolar plane about e, and theta, its
/// angle from e. Seen from the displaced camera (its rays turned into the reference orientation) a
/// point keeps phi and has theta' >= theta. Along an epipolar curve the coordinate is a = theta,
/// and a hypothesis h is the parallax angle theta' - theta [rad]: a shift along a row of a (phi, a)
/// grid. Descriptors of the
/// displaced image are stored on such grids, in bands: each tile of the reference image uses the
/// band whose steps are about a pixel there, and a band holds what its tiles can reach and no more.
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <opencv2/core/types.hpp>
#include <vector>

#include "omnister/common/pose.h"
#include "omnister/lens/lens_model.h"
#include "stereo/sweep/kernels/kernels.h"

namespace omnister::sweep {

/// Rows are e, m, n: right-handed, m as near to the reference's optical axis as it can be.
struct EpipolarFrame {
  Eigen::Matrix3d basis = Eigen::Matrix3d::Identity();  ///< reference coordinates to (e, m, n)
  double baseline = 0.0;                                ///< [m]
};

/// @param t centre of the displaced camera in the reference frame [m], not zero
EpipolarFrame makeEpipolarFrame(const Eigen::Vector3d& t);

/// A lens with its field widened a little where its surface allows, so that interpolation has
/// neighbours at the rim; the true field is kept beside it.
struct WideLens {
  LensPtr lens;
  double cos_max_theta = -1.0;
};
WideLens widen(const LensPtr& lens);

/// Epipolar coordinates of every pixel of a (possibly reduced) reference image. They are kept at
/// the corners of square cells with a cubic between, and pixel by pixel in cells at the edge of the
/// field and near the epipoles, where that does not do.
struct ReferenceMap {
  static constexpr int kCell = 16;  ///< pixels
  static constexpr std::int32_t kInterpolated = -1, kNothing = -2;
  cv::Size size;
  cv::Size cells;
  /// Corners, the first one cell before the image; cells.width + 3 a row.
  std::vector<float> node_phi;      ///< [1 / kPhiUnits rad]
  std::vector<float> node_a;        ///< theta [rad]
  std::vector<std::int32_t> exact;  ///< by cell: kInterpolated, kNothing or its place in the next
  std::vector<std::uint16_t> exact_phi;
  std::vector<float> exact_a;
  std::size_t field = 0;  ///< pixels that have a ray
};

/// @param level the image is reduced 2^level times; pixel u of it is (u + 0.5) 2^level - 0.5
/// @param mask CV_8UC1 of the full size or empty; 0 leaves a pixel out (all of a reduced pixel's)
ReferenceMap makeReferenceMap(const WideLens& lens, cv::Size full_size, int level,
                              const EpipolarFrame& frame, const cv::Mat& mask, int threads);

/// Epipolar coordinates of a rectangle, pixel by pixel.
struct MapView {
  cv::Size size;  ///< of the image
  cv::Rect rect;  ///< what is here, at least; pixels beyond the image are those at its edge
  int left = 0, stride = 0;
  std::vector<std::uint16_t> phi;  ///< kNoRay where there is no ray
  std::vector<float> a;            ///< theta [rad]; anything where there is no ray

  std::size_t at(int x, int y) const {
    return static_cast<std::size_t>(y - rect.y) * stride + (x - left);
  }
};

/// Fills a view; vectors may read 16 elements past the end of a row.
void viewMap(const ReferenceMap& map, const cv::Rect& rect, MapView* view);

/// Pixels around a tile that its local frames look at.
inline constexpr int kViewHalo = 6;

/// Movement over the image along the two epipolar coordinates at a pixel of the view.
/// @param d_phi [out] [px/rad]  @param d_a [out] [px per unit of a]
/// @return false where there are not enough rays around
bool localFrame(const MapView& view, int x, int y, Eigen::Vector2f* d_phi, Eigen::Vector2f* d_a);

/// A rectangle of the reference image that is matched at once.
struct Tile {
  cv::Rect rect;
  int band = -1;               ///< -1: no pixel of it has a ray
  float a_min = 0, a_max = 0;  ///< theta of its pixels [rad]
  std::uint16_t phi_min = 0, phi_max = 0;
  float h_min = 0, h_max = 0;  ///< hypotheses worth trying [rad]
  bool clear = false;          ///< every cell it can reach sees the image
};

/// How a band counts rows and columns.
struct Band {
  double row_scale = 0, row_offset = 0;  ///< row = phi16 * row_scale + row_offset
  double step_phi = 0;                   ///< [rad per row]
  double step_h = 0;                     ///< [rad per column]
  int rows = 0;
  /// column = theta / step_h. Cells of row r hold columns [begin[r], begin[r] + 8 * runs[r]); cell
  /// index = column + origin[r].
  std::vector<std::int32_t> begin, runs, origin;
  /// First of the nodes of row r; a row has runs[r] + 1.
  std::vector<std::int32_t> node;
};

/// All bands of one displaced image at one level. A run is eight cells; the image position is
/// linear between the nodes at its ends.
struct Grid {
  std::vector<Band> bands;
  std::vector<float> x, y;         ///< nodes [px of the reduced displaced image]
  std::vector<std::uint8_t> mask;  ///< by run (cell / 8): bit i set where cell i sees the image
  std::int32_t cells = 0;          ///< without the slack behind them
};

/// Cells behind the last one that may be read.
inline constexpr int kCellSlack = 512;

/// Rows and columns of the bands, chosen by the tiles.
struct Layout {
  std::vector<Tile> tiles;
  int tiles_x = 0;
  std::vector<Band> bands;  ///< without storage
};

struct HypothesisLimits {
  double baseline = 0;   ///< [m]
  double min_range = 0;  ///< [m]; 0: a parallax of atan(1/4)
  double max_range = 0;  ///< [m]; 0: infinity
  int hypotheses = 0;    ///< most columns; 0: no limit
};

/// Least and largest hypothesis [rad] worth trying at an angle theta [rad] from the baseline.
void hypothesisRange(const HypothesisLimits& limits, double theta, double* least, double* most);

/// Cuts the image into tiles and chooses bands.
Layout makeLayout(const ReferenceMap& map, const HypothesisLimits& limits, cv::Size tile);

/// Lays out the cells of one displaced image and finds where they lie in it.
Grid makeGrid(Layout* layout, const ReferenceMap& map, const EpipolarFrame& frame,
              const WideLens& lens, cv::Size full_size, int level,
              const Eigen::Matrix3d& R_ref_disp, int halo, int threads);

}  // namespace omnister::sweep
