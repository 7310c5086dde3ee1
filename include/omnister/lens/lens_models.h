// SPDX-License-Identifier: Apache-2.0
/// @file Making lenses by name or by structure.
#pragma once

#include <Eigen/Core>
#include <map>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "omnister/lens/lens_model.h"

namespace omnister {

/// Names of all models, simplest first.
const std::vector<std::string>& lensModelNames();

/// What a model carries beyond its name.
struct LensStructure {
  std::string model = "conic";
  int even_terms = 0;       ///< asphere, or spline with a grid: how many of r^4, r^6, r^8 (0 to 3)
  int knots = 12;           ///< spline without a grid: knots spaced evenly in angle (4 to 32)
  bool affinity = false;    ///< p and q
  bool decentring = false;  ///< asphere and spline only: d1 and d2
  /// d3 and d4 as well: decentring that grows otherwise than Brown's with the angle.
  bool decentring_growth = false;
  /// s as well: a foreign camera may be turned about its axis against its own image. Never in a
  /// calibration from boards, whose poses would turn along.
  bool turn = false;
  /// Spline: control points a side (4 to 12) of a smooth 2-D correction of an asphere's rays; 0:
  /// the radial spline.
  int grid = 0;
};

/// A lens of the structure that is nearest to the equidistant fisheye r = f theta: the starting
/// point of every fit.
/// @param center [px]  @param focal_px pixels per radian on the axis, > 0
/// @param max_theta half field of view [rad], in (0, pi)
/// @throws Error for an unknown model or a structure it cannot carry
LensPtr makeLens(const LensStructure& structure, const Eigen::Vector2d& center, double focal_px,
                 double max_theta);

/// The named numbers of a lens' surface, affinity and decentring in file order (no centre).
using NamedParameters = std::vector<std::pair<std::string, std::vector<double>>>;

/// The inverse of makeLens() by name: what the `parameters` block of a lens file holds.
NamedParameters namedParameters(const LensModel& lens);

/// The structure of a lens.
LensStructure structureOf(const LensModel& lens);

/// The lens of a lens file's `parameters` block. Names not given take their neutral value where
/// they have one (affinity and decentring 0).
/// @throws InputError (with `source`) for missing, unknown or non-finite parameters, or a surface
/// that is not one-to-one over the field
LensPtr makeLens(std::string_view model, const Eigen::Vector2d& center,
                 const std::map<std::string, std::vector<double>>& parameters, double max_theta,
                 std::string_view source);

}  // namespace omnister
