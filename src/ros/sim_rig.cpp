// SPDX-License-Identifier: Apache-2.0
#include "omnister/ros/sim_rig.h"

#include <vector>

#include "omnister/ros/conversions.h"
#include "omnister/ros/parameters.h"

namespace omnister {
namespace {

/// The stage of the rig outlives its driver, as hardware does: the driver opens and closes a link
/// to it.
class LinkToStage : public device::Stage {
 public:
  explicit LinkToStage(std::shared_ptr<sim::SimulatedStage> stage) : stage_(std::move(stage)) {}
  device::StageIdentity identity() const override { return stage_->identity(); }
  device::StageReading read() override { return stage_->read(); }
  void moveTo(double position_m, double speed_mps) override {
    stage_->moveTo(position_m, speed_mps);
  }
  void stop() override { stage_->stop(); }
  void home() override { stage_->home(); }
  void recover() override { stage_->recover(); }

 private:
  std::shared_ptr<sim::SimulatedStage> stage_;
};

}  // namespace

SimRigParameters loadSimRigParameters(const ros::NodeHandle& private_node) {
  Parameters source(private_node);
  SimRigParameters p;
  p.scene = source.text("scene", "");
  p.lens = source.text("lens", "");
  p.boards = source.text("boards", "");
  p.camera_pose = source.pose("camera_pose", p.camera_pose);
  p.stage.travel_m = source.number("travel", p.stage.travel_m, 1e-3, 100.0, "m");
  p.stage.max_speed_mps = source.number("max_speed", p.stage.max_speed_mps, 1e-6, 100.0, "m/s");
  p.stage.acceleration_mps2 =
      source.number("acceleration", p.stage.acceleration_mps2, 1e-6, 1000.0, "m/s^2");
  p.stage.homing_speed_mps =
      source.number("homing_speed", p.stage.homing_speed_mps, 1e-6, 100.0, "m/s");
  p.stage.start_m = source.number("start", p.stage.start_m, 0.0, p.stage.travel_m, "m");
  p.stage.homed = source.flag("homed", p.stage.homed);
  p.render.supersampling = source.integer("supersampling", 2, 1, 16);
  p.render.adaptive = source.flag("adaptive", false);
  p.render.noise_sigma = source.number("noise", 0.0, 0.0, 255.0, "grey levels");
  p.render.vignetting = source.number("vignetting", 0.0, 0.0, 1.0);
  p.render.seed = static_cast<std::uint64_t>(source.integer("seed", 1, 0, 2147483647));
  p.render.color = source.flag("color", true);
  p.render.threads = source.integer("threads", 0, 0, 1024);
  source.warnUnknown();
  return p;
}

SimRig::SimRig(const ros::NodeHandle& node, const ros::NodeHandle& private_node,
               const SimRigParameters& parameters)
    : board_(std::make_shared<std::atomic<int>>(-1)),
      stage_(std::make_shared<sim::SimulatedStage>(parameters.stage)) {
  const sim::ScenePtr scene = sim::readScene(parameters.scene);
  std::vector<sim::ScenePtr> with_board;
  if (!parameters.boards.empty()) {
    const sim::ScenePtr boards = sim::readScene(parameters.boards);
    for (std::size_t i = 0; i < boards->boards().size(); ++i) {
      with_board.push_back(sim::withBoard(*scene, *boards, i));
    }
    if (with_board.empty()) throw InputError(parameters.boards, "objects", "hold no board");
  }
  const LensFile truth = readLensFile(parameters.lens);

  const ros::NodeHandle stage_private(private_node, "stage");
  StageParameters stage_defaults;
  stage_defaults.max_m = parameters.stage.travel_m;
  // The link's y points left: a positive position is to the right.
  stage_defaults.axis = -Eigen::Vector3d::UnitY();
  const StageParameters stage_parameters = loadStageParameters(stage_private, stage_defaults);

  const ros::NodeHandle camera_private(private_node, "camera");
  CameraParameters camera_parameters = loadCameraParameters(camera_private);
  if (camera_parameters.parent_frame_id.empty()) {
    camera_parameters.parent_frame_id = stage_parameters.child_frame_id;
  }

  const Pose T_carriage_optical = camera_parameters.mount * opticalInLink();
  const Pose T_world_base = parameters.camera_pose * T_carriage_optical.inverse();
  const sim::PoseAt pose = [stage = stage_, T_world_base, T_carriage_optical,
                            axis = stage_parameters.axis](device::Stamp time) -> Pose {
    return T_world_base * Eigen::Translation3d(axis * stage->truePosition(time)) *
           T_carriage_optical;
  };
  const sim::SceneAt scene_at = [scene, with_board, board = board_](device::Stamp) {
    const int pose = board->load();
    return pose < 0 ? scene : with_board[static_cast<std::size_t>(pose)];
  };
  if (!with_board.empty()) {
    using Request = std_srvs::SetBool::Request;
    using Response = std_srvs::SetBool::Response;
    ros::NodeHandle service_node = private_node;
    show_board_ = service_node.advertiseService<Request, Response>(
        "show_board", [board = board_, poses = static_cast<int>(with_board.size()), next = 0](
                          Request& request, Response& response) mutable {
          board->store(request.data ? next : -1);
          response.message = request.data ? "pose " + std::to_string(next) : "gone";
          next = request.data ? (next + 1) % poses : 0;
          response.success = true;
          return true;
        });
  }

  stage_driver_ = std::make_unique<StageDriver>(
      ros::NodeHandle(node, "stage"), stage_private, stage_parameters,
      [stage = stage_] { return std::make_unique<LinkToStage>(stage); });
  camera_driver_ = std::make_unique<CameraDriver>(
      ros::NodeHandle(node, "camera"), camera_private, camera_parameters,
      [parameters, truth, scene_at, pose](const CameraParameters& camera) {
        sim::SimulatedCameraOptions options;
        options.lens = truth.lens;
        options.size = truth.image_size;
        options.render = parameters.render;
        options.frame_rate_hz = camera.settings.frame_rate_hz > 0.0 ? camera.settings.frame_rate_hz
                                                                    : parameters.frame_rate_hz;
        options.exposure_s = camera.settings.exposure_us ? *camera.settings.exposure_us * 1e-6
                                                         : parameters.exposure_s;
        return sim::makeSimulatedCamera(options, scene_at, pose);
      });
}

}  // namespace omnister
