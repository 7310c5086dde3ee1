// SPDX-License-Identifier: Apache-2.0
/// @file Virtual views: what another camera, turned and zoomed at will, would see from the same
/// place.
///
/// The thesis' OMNIview (Johnson 1997, eqs 2.11 to 2.13) for every lens model: each pixel of the
/// view is a ray, and the lens says where the image shows it. Backward mapping leaves no gaps.
#pragma once

#include <Eigen/Core>
#include <opencv2/core/mat.hpp>
#include <optional>
#include <string_view>
#include <vector>

#include "omnister/lens/lens_model.h"

namespace omnister {

enum class Projection {
  kPinhole,          ///< straight lines stay straight; below 180 degrees
  kCylindrical,      ///< panorama: columns are longitude, rows the tangent of latitude
  kEquirectangular,  ///< columns are longitude, rows latitude
};

/// "pinhole", "cylindrical" or "equirectangular". @throws Error for another name
Projection projectionOf(std::string_view name);

/// Turns the view right (pan), then down (tilt), then clockwise about its own axis (roll) [rad].
/// @return rotation that maps the view's frame (x right, y down, z forward) into the camera's
Eigen::Matrix3d viewRotation(double pan, double tilt, double roll);

/// The thesis' angles: axis of the view at zenith angle `beta` off the optical axis and azimuth
/// `delta`, turned by `theta` about itself [rad] (Johnson 1997, eqs 2.11 and 2.12; A, -B, C, -D are
/// the upper left of this matrix). With `focal_px` = m R (eq. 2.13) and the lens r = R sin(beta),
/// View is those equations.
Eigen::Matrix3d omniviewRotation(double beta, double delta, double theta);

struct ViewGeometry {
  Projection projection = Projection::kPinhole;
  cv::Size size{640, 480};                                 ///< [px]
  double focal_px = 320.0;                                 ///< pixels per radian on the view's axis
  Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();  ///< view to camera
};

/// @param hfov horizontal field, between the outer edges of the first and last column [rad]: below
/// pi
///             for a pinhole, up to 2 pi for the others
/// @throws Error for a field or size out of range
ViewGeometry makeViewGeometry(Projection projection, cv::Size size, double hfov,
                              const Eigen::Matrix3d& rotation);

/// Ray of a view pixel in the camera's frame, unit length; the centre of the view is the middle of
/// its pixel grid.
/// @return nullopt where the projection has none (beyond the poles)
std::optional<Eigen::Vector3d> viewRay(const ViewGeometry& geometry, const Eigen::Vector2d& pixel);

/// Where the view shows a direction of the camera's frame; the inverse of viewRay(). An oracle for
/// tests.
/// @return nullopt behind a pinhole view; not clipped to the size
std::optional<Eigen::Vector2d> viewPixel(const ViewGeometry& geometry, const Eigen::Vector3d& ray);

/// The maps of one view, made once; render() may be called for any number of frames and from any
/// thread.
class View {
 public:
  /// @param lens of the camera
  /// @param lens_size of the camera's images [px], at most 32766 a side
  /// @param anti_alias smooth where the view shows the image smaller than it is
  /// @param threads for making the maps; 0: every core
  /// @throws Error for sizes out of range
  View(const LensModel& lens, cv::Size lens_size, const ViewGeometry& geometry,
       bool anti_alias = true, int threads = 0);

  const ViewGeometry& geometry() const { return geometry_; }
  /// CV_8UC1 of the view's size: 255 where the camera sees, 0 where render() leaves black.
  const cv::Mat& mask() const { return mask_; }
  /// Intrinsics of a pinhole view.
  Eigen::Matrix3d cameraMatrix() const;

  /// @param image of the lens' size; 8 or 16 bits or float, at most 4 channels
  /// @throws Error for another size or type
  cv::Mat render(const cv::Mat& image) const;
  /// The same into a picture that is there already, if size and type are right; else a new one.
  void render(const cv::Mat& image, cv::Mat& view) const;

 private:
  /// Pixels of one row that the camera does not see.
  struct Unseen {
    int y, begin, end;
  };
  /// One level of the image's pyramid: its maps, and where and how much it takes part.
  struct Level {
    cv::Rect area;     // of the view
    cv::Mat xy;        // CV_16SC2 fixed maps over the area
    cv::Mat fraction;  // CV_16UC1
    cv::Mat share;  // CV_32FC1 over the area: of this level over the finer ones; not of the first
  };
  cv::Size lens_size_;
  ViewGeometry geometry_;
  cv::Mat mask_;
  std::vector<Unseen> unseen_;
  std::vector<Level> levels_;
};

/// The range image of a camera as depth in a view of it. Ranges are taken from the nearest pixel
/// and never mixed: between a near and a far one there is nothing.
class DepthView {
 public:
  /// As View.
  DepthView(const LensModel& lens, cv::Size lens_size, const ViewGeometry& geometry,
            int threads = 0);

  /// @param range CV_32FC1 of the lens' size, along the ray [m]
  /// @return CV_32FC1 of the view's size: along the axis of a pinhole view, along the ray for the
  ///         other projections [m]; NaN where nothing is known
  /// @throws Error for another size or type
  cv::Mat render(const cv::Mat& range) const;

 private:
  cv::Size lens_size_;
  cv::Mat nearest_;  // CV_16SC2, the camera's pixel; -1 where it sees nothing
  cv::Mat cosine_;   // CV_32FC1, of the ray and the axis; empty: 1
};

}  // namespace omnister
