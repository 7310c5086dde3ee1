// SPDX-License-Identifier: Apache-2.0
/// @file What a scene is made of, for the renderer.
#pragma once

#include <Eigen/Geometry>
#include <array>
#include <limits>
#include <vector>

#include "omnister/common/pose.h"
#include "omnister/sim/scene.h"
#include "sim/scene/texture.h"

namespace omnister::sim {

/// Hits further away than this are none [m].
inline constexpr double kFarthest = 1000.0;

struct Surface {
  enum class Kind { kPlane, kBox, kSphere };
  Kind kind = Kind::kPlane;
  Pose T_world_local = Pose::Identity();
  Pose T_local_world = Pose::Identity();
  /// Half extent along the local axes [m]. Planes lie in x and y (z is 0) and may be infinite; a
  /// sphere has its radius in each.
  Eigen::Vector3d half = Eigen::Vector3d::Zero();
  /// Planes: middle of the rectangle in local coordinates (boards are not centred on their frame)
  /// [m].
  Eigen::Vector2d middle = Eigen::Vector2d::Zero();
  /// One for each side of a box; planes: front (seen along +z) and back; spheres: the first.
  std::array<TexturePtr, 6> textures;
  /// A pattern whose edges must stand exactly: never left to the filter of a texture.
  bool sharp = false;

  /// Of the bounding sphere [m].
  double radius() const { return half.norm(); }
};

struct SceneData {
  Color background{150, 170, 190};
  double ambient = 0.6;
  Eigen::Vector3d light{0, -2, 0};
  std::vector<Surface> surfaces;
  std::vector<Scene::Board> boards;
};

}  // namespace omnister::sim
