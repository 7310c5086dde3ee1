// SPDX-License-Identifier: Apache-2.0
/// @file A camera that renders: what the lens sees of the scene from where it truly is.
#pragma once

#include <functional>
#include <memory>
#include <string>

#include "omnister/device/camera.h"
#include "omnister/lens/lens_model.h"
#include "omnister/sim/renderer.h"
#include "omnister/sim/simulated_stage.h"

namespace omnister::sim {

struct SimulatedCameraOptions {
  LensPtr lens;
  cv::Size size;               ///< [px]
  double frame_rate_hz = 5.0;  ///< at most; a slow machine renders fewer, with true stamps
  double exposure_s = 0.005;   ///< the stamp is its middle
  RenderOptions render;        ///< the seed of the noise changes from frame to frame
  std::string serial = "sim-camera";
};

/// T_world_camera at a time: where the optical frame truly was.
using PoseAt = std::function<Pose(Stamp)>;
/// The scene at a time.
using SceneAt = std::function<ScenePtr(Stamp)>;

/// @throws InputError for options out of range
std::unique_ptr<device::Camera> makeSimulatedCamera(const SimulatedCameraOptions& options,
                                                    SceneAt scene, PoseAt pose);

}  // namespace omnister::sim
