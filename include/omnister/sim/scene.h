// SPDX-License-Identifier: Apache-2.0
/// @file Scenes to render: textured planes, boxes and calibration boards, from YAML.
#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "omnister/calibration/target.h"
#include "omnister/common/pose.h"

namespace omnister::sim {

class Scene;
using ScenePtr = std::shared_ptr<const Scene>;

/// Immutable once read. The world frame is the scene's own; metres. The format is documented at the top
/// of scene.cpp and in the README.
/// @throws InputError naming key, value and what was expected
ScenePtr parseScene(std::string_view text, std::string_view source,
                    const std::filesystem::path& folder = ".");
ScenePtr readScene(const std::filesystem::path& path);

}  // namespace omnister::sim
