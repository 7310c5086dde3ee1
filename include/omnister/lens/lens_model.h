// SPDX-License-Identifier: Apache-2.0
/// @file What every lens can do.
///
/// Conventions. Optical frame (REP 103): +x right, +y down, +z forward. Pixel (0, 0) is the centre
/// of the top-left pixel. A pixel becomes sensor coordinates about the centre of distortion,
///     [x; y] = [[1 + p, q], [s, 1]]^-1 (pixel - center)     (affinity; p = q = s = 0 without one;
///                                                            s only in imported lenses)
/// and then the viewing ray (x, y, h(x, y)), h being the height of the lens surface in pixels
/// (Johnson 1997, sec. 4.2). All models are central. Rays may point behind the camera.
#pragma once

#include <Eigen/Core>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace omnister {

using Jacobian23 = Eigen::Matrix<double, 2, 3>;
using Jacobian32 = Eigen::Matrix<double, 3, 2>;
using JacobianParams = Eigen::Matrix<double, 2, Eigen::Dynamic>;

class LensModel;
using LensPtr = std::shared_ptr<const LensModel>;

/// Immutable, so safe to share between threads.
class LensModel {
 public:
  virtual ~LensModel() = default;

  /// "spherical", "quadric", "conic", "asphere" or "spline": `lens_surface.model` of a lens file.
  virtual std::string_view model() const = 0;

  /// Direction to pixel.
  /// @param bearing any length > 0, in the optical frame; z <= 0 allowed
  /// @param d_bearing [out] d(pixel)/d(bearing), 2x3 [px per unit of bearing]; skipped when null
  /// @param d_parameters [out] d(pixel)/d(parameters()), 2xN; skipped when null
  /// @return (u, v) [px], not clipped to the image; nullopt when the off-axis angle exceeds
  ///         maxTheta(), for a zero or non-finite bearing, or where the model has no image of it
  virtual std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& bearing,
                                                 Jacobian23* d_bearing = nullptr,
                                                 JacobianParams* d_parameters = nullptr) const = 0;

  /// Pixel to unit bearing, the inverse of project() to 1e-9 rad.
  /// @param d_pixel [out] d(bearing)/d(pixel), 3x2; skipped when null
  /// @return nullopt where the ray is more than maxTheta() off the axis or the surface has no
  /// height
  virtual std::optional<Eigen::Vector3d> unproject(const Eigen::Vector2d& pixel,
                                                   Jacobian32* d_pixel = nullptr) const = 0;

  /// Half field of view: rays further off the optical axis than this are outside [rad]; may exceed
  /// pi/2, is below pi.
  virtual double maxTheta() const = 0;

  /// Height of the lens surface over sensor coordinates relative to the centre, affinity undone
  /// [px]; nullopt outside the field. Rays are (x, y, surfaceHeight(x, y)) before decentring.
  virtual std::optional<double> surfaceHeight(double x, double y) const = 0;

  /// All free numbers of the model in the order of parameterNames(): the centre first, then the
  /// surface, then affinity and decentring if the model carries them. Angles, polynomials and
  /// heights are in the units the README's table of models gives.
  virtual Eigen::VectorXd parameters() const = 0;
  virtual std::vector<std::string> parameterNames() const = 0;

  /// The same structure with other numbers (and, if given, another field).
  /// @return null when the numbers do not make a lens: not finite, surface not one-to-one over the
  ///         field, radius or height not positive
  virtual LensPtr withParameters(const Eigen::VectorXd& parameters,
                                 std::optional<double> max_theta = std::nullopt) const = 0;

  /// Centre of distortion [px].
  Eigen::Vector2d center() const { return parameters().head<2>(); }
};

}  // namespace omnister
