// SPDX-License-Identifier: Apache-2.0
// Keeps a nodelet in a manager: `nodelet_node TYPE MANAGER`. As `nodelet load` does, it loads the
// nodelet under its own name with its own remappings and unloads it at its end; but a manager that
// died and came back gets it again at once, where a broken bond is noticed after four seconds only
// and ends the loader.
#include <nodelet/NodeletList.h>
#include <nodelet/NodeletLoad.h>
#include <nodelet/NodeletUnload.h>
#include <ros/ros.h>
#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <memory>
#include <string>
#include <utility>

#include "omnister/common/error.h"
#include "ros/node/logger_service.h"
#include "ros/node/run_node.h"

namespace {

std::atomic<bool> stop{false};

// What still waits for a master or a manager this long after it was told to end waits no more [s].
constexpr unsigned kPatience = 3;

void onSignal(int /*number*/) {
  stop = true;
  alarm(kPatience);
}

void onAlarm(int /*number*/) { ros::requestShutdown(); }

class Keeper {
 public:
  Keeper(std::string type, const std::string& manager) : type_(std::move(type)) {
    const std::string name = ros::names::resolve(manager);
    list_ = name + "/list";
    load_ = name + "/load_nodelet";
    unload_ = name + "/unload_nodelet";
  }

  /// Until it is told to end. @return false where the nodelet cannot be loaded
  bool run() {
    bool told = false;
    while (!stop && ros::ok()) {
      ros::ServiceClient manager = node_.serviceClient<nodelet::NodeletList>(list_, true);
      if (!manager.isValid() || !manager.exists()) {
        if (!std::exchange(told, true)) ROS_INFO("waiting for the manager of %s", list_.c_str());
        ros::WallDuration(0.1).sleep();
        continue;
      }
      told = false;
      if (!isLoaded(manager) && manager.isValid() && !load()) {
        // One that dies while it loads comes back; one that refuses will do so again.
        if (isThere()) return false;
        continue;
      }
      // The connection breaks with the manager.
      while (!stop && ros::ok() && isLoaded(manager)) ros::WallDuration(0.25).sleep();
      if (!stop && ros::ok())
        ROS_WARN("%s is gone from its manager, loading it again", name().c_str());
    }
    if (isThere()) unload();
    return true;
  }

 private:
  static const std::string& name() { return ros::this_node::getName(); }

  bool isThere() {
    ros::ServiceClient manager = node_.serviceClient<nodelet::NodeletList>(list_);
    nodelet::NodeletList list;
    return manager.call(list);
  }

  static bool isLoaded(ros::ServiceClient& manager) {
    nodelet::NodeletList list;
    if (!manager.call(list)) return false;
    const auto& names = list.response.nodelets;
    return std::find(names.begin(), names.end(), name()) != names.end();
  }

  bool load() {
    nodelet::NodeletLoad request;
    request.request.name = name();
    request.request.type = type_;
    for (const auto& [from, to] : ros::names::getRemappings()) {
      request.request.remap_source_args.push_back(from);
      request.request.remap_target_args.push_back(to);
    }
    return ros::service::call(load_, request) && request.response.success != 0;
  }

  void unload() {
    nodelet::NodeletUnload request;
    request.request.name = name();
    ros::service::call(unload_, request);
  }

  ros::NodeHandle node_;
  const std::shared_ptr<omnister::LoggerService> loggers_ = omnister::LoggerService::shared();
  const std::string type_;
  std::string list_;
  std::string load_;
  std::string unload_;
};

}  // namespace

int main(int argc, char** argv) {
  if (!omnister::initNode(argc, argv, "nodelet", ros::init_options::NoSigintHandler)) return 1;
  if (argc != 3) {
    std::fprintf(stderr, "usage: nodelet_node TYPE MANAGER\n");
    return 2;
  }
  // Until there is a master, signals end it on the spot.
  const ros::NodeHandle keep;
  signal(SIGALRM, onAlarm);
  signal(SIGINT, onSignal);
  signal(SIGTERM, onSignal);
  if (signal(SIGHUP, onSignal) == SIG_IGN) signal(SIGHUP, SIG_IGN);
  Keeper keeper(argv[1], argv[2]);
  if (keeper.run()) return 0;
  ROS_FATAL("the manager %s does not load %s: it says why",
            omnister::printable(argv[2], 200).c_str(), omnister::printable(argv[1], 200).c_str());
  return 1;
}
