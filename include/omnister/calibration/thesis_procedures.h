// SPDX-License-Identifier: Apache-2.0
/// @file The calibration procedures of Johnson 1997, kept to compare with.
///
/// None of them finds a metric lens. Straight lines and boards square to the optical axis determine
/// the lens surface only up to one scale of its height (h -> c h moves every dewarped picture by a
/// scale alone), so R0 is not observable; each procedure takes it from its own assumption about the
/// shape of the surface. Dewarped pictures come out nearly straight, but rays may be wrong by many
/// degrees. calibrate() with tilted boards is the way to rays.
///
/// Sensor coordinates (x, y) are pixels about the centre of distortion, (u, v) the dewarped plane
/// in pixels of the image's middle.
#pragma once

#include <Eigen/Core>
#include <opencv2/core/mat.hpp>
#include <optional>
#include <string>
#include <vector>

#include "omnister/calibration/detections.h"
#include "omnister/lens/lens_file.h"

namespace omnister {

/// Where the optical axis meets the sensor, from one view of a plane board square to the axis.
///
/// Method: azimuth-angle invariability, which Basu and Licardie 1995 take as the definition of the
/// centre. The lens moves points along their radius only, so the centre is where every corner lies
/// on the radius through its place on the board. Least squares of the distances [px] from those
/// radii over the centre, the board point it sees and the board's turn; no model of the radial
/// distortion is needed. (Basu and Licardie fit their fish-eye transform along with the centre.)
struct CenterOfDistortion {
  Eigen::Vector2d center = Eigen::Vector2d::Zero();       ///< [px]
  Eigen::Vector2d sigma = Eigen::Vector2d::Zero();        ///< standard deviation [px]; 0 when given
  Eigen::Vector2d board_point = Eigen::Vector2d::Zero();  ///< what it sees, in board units
  double turn = 0.0;    ///< from the board's x to the image's x, towards y [rad]
  double rms_px = 0.0;  ///< of the distances from the radii
};

/// @param given keep this centre [px] and find only what it sees
/// @throws Error when fewer than 12 corners are there, the board is not plane or mirrored, or the
/// distortion is too weak to show a centre
CenterOfDistortion findCenterOfDistortion(const ViewDetections& view, cv::Size image_size,
                                          const std::optional<Eigen::Vector2d>& given = {});

struct ProcedureOptions {
  /// Centre of distortion [px]. Without it `lines` takes the middle of the image, the others find
  /// it.
  std::optional<Eigen::Vector2d> center;
  /// Sweep of the radius [px]; 0: from just above the largest radius of the data to 4 times that.
  double min_radius = 0.0;
  double max_radius = 0.0;
};

/// One setting of a sweep and its mean absolute errors [px of the dewarped plane].
struct SweepStep {
  double radius = 0.0;  ///< [px]
  double error_x = 0.0;
  double error_y = 0.0;
  double combined = 0.0;  ///< mean of both; `lines`: deviation from the fitted line
};

/// Distance of dewarped board points from where a pinhole sees them (Johnson 1997, table 4.1).
struct DewarpError {
  double mean_px = 0.0;
  double min_px = 0.0;
  double max_px = 0.0;
};

/// Sec. 4.1.1, fig. 4.4: each line's edge pixels are dewarped with the spherical model (eq. 4.3,
/// 4.4) for R from MAX to MIN; the R of least mean absolute deviation from a straight line is kept,
/// and averaged over the lines.
struct LineRadius {
  struct Line {
    std::string name;
    std::optional<double> radius;  ///< [px]; empty when the line was not used
    double deviation_px = 0.0;     ///< mean absolute, at that radius
    int points = 0;
    std::string reason;  ///< why it was not used
    std::vector<SweepStep> sweep;
  };
  std::vector<Line> lines;
  double radius = 0.0;  ///< mean [px]
  double spread = 0.0;  ///< standard deviation over the lines [px]; 0 for one
  LensFile file;        ///< `spherical`
  std::vector<std::string> warnings;
};
/// @param lines each "view" holds the edge pixels of one straight edge; board points are not used
/// @throws Error when no line is fit for use
LineRadius calibrateByLines(const Detections& lines, const ProcedureOptions& options = {});

/// The longest edge between bright and dark inside a region (sec. 4.1.1, fig. 4.3): Otsu threshold,
/// contour, and each contour pixel moved along the gradient to where the grey crosses the
/// threshold.
/// @param roi part of the image; empty: all of it
/// @throws Error when the region shows no edge of at least 20 pixels
std::vector<Eigen::Vector2d> findEdgePixels(const cv::Mat& image, cv::Rect roi = {});

/// Sec. 3.1, fig. 3.3: a board square to the axis is dewarped with the spherical model for a sweep
/// of R; the mean error along x, along y, and of both together each have their own best R.
struct DotRadius {
  CenterOfDistortion center;
  SweepStep best_x;
  SweepStep best_y;
  SweepStep best;  ///< of the combined error; this one goes to the lens file
  std::vector<SweepStep> sweep;
  DewarpError error;
  double rms_px = 0.0;  ///< of the corners in the image, with the kept R
  LensFile file;        ///< `spherical`
  std::vector<std::string> warnings;
};
/// @throws Error as findCenterOfDistortion()
DotRadius calibrateByDots(const ViewDetections& view, cv::Size image_size,
                          const ProcedureOptions& options = {});

/// Sec. 4.3: the elliptic paraboloid h = R0 - x^2/a^2 - y^2/b^2 from the row and column of a square
/// board that pass through the centre of distortion. R(u) and R(v) by eq. 4.22 and 4.23 for a trial
/// R0, each fitted by a line, with one common constant term; R0 is where that constant equals R0.
/// Heights along the axes by eq. 4.24 and 4.25, 1/a^2 and 1/b^2 by a second-order fit of them.
///
/// The scale at the middle (pixels per board unit), which the thesis measures on the central dot,
/// is the limit of radius over board distance at the centre, by an odd polynomial through the inner
/// half of the points.
struct QuadricProcedure {
  CenterOfDistortion center;
  double pixels_per_unit = 0.0;  ///< at the centre
  double R0 = 0.0;               ///< [px]; not observable, see the top of this file
  double slope_u = 0.0;          ///< of R(u) = R0 + slope_u |u|
  double slope_v = 0.0;
  double inverse_a2 = 0.0;  ///< 1/a^2 [1/px]
  double inverse_b2 = 0.0;
  double r_squared_x = 0.0;  ///< of the second-order fits
  double r_squared_y = 0.0;
  int row_points = 0;
  int column_points = 0;
  DewarpError error;    ///< over all corners
  double rms_px = 0.0;  ///< of the corners in the image
  LensFile file;        ///< `quadric`
  std::vector<std::string> warnings;
};
/// @throws Error as findCenterOfDistortion(), when row or column hold fewer than 4 points, or when
/// no R0 meets the constraint
QuadricProcedure calibrateQuadric(const ViewDetections& view, cv::Size image_size,
                                  const ProcedureOptions& options = {});

}  // namespace omnister
