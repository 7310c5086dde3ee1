// SPDX-License-Identifier: Apache-2.0
/// @file The hardware of a simulated rig: a GigE Vision camera on the network and a stage
/// controller on a serial port. The camera shows the scene from where the stage's carriage truly
/// stands. Drivers talk to it as to any other: `aravis:SERIAL`, `zaber:PORT` or `grbl:PORT`.
///
/// With `~boards`, the service `~show_board` (std_srvs/SetBool) carries a calibration board before
/// the camera, as a person would: true shows it at its next pose, false takes it away.
///
/// What goes wrong with hardware goes wrong here by a word on the topic `~fault` (std_msgs/String):
/// - `camera off`, `camera on`: its power
/// - `camera freeze`, `camera thaw`: it answers and gives no frames
/// - `camera loss 0.3`: a share of the packets gets lost
/// - `camera size 200 150`: another region while it streams [px]
/// - `stage stall`, `stage reset`: the motor; the power goes and comes
/// - `stage unplug`, `stage plug`: the cable
/// - `stage freeze`, `stage thaw`: it answers nothing
/// - `stage garble 0.1`: a share of the lines on the cable is not what was said
/// - `stage slip`, `stage grip`: the carriage does not follow, whatever the controller says
#pragma once

#include <ros/node_handle.h>
#include <std_msgs/String.h>
#include <std_srvs/SetBool.h>

#include <Eigen/Core>
#include <atomic>
#include <cmath>
#include <filesystem>
#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "omnister/common/pose.h"
#include "omnister/sim/gige_server.h"
#include "omnister/sim/renderer.h"
#include "omnister/sim/scene.h"
#include "omnister/sim/serial_devices.h"
#include "omnister/sim/simulated_stage.h"

namespace omnister {

/// Private parameters; names, ranges and units are in docs/nodes.md.
struct SimRigParameters {
  std::string scene;   ///< scene file
  std::string lens;    ///< lens file: the true lens and its image size
  std::string boards;  ///< scene file that lists the poses of the board; may be empty
  Pose camera_pose = Pose::Identity();  ///< T_world_optical at stage position 0
  /// Of travel, in a frame with x forward, y left, z up as seen from the camera. The default is to
  /// the right.
  Eigen::Vector3d axis = -Eigen::Vector3d::UnitY();
  sim::SimulatedStageOptions stage;
  sim::RenderOptions render;         ///< the seed of the noise changes from frame to frame
  sim::GigeServerOptions camera;     ///< size and colour are those of lens and renderer
  std::string controller = "zaber";  ///< or grbl
  std::filesystem::path port;        ///< link that is made to the controller's end of the cable
  double unit_m = 4.9609375e-7;      ///< of the Zaber's microstep
};

/// @throws InputError naming key, value and range
SimRigParameters loadSimRigParameters(const ros::NodeHandle& private_node);

class SimRig {
 public:
  /// @throws Error for a broken scene or lens file, a port or address that cannot be had
  SimRig(const ros::NodeHandle& private_node, const SimRigParameters& parameters);

  std::string cameraDevice() const { return "aravis:" + parameters_.camera.serial; }
  std::string stageDevice() const;
  sim::SimulatedStage& stage() { return *stage_; }

 private:
  /// What the picture depends on beside the stage; shared with the thread that draws.
  struct View {
    std::atomic<bool> frozen{false};
    std::atomic<double> slipped_at{std::nan("")};  ///< where the carriage hangs [m]
  };

  void onFault(const std_msgs::String& message);
  void cameraFault(const std::vector<std::string>& words);
  void stageFault(const std::vector<std::string>& words);

  const SimRigParameters parameters_;
  /// Pose of the board that is seen; negative: it is not there.
  std::shared_ptr<std::atomic<int>> board_;
  ros::ServiceServer show_board_;
  std::shared_ptr<sim::SimulatedStage> stage_;
  std::unique_ptr<sim::SerialStageDevice> controller_;
  const std::shared_ptr<View> view_ = std::make_shared<View>();
  std::function<std::unique_ptr<sim::GigeServer>()> power_up_;  ///< of the camera
  std::mutex mutex_;                                            ///< server_
  std::unique_ptr<sim::GigeServer> server_;
  ros::Subscriber fault_subscriber_;
};

}  // namespace omnister
