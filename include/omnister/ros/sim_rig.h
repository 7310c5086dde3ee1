// SPDX-License-Identifier: Apache-2.0
/// @file A simulated camera on a simulated stage, under the same bodies as the real ones.
///
/// Everything of the camera stands in the namespace `camera` (`camera/image_raw`,
/// `camera/lens_model`, …), of the stage in `stage` (`stage/move_stage`, `stage/stage_state`, …).
/// Parameters of the camera's body are read from `~camera/…`, of the stage's from `~stage/…`, of
/// the simulation from `~…`. Note that `~lens` is the lens that the camera truly has; what its
/// driver knows of it is `~camera/lens`, nothing by default.
///
/// With `~boards`, the service `~show_board` (std_srvs/SetBool) carries a calibration board before
/// the camera, as a person would: true shows it at its next pose, false takes it away.
#pragma once

#include <ros/node_handle.h>
#include <std_srvs/SetBool.h>

#include <atomic>
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
  std::string scene;   ///< scene file
  std::string lens;    ///< lens file: the true lens and its image size
  std::string boards;  ///< scene file that lists the poses of the board; may be empty
  Pose camera_pose = Pose::Identity();  ///< T_world_optical at stage position 0
  sim::SimulatedStageOptions
      stage;                   ///< travel, max_speed, acceleration, homing_speed, start, homed
  sim::RenderOptions render;   ///< supersampling, adaptive, noise, vignetting, seed, color, threads
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
  /// Pose of the board that is seen; negative: it is not there.
  std::shared_ptr<std::atomic<int>> board_;
  ros::ServiceServer show_board_;
  std::shared_ptr<sim::SimulatedStage> stage_;
  std::unique_ptr<StageDriver> stage_driver_;
  std::unique_ptr<CameraDriver> camera_driver_;
};

}  // namespace omnister
