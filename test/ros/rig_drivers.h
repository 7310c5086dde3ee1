// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>

#include "ros/camera/camera_driver.h"
#include "ros/sim/sim_rig.h"
#include "ros/stage/stage_driver.h"
#include "temporary_folder.h"

namespace omnister::test {

/// A simulated rig and the drivers that talk to it, as camera_node and stage_node do: the camera in
/// the namespace `camera`, the stage in `stage`.
class RigWithDrivers {
 public:
  RigWithDrivers(const ros::NodeHandle& node, const ros::NodeHandle& private_node,
                 SimRigParameters parameters)
      : rig_(private_node, inFolder(std::move(parameters), folder_)) {
    StageParameters stage;
    stage.device = rig_.stageDevice();
    stage.settings.unit_m = SimRigParameters().unit_m;
    stage.axis = SimRigParameters().axis;
    const ros::NodeHandle stage_node(node, "stage");
    stage_ = std::make_unique<StageDriver>(stage_node, ros::NodeHandle(private_node, "stage"),
                                           stage, stageOpener(stage_node, stage));
    CameraParameters camera;
    camera.device = rig_.cameraDevice();
    camera.store = folder_.path().string();
    camera.parent_frame_id = stage.child_frame_id;
    camera_ = std::make_unique<CameraDriver>(ros::NodeHandle(node, "camera"),
                                             ros::NodeHandle(private_node, "camera"), camera);
  }
  SimRig& rig() { return rig_; }

 private:
  static SimRigParameters inFolder(SimRigParameters parameters, const TemporaryFolder& folder) {
    parameters.port = folder.path() / "stage";
    return parameters;
  }

  TemporaryFolder folder_;
  SimRig rig_;
  std::unique_ptr<StageDriver> stage_;
  std::unique_ptr<CameraDriver> camera_;
};

}  // namespace omnister::test
