// SPDX-License-Identifier: Apache-2.0
/// @file A lens as rviz shows it.
#pragma once

#include <geometry_msgs/Point.h>
#include <visualization_msgs/MarkerArray.h>

#include <Eigen/Core>

#include "omnister/lens/lens_file.h"

namespace omnister {

/// A point of a marker.
geometry_msgs::Point toPoint(const Eigen::Vector3d& p);

/// Three markers in the camera's optical frame, by namespace:
/// - `surface`: the lens surface, a mesh of points (x, y, h(x, y)) along their true rays, coloured
/// by
///   how far each lies from the spherical one (Johnson 1997, figs 4.11, 4.13);
/// - `sphere`: the spherical surface with the same height in the middle, beside it;
/// - `field`: where the image and the field of view end, at `field_radius` around the camera.
/// @param scale height of the surface in the middle [m]  @param field_radius [m]
/// @param frame_id optical frame
visualization_msgs::MarkerArray lensMarkers(const LensFile& file, const std::string& frame_id,
                                            double scale = 0.1, double field_radius = 1.0);

}  // namespace omnister
