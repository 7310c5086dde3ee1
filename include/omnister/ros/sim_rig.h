// SPDX-License-Identifier: Apache-2.0
/// @file A simulated camera on a simulated stage, under the same bodies as the real ones.
///
/// Everything of the camera stands in the namespace `camera` (`camera/image_raw`,
/// `camera/lens_model`, …), of the stage in `stage` (`stage/move_stage`, `stage/stage_state`, …).
/// Parameters of the camera's body are read from `~camera/…`, of the stage's from `~stage/…`, of
/// the simulation from `~…`. Note that `~lens` is the lens that the camera truly has; what its
/// driver knows of it is `~camera/lens`, nothing by default.
#pragma once

#include <ros/node_handle.h>

#include <memory>
#include <string>

#include "omnister/common/pose.h"
#include "omnister/ros/camera_driver.h"
#include "omnister/ros/stage_driver.h"
#include "omnister/sim/simulated_camera.h"
#include "omnister/sim/simulated_stage.h"

namespace omnister {

/// Private parameters of the same names.
struct SimRigParameters {
  std::string scene;                    ///< scene file
  std::string lens;                     ///< lens file: the true lens and its image size
  Pose camera_pose = Pose::Identity();  ///< T_world_optical at stage position 0
  sim::SimulatedStageOptions
      stage;                   ///< travel, max_speed, acceleration, homing_speed, start, homed
  sim::RenderOptions render;   ///< supersampling, noise, vignetting, seed, color, threads
  double frame_rate_hz = 5.0;  ///< where ~camera/frame_rate names none
  double exposure_s = 0.005;   ///< where ~camera/exposure_us names none
};

/// @throws InputError naming key, value and range
SimRigParameters loadSimRigParameters(const ros::NodeHandle& private_node);

class SimRig {
 public:
  /// @throws Error for a broken scene or lens file
  SimRig(const ros::NodeHandle& node, const ros::NodeHandle& private_node,
         const SimRigParameters& parameters);

 private:
  std::shared_ptr<sim::SimulatedStage> stage_;
  std::unique_ptr<StageDriver> stage_driver_;
  std::unique_ptr<CameraDriver> camera_driver_;
};

}  // namespace omnister
