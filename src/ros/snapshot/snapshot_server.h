// SPDX-License-Identifier: Apache-2.0
/// @file Body of the snapshot node: writes one cloud and its range image to files on request.
#pragma once

#include <ros/ros.h>
#include <std_srvs/Trigger.h>

#include <atomic>
#include <filesystem>
#include <string>

#include "ros/node/callback_threads.h"

namespace omnister {

/// Service `~save` (std_srvs/Trigger): waits for the next cloud on `points2` and the range image on
/// `range` of the same stamp, and writes both to the files that the parameters `~cloud` (.ply or
/// .pcd) and `~range`
/// (.tiff) name: both or none. A second call meanwhile is refused. Paths come from parameters only,
/// never from a message. Subscribes only while it waits.
class SnapshotServer {
 public:
  /// @throws Error for parameters that do not hold
  SnapshotServer(const ros::NodeHandle& node, const ros::NodeHandle& private_node);
  ~SnapshotServer() { callbacks_.stop(); }
  SnapshotServer(const SnapshotServer&) = delete;
  SnapshotServer& operator=(const SnapshotServer&) = delete;

 private:
  bool onSave(std_srvs::Trigger::Request& request, std_srvs::Trigger::Response& response);
  std::string save() const;

  CallbackThreads callbacks_{2};  // before all that uses it; one waits, the other refuses
  ros::NodeHandle node_;
  std::filesystem::path cloud_path_;
  std::filesystem::path range_path_;
  double timeout_ = 30.0;  ///< until a cloud comes [s]
  std::atomic<bool> busy_{false};
  ros::ServiceServer service_;
};

}  // namespace omnister
