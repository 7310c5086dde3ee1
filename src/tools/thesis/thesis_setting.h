// SPDX-License-Identifier: Apache-2.0
/// @file The simulated lenses and boards that the thesis' measurements are made on, and the lenses
/// found from them by its procedures and by our fits.
#pragma once

#include <functional>
#include <opencv2/core/types.hpp>
#include <optional>
#include <random>
#include <string>
#include <vector>

#include "omnister/calibration/detections.h"
#include "omnister/calibration/thesis_procedures.h"
#include "omnister/lens/lens_model.h"

namespace omnister::tools::thesis {

using Eigen::Vector2d;
using Eigen::Vector3d;

constexpr double kPi = 3.14159265358979323846;
constexpr double kDegree = kPi / 180.0;
constexpr double kInch = 0.0254;

// Kodak DCS460c: 27.6 x 18.4 mm, 3060 x 2036 pixels of 9 um (Johnson 1997, sec. 4.3).
constexpr int kWidth = 3060;
constexpr int kHeight = 2036;
constexpr double kFocalPx = 16.0 / 0.009;
// Table 5.1: 3.635 mm are 2.10 %, 16.38 mm are 9.48 % of this distance.
constexpr double kBoardDistance = 0.173;
constexpr double kBaseline = 2.0 * kInch;
/// Of simulated corners, an axis [px].
constexpr double kNoisePx = 0.1;
/// Beyond this off-axis angle a dewarped picture has no use any more.
constexpr double kDewarpLimit = 60.0 * kDegree;

/// A lens that is taken for the truth.
struct Shape {
  std::string name;
  std::string formula;
  LensPtr lens;
  cv::Size size;
};

/// A lens found from boards, and which way.
struct Model {
  std::string name;
  LensPtr lens;     ///< null where the way to it failed
  std::string why;  ///< then the reason
};

/// Of the models found, those that have figures of their own: all but the last, which is the first
/// by another procedure.
constexpr int kFiguredModels = 5;

/// The lenses of one shape.
struct Found {
  /// By straight lines, by the thesis' quadric, by our quadric, conic and asphere, by dots.
  std::vector<Model> models;
  std::optional<QuadricProcedure> quadric;
};

/// A lens of a given radius over off-axis angle [px, rad], its x stretched.
LensPtr lensOf(const std::function<double(double)>& radius, const Vector2d& center,
               double max_theta, double aspect = 1.0);

/// Equisolid, equidistant and a real one, at this size beside the thesis'.
std::vector<Shape> lensShapes(double scale);

/// Pixels per radian on the axis: Johnson's R0.
double slopeOf(const LensModel& lens);

/// Within the image, and not at its border [px].
bool inside(const Vector2d& pixel, cv::Size size, double border = 2.0);

/// A dot board square to the axis, a row and a column through the centre; unit: its distance.
ViewDetections squareBoard(const Shape& shape, double limit, double pitch, std::mt19937& random);

/// Boards held by hand, tilted to all sides, over the whole image.
Detections tiltedBoards(const Shape& shape, std::mt19937& random);

/// Edge pixels of straight edges that cross the image between half radius and border (sec. 4.1.1).
Detections straightEdges(const Shape& shape, std::mt19937& random);

/// @param board square to the axis @param boards tilted @param edges straight ones
Found findModels(const Shape& shape, const ViewDetections& board, const Detections& boards,
                 const Detections& edges, int threads);

}  // namespace omnister::tools::thesis
