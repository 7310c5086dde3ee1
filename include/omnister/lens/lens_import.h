// SPDX-License-Identifier: Apache-2.0
/// @file Other people's calibrations: read, and turned into lens surfaces by a fit.
///
/// All four families count pixels from (0, 0) at the centre of the top-left pixel, as this package
/// does; OCamCalib gives the row first.
#pragma once

#include <Eigen/Core>
#include <functional>
#include <opencv2/core/types.hpp>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "omnister/lens/lens_fit.h"
#include "omnister/lens/lens_models.h"

namespace omnister {

/// Somebody else's camera, as a function from bearings to pixels.
struct ForeignCamera {
  std::string format;  ///< "camera_info", "kalibr", "ocam" or "mrcal"
  std::string model;   ///< e.g. "pinhole-equidistant"
  std::string camera_name;
  cv::Size image_size;                               ///< [px]
  Eigen::Vector2d center = Eigen::Vector2d::Zero();  ///< image of the optical axis [px]
  /// Unit bearing in the optical frame (x right, y down, z forward) to pixel; nullopt where the
  /// formula has no image of it. May fold over: see oneToOneTheta().
  std::function<std::optional<Eigen::Vector2d>(const Eigen::Vector3d&)> project;
  /// Fisheye formulas hold beyond the image's corners, perspective ones run off to infinity.
  bool wide = false;
  std::vector<std::string> remarks;  ///< for the person who imports
};

/// Names of the formats, "auto" first.
const std::vector<std::string>& foreignFormats();

/// Reads a calibration.
/// @param format one of foreignFormats(); "auto" looks at the content
/// @param camera the camera of a Kalibr camchain ("cam1"); empty takes the first, with a remark
/// when
///        there are several
/// @param source for messages, usually the path
/// @throws InputError naming key or line, value and expectation
ForeignCamera readForeignCamera(std::string_view text, std::string_view source,
                                const std::string& format = "auto", const std::string& camera = "");

/// The field over which a foreign camera is to be fitted [rad].
struct ForeignField {
  double max_theta = 0.0;   ///< where it is one-to-one, and the image or 95 degrees reach
  double one_to_one = 0.0;  ///< where its radius stops rising, in the worst azimuth; pi at most
  double image = 0.0;       ///< the farthest ray within the image rectangle
};
ForeignField foreignField(const ForeignCamera& camera);

struct ForeignFit {
  LensFit fit;
  LensStructure structure;  ///< what helped
  ForeignField field;
};

/// Fits a surface to a foreign camera over its field. Affinity, decentring and turn are carried
/// only where they lower the residual.
/// @param model a name of lensModelNames(); an asphere gets `even_terms`, a spline `knots`
/// @throws Error when no field is left to fit
ForeignFit fitForeignCamera(const ForeignCamera& camera, const std::string& model,
                            int even_terms = 3, int knots = 24);

}  // namespace omnister
