// SPDX-License-Identifier: Apache-2.0
/// @file Body of the calibration nodelet: collects views of a target, fits the lens, commits it.
#pragma once

#include <actionlib/client/simple_action_client.h>
#include <actionlib/server/simple_action_server.h>
#include <diagnostic_updater/diagnostic_updater.h>
#include <image_transport/image_transport.h>
#include <omnister/CalibrateAction.h>
#include <omnister/MoveStageAction.h>
#include <ros/ros.h>
#include <std_srvs/Trigger.h>

#include <condition_variable>
#include <filesystem>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>

#include "calibration/board/board_view_collector.h"
#include "omnister/calibration/calibrate.h"
#include "omnister/calibration/detector.h"
#include "omnister/calibration/target.h"
#include "ros/message/messages.h"
#include "ros/node/callback_threads.h"
#include "ros/node/parameters.h"

// See action_status.h; a document of actionlib, not of ours.
/// @cond
namespace actionlib {
template <>
void ActionServer<omnister::CalibrateAction>::publishStatus();
}  // namespace actionlib
/// @endcond

namespace omnister {

/// Private parameters of the calibration node.
struct CalibrationParameters {
  Target target;
  std::string model = "auto";
  std::filesystem::path store;         ///< folder that lens files go to, see LensStore
  std::string camera_name = "camera";  ///< name of the lens file in it
  int views = 25;
  double timeout = 300.0;         ///< until enough views are there [s]
  double dwell = 5.0;             ///< longest wait for a view at each stage position [s]
  std::vector<double> positions;  ///< of the stage, for goals that name none [m]
  bool start = false;             ///< collect from the beginning, without being asked
  CollectorOptions collector;
  DetectorOptions detector;
};

/// @throws InputError naming key, value and range, or the target file
CalibrationParameters loadCalibrationParameters(Parameters& parameters);

/// Action `calibrate`. Subscribes to `image_raw` only while it runs. Publishes `coverage` (while
/// somebody listens, and once more when all views are there) and latched `lens_model`. Views go to
/// `<store>/<camera_name>_detections.csv` before the fit, the lens to `<store>/<camera_name>.yaml`;
/// both whole or not at all. `residuals` (latched) shows how the fit went.
///
/// Views that were taken outlive a goal that ran out of time or was cancelled: the next one goes on
/// with them. Services for the hand: `~start` begins (or goes on), `~save` fits the views there are
/// and commits the lens, `~reset` forgets the views.
class CalibrationServer {
 public:
  /// Returns at once. @throws Error for parameters that do not hold
  CalibrationServer(const ros::NodeHandle& node, const ros::NodeHandle& private_node);
  ~CalibrationServer();
  CalibrationServer(const CalibrationServer&) = delete;
  CalibrationServer& operator=(const CalibrationServer&) = delete;

 private:
  using Server = actionlib::SimpleActionServer<CalibrateAction>;
  using Mover = actionlib::SimpleActionClient<MoveStageAction>;
  /// The goal was cancelled or replaced, or the node goes down.
  struct Preempted {};

  bool onStart(std_srvs::Trigger::Request&, std_srvs::Trigger::Response& response);
  bool onSave(std_srvs::Trigger::Request&, std_srvs::Trigger::Response& response);
  bool onReset(std_srvs::Trigger::Request&, std_srvs::Trigger::Response& response);
  void begin();
  void execute(const CalibrateGoalConstPtr& goal);
  CalibrateResult calibrateOnce(const CalibrateGoal& goal);
  void moveTo(double position);
  /// Waits until enough views are there, or `seconds` have passed. @return false after the time
  bool waitForViews(std::size_t views, double seconds);
  void checkPreempted();
  void feedback(const std::string& stage);
  void onImage(const sensor_msgs::ImageConstPtr& image);
  void run();
  void look(const sensor_msgs::ImageConstPtr& image);
  std::vector<std::string> guidance() const;  ///< mutex_ is held
  /// Writes the views to the store. @return the path
  std::filesystem::path keepViews(const Detections& detections) const;
  CalibrateResult fitAndCommit(const std::string& model);
  void publishPicture(const ros::Publisher& publisher, const cv::Mat& picture,
                      const std::string& frame_id, const ros::Time& stamp) const;
  void publishLens(const LensFile& file, const std::string& frame_id);
  void diagnose(diagnostic_updater::DiagnosticStatusWrapper& status);

  const CalibrationParameters parameters_;
  CallbackThreads callbacks_{2};  ///< before all that uses it; one may wait for a fit
  ros::NodeHandle node_;
  image_transport::ImageTransport transport_;
  image_transport::Subscriber image_subscriber_;
  ros::Publisher lens_publisher_;
  ros::Publisher coverage_publisher_;
  ros::Publisher residuals_publisher_;
  ros::Publisher goal_publisher_;  ///< of our own action, for ~start
  std::vector<ros::ServiceServer> services_;

  std::mutex mutex_;  ///< all below
  std::condition_variable wake_;
  std::condition_variable progress_;
  bool stopping_ = false;
  sensor_msgs::ImageConstPtr newest_;  ///< not yet looked at; older ones are dropped
  std::optional<ViewCollector> collector_;
  std::string frame_id_;
  std::string state_ = "idle";
  std::string last_problem_;
  std::size_t dropped_ = 0;
  bool save_now_ = false;         ///< asked for while views are collected
  std::size_t views_wanted_ = 0;  ///< by the goal under way

  std::mutex fit_mutex_;  ///< one fit at a time
  std::thread worker_;
  std::unique_ptr<Mover> mover_;
  bool moving_ = false;  ///< the stage, by our goal; thread of execute() only
  std::unique_ptr<Server> server_;
  diagnostic_updater::Updater diagnostics_;
  ros::SteadyTimer diagnostics_timer_;
};

}  // namespace omnister
