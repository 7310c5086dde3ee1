// SPDX-License-Identifier: Apache-2.0
/// @file Scenes to render: textured planes, boxes, spheres and calibration boards, from YAML.
///
/// Format, version 1. Lengths in metres, angles in degrees, colours as [red, green, blue] of 0 to
/// 255. The world frame has the axes of an optical frame: x right, y down, z forward, so that a
/// camera at the identity pose looks along +z. Unknown keys are refused.
///
///     version: 1
///     background: [150, 170, 190]      # where a ray meets nothing
///     ambient: 0.6                     # 0 to 1: light from all around; the rest comes from the
///     lamp light: [0, -2, 1]                # the lamp's position; faces square to it are
///     brightest textures:                        # by name
///       wall:  {type: noise, colors: [[60, 50, 40], [220, 215, 200]], scale: 0.4, octaves: 7,
///               persistence: 0.8, contrast: 1, seed: 3}
///       plain: {type: solid, color: [200, 200, 200]}
///       tiles: {type: checker, size: 0.3, colors: [[…], […]]}
///       stone: {type: bricks, size: [0.25, 0.08], mortar: 0.01, variation: 0.3, seed: 1,
///               colors: [[…], […]]}    # brick, mortar
///       spots: {type: dots, size: 0.05, radius: 0.015, share: 0.8, seed: 1, colors: [[…], […]]}
///       photo: {type: image, file: picture.png, width: 1.2}       # metres across; repeats
///       # Each type but noise may carry `grain: {scale, octaves, persistence, contrast, seed}`:
///       # noise that multiplies the colour, so that surfaces can be told apart everywhere.
///     objects:
///       - {type: plane, position: [0, 0, 3], rotation: [0, 20, 0], size: [2, 1], texture: wall}
///       - {type: box, position: [0, 0, 2], size: [5, 3, 6], texture: wall}   # from inside: a room
///       - {type: sphere, position: [1, 0, 2], radius: 0.3, texture: spots}
///       - {type: board, target: {type: checkerboard, cols: 8, rows: 6, square_m: 0.03},
///          position: [0, 0, 1], rotation: [0, 0, 0], margin: 0.03, dark: 20, light: 235}
///
/// `position` is the centre of a plane, box or sphere, and the frame of the target (its first
/// point) of a board. `rotation: [x, y, z]` turns about the fixed x, then y, then z axis;
/// `quaternion: [x, y, z, w]` may stand instead. A plane spans its own x and y; without `size` it
/// is infinite. A box takes `textures: [left, right, top, bottom, near, far]` (-x, +x, -y, +y, -z,
/// +z) in place of `texture`.
#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "omnister/calibration/target.h"
#include "omnister/common/pose.h"

namespace omnister::sim {

struct SceneData;
class Scene;
using ScenePtr = std::shared_ptr<const Scene>;

/// Immutable, so safe to share between threads.
class Scene {
 public:
  struct Board {
    Target target;
    Pose T_world_board = Pose::Identity();  ///< maps the target's frame into the world
  };

  explicit Scene(std::unique_ptr<const SceneData> data);
  ~Scene();
  Scene(const Scene&) = delete;
  Scene& operator=(const Scene&) = delete;

  /// Calibration boards in the order of the file.
  const std::vector<Board>& boards() const;

  /// Distance to the first surface, in double precision: the truth that images are tested against.
  /// @param origin in the world [m]  @param direction in the world, any length > 0
  /// @return distance along the ray [m]; nullopt when it meets nothing within 1 km
  std::optional<double> rangeAlong(const Eigen::Vector3d& origin,
                                   const Eigen::Vector3d& direction) const;

  /// For the renderer.
  const SceneData& data() const { return *data_; }

 private:
  std::unique_ptr<const SceneData> data_;
};

/// @param folder where image files with relative names lie
/// @throws InputError naming key, value and what was expected
ScenePtr parseScene(std::string_view text, std::string_view source,
                    const std::filesystem::path& folder = ".");

/// @throws IoError or InputError
ScenePtr readScene(const std::filesystem::path& path);

/// The scene with one board more, taken from another scene: a board that is carried about is a
/// scene that lists one board for each pose.
/// @param index into boards.boards()  @throws Error when there is no such board
ScenePtr withBoard(const Scene& scene, const Scene& boards, std::size_t index);

}  // namespace omnister::sim
