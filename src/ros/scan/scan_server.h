// SPDX-License-Identifier: Apache-2.0
/// @file Body of the scan node: moves the stage, waits until it and the picture stand still, and
/// tags the images with where they were taken.
///
/// Action `scan`. Subscribes to `image_raw` while a scan runs (the camera streams only then) and to
/// `stage_state`; moves by the action `move_stage`. Publishes `stage_frames` (StageFrame, one for
/// every image of a scan, those in motion too) and the settled images again as `scan/image_raw`,
/// for whoever wants no others.
#pragma once

#include <actionlib/client/simple_action_client.h>
#include <actionlib/server/simple_action_server.h>
#include <image_transport/image_transport.h>
#include <omnister/MoveStageAction.h>
#include <omnister/ScanAction.h>
#include <omnister/StageFrame.h>
#include <omnister/StageState.h>
#include <ros/ros.h>

#include <condition_variable>
#include <deque>
#include <filesystem>
#include <memory>
#include <mutex>
#include <opencv2/core/mat.hpp>
#include <optional>
#include <string>
#include <vector>

#include "ros/node/callback_threads.h"

// See action_status.h; a document of actionlib, not of ours.
/// @cond
namespace actionlib {
template <>
void ActionServer<omnister::ScanAction>::publishStatus();
}  // namespace actionlib
/// @endcond

namespace omnister {

/// Private parameters of the same names.
struct ScanParameters {
  double settle_time_s = 0.1;       ///< the stage rests this long before and after an image
  double settle_distance_m = 5e-5;  ///< and stays within this
  double still_px = 0.5;            ///< the picture moved less since the image before; 0: any
  double stop_timeout_s = 10.0;     ///< longest wait for settled images at a stop
  double max_wait_s = 1.0;          ///< for a reading of the stage after an image
  /// Recordings go into this folder and nowhere else; empty: `scans` in that of the calibrations.
  std::filesystem::path folder;
};

/// @throws InputError naming key, value and range
ScanParameters loadScanParameters(const ros::NodeHandle& private_node);

/// Positions of the stops of a goal; empty for a sweep.
/// @throws InputError for a goal that makes no sense
std::vector<double> stopsOf(const ScanGoal& goal);

class ScanServer {
 public:
  ScanServer(const ros::NodeHandle& node, const ScanParameters& parameters);
  /// Stops the stage where a scan moves it, and joins.
  ~ScanServer();
  ScanServer(const ScanServer&) = delete;
  ScanServer& operator=(const ScanServer&) = delete;

 private:
  using Server = actionlib::SimpleActionServer<ScanAction>;
  using Mover = actionlib::SimpleActionClient<MoveStageAction>;
  /// The goal was cancelled or replaced, or the node goes down.
  struct Preempted {};

  /// What is kept of a stage_state: no more than it can be asked for.
  struct Reading {
    ros::Time stamp;
    double position = 0.0;
    double velocity = 0.0;
    bool moving = false;
    bool homed = false;
    bool faulty = false;
  };
  struct Waiting {
    sensor_msgs::ImageConstPtr image;
    ros::SteadyTime since;
  };
  struct Tagged {
    StageFrame frame;
    std::string file;  ///< in the folder; empty: not kept
  };

  void execute(const ScanGoalConstPtr& goal);
  void run(const ScanGoal& goal);
  void runStops(const ScanGoal& goal, const std::vector<double>& stops);
  void runSweep(const ScanGoal& goal);
  void beginMove(double position, double speed);
  /// @return true once it has arrived. @throws Error when it cannot
  bool moveOver(double position);
  void moveTo(double position, double speed);
  /// The stage rests when this returns, whatever it was told before.
  void endMove();
  void checkPreempted();
  void feedback(const std::string& state);
  void pause();

  void onImage(const sensor_msgs::ImageConstPtr& image);
  void onState(const StageState::ConstPtr& state);
  void tagWaiting();
  /// @return false while the readings do not reach past the stamp
  bool tag(const sensor_msgs::ImageConstPtr& image, bool patient);
  bool restsAround(const ros::Time& stamp, bool* later) const;
  void keep(const sensor_msgs::Image& image, Tagged* tagged);
  void writeRecording();

  const ScanParameters parameters_;
  CallbackThreads callbacks_{2};  ///< before all that uses it
  ros::NodeHandle node_;
  image_transport::ImageTransport transport_;
  image_transport::Subscriber image_subscriber_;
  image_transport::Publisher image_publisher_;
  ros::Publisher frame_publisher_;
  ros::Subscriber state_subscriber_;

  std::mutex mutex_;  ///< all below
  std::condition_variable wake_;
  bool stopping_ = false;
  std::deque<Reading> readings_;  ///< oldest first, each with a stamp of its own
  std::deque<Waiting> waiting_;
  std::size_t dropped_ = 0;

  // Of the thread of execute().
  std::string scan_;
  std::filesystem::path folder_;
  std::string encoding_;
  std::uint32_t index_ = 0;
  std::uint32_t stops_ = 0;
  bool sweeping_ = false;
  ros::Time arrived_;  ///< images from before belong to the way here
  std::uint32_t settled_here_ = 0;
  std::vector<Tagged> tagged_;
  cv::Mat last_gray_;
  cv::Size size_;  ///< of the images that are kept
  std::string last_obstacle_;

  std::unique_ptr<Mover> mover_;
  bool moving_ = false;
  std::unique_ptr<Server> server_;
};

}  // namespace omnister
