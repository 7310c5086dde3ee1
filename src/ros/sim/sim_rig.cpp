// SPDX-License-Identifier: Apache-2.0
#include "ros/sim/sim_rig.h"

#include <cmath>
#include <iterator>
#include <sstream>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_file.h"
#include "ros/message/conversions.h"
#include "ros/node/parameters.h"

namespace omnister {
namespace {

/// Where links to serial ports may be made by anybody who runs a rig.
std::string defaultPort() {
  const char* runtime = getenv("XDG_RUNTIME_DIR");
  return std::string(runtime && *runtime ? runtime : "/tmp") + "/omnister_stage";
}

/// A number among the words of a fault. @throws InputError where there is none
double numberOf(const std::vector<std::string>& words, std::size_t index) {
  const auto numbers = index < words.size() ? parseNumbers(words[index]) : std::nullopt;
  if (!numbers || numbers->size() != 1 || !(numbers->front() >= 0.0 && numbers->front() <= 1e5))
    throw InputError("~fault", "", "expected a number from 0 to 100000");
  return numbers->front();
}

}  // namespace

SimRigParameters loadSimRigParameters(const ros::NodeHandle& private_node) {
  Parameters source(private_node);
  SimRigParameters p;
  p.scene = source.text("scene", "");
  p.lens = source.text("lens", "");
  p.boards = source.text("boards", "");
  p.camera_pose = source.pose("camera_pose", p.camera_pose);
  p.axis = source.direction("axis", p.axis);
  p.stage.travel_m = source.number("travel", p.stage.travel_m, 1e-3, 100.0, "m");
  p.stage.max_speed_mps = source.number("max_speed", p.stage.max_speed_mps, 1e-6, 100.0, "m/s");
  p.stage.acceleration_mps2 =
      source.number("acceleration", p.stage.acceleration_mps2, 1e-6, 1000.0, "m/s^2");
  p.stage.homing_speed_mps =
      source.number("homing_speed", p.stage.homing_speed_mps, 1e-6, 100.0, "m/s");
  p.stage.start_m = source.number("start", p.stage.start_m, 0.0, p.stage.travel_m, "m");
  p.stage.homed = source.flag("homed", p.stage.homed);
  p.controller = source.choice("controller", p.controller, {"zaber", "grbl"});
  p.port = source.text("port", defaultPort());
  p.unit_m = source.number("unit_m", p.unit_m, 1e-10, 1e-3, "m");
  p.camera.interface = source.text("camera_address", p.camera.interface);
  p.camera.serial = source.text("camera_serial", p.camera.serial);
  p.camera.frame_rate_hz = source.number("frame_rate", p.camera.frame_rate_hz, 0.05, 1000.0, "Hz");
  p.camera.exposure_us = source.number("exposure_us", p.camera.exposure_us, 10.0, 1e6, "us");
  p.camera.packet_loss = source.number("packet_loss", p.camera.packet_loss, 0.0, 1.0);
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

std::string SimRig::stageDevice() const {
  return parameters_.controller + ":" + parameters_.port.string();
}

SimRig::SimRig(const ros::NodeHandle& private_node, const SimRigParameters& parameters)
    : parameters_(parameters),
      board_(std::make_shared<std::atomic<int>>(-1)),
      stage_(std::make_shared<sim::SimulatedStage>(parameters.stage)) {
  const auto read = [&private_node](const char* key, const auto& reader, const std::string& file) {
    return fromFileOf(private_node, key, [&] { return reader(file); });
  };
  const sim::ScenePtr scene = read("scene", sim::readScene, parameters.scene);
  std::vector<sim::ScenePtr> with_board;
  if (!parameters.boards.empty()) {
    const sim::ScenePtr boards = read("boards", sim::readScene, parameters.boards);
    for (std::size_t i = 0; i < boards->boards().size(); ++i) {
      with_board.push_back(sim::withBoard(*scene, *boards, i));
    }
    if (with_board.empty()) throw InputError(parameters.boards, "objects", "hold no board");
  }
  const LensFile truth = read("lens", readLensFile, parameters.lens);

  if (parameters.controller == "grbl") {
    sim::GrblOptions options;
    options.link = parameters.port;
    controller_ = std::make_unique<sim::GrblSimulator>(options, stage_, parameters.stage);
  } else {
    sim::ZaberOptions options;
    options.link = parameters.port;
    options.unit_m = parameters.unit_m;
    controller_ = std::make_unique<sim::ZaberSimulator>(options, stage_, parameters.stage);
  }

  sim::GigeServerOptions camera = parameters.camera;
  camera.size = truth.image_size;
  camera.color = parameters.render.color;
  const auto renderer =
      std::make_shared<sim::Renderer>(*truth.lens, truth.image_size, parameters.render.threads);
  const Eigen::Vector3d direction = opticalInLink().linear().transpose() * parameters.axis;
  const sim::DrawFrame draw = [renderer, scene, with_board, direction, board = board_,
                               stage = stage_, view = view_, pose = parameters.camera_pose,
                               render = parameters.render](device::Stamp time) mutable {
    if (view->frozen) throw Error("the camera is frozen");
    const int shown = board->load();
    const sim::ScenePtr& seen = shown < 0 ? scene : with_board[static_cast<std::size_t>(shown)];
    ++render.seed;
    const double slipped = view->slipped_at;
    const double position = std::isnan(slipped) ? stage->truePosition(time) : slipped;
    const Pose T_world_optical = pose * Eigen::Translation3d(direction * position);
    return renderer->render(*seen, T_world_optical, render).image;
  };
  power_up_ = [camera, draw] { return std::make_unique<sim::GigeServer>(camera, draw); };
  server_ = power_up_();
  fault_subscriber_ = ros::NodeHandle(private_node).subscribe("fault", 10, &SimRig::onFault, this);
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
}

void SimRig::onFault(const std_msgs::String& message) {
  try {
    std::istringstream text(message.data.substr(0, 100));
    const std::vector<std::string> words{std::istream_iterator<std::string>(text), {}};
    if (words.size() < 2)
      throw InputError("~fault", "", "expected a part and what is wrong with it");
    words[0] == "camera" ? cameraFault(words) : stageFault(words);
    ROS_WARN("fault: %s", printable(message.data, 100).c_str());
  } catch (const std::exception& error) {
    ROS_ERROR("fault \"%s\": %s", printable(message.data, 100).c_str(), error.what());
  }
}

void SimRig::cameraFault(const std::vector<std::string>& words) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const std::string& what = words[1];
  if (what == "freeze" || what == "thaw") {
    view_->frozen = what == "freeze";
  } else if (what == "off") {
    server_.reset();
  } else if (what == "on") {
    if (!server_) server_ = power_up_();
  } else if (what == "loss" && server_) {
    server_->setPacketLoss(numberOf(words, 2));
  } else if (what == "size" && server_) {
    server_->setRegion(
        {static_cast<int>(numberOf(words, 2)), static_cast<int>(numberOf(words, 3))});
  } else {
    throw InputError("~fault", "camera", "cannot do that now");
  }
}

void SimRig::stageFault(const std::vector<std::string>& words) {
  const std::string& what = words[1];
  if (what == "stall") {
    stage_->stall();
  } else if (what == "reset") {
    controller_->powerCycle();
  } else if (what == "unplug") {
    controller_->unplug();
  } else if (what == "plug") {
    controller_->plugIn();
  } else if (what == "freeze" || what == "thaw") {
    controller_->freeze(what == "freeze");
  } else if (what == "garble") {
    sim::WireFaults faults;
    faults.garble = numberOf(words, 2);
    controller_->setFaults(faults);
  } else if (what == "slip") {
    view_->slipped_at = stage_->truePosition(device::now());
  } else if (what == "grip") {
    view_->slipped_at = std::nan("");
  } else {
    throw InputError("~fault", "", "is none of those of a camera or a stage");
  }
}

}  // namespace omnister
