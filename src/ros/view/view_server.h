// SPDX-License-Identifier: Apache-2.0
/// @file Body of the view node and nodelet: what another camera, turned and zoomed at will, would
/// see from the same place, for nodes that know pinhole cameras only.
#pragma once

#include <diagnostic_updater/diagnostic_updater.h>
#include <dynamic_reconfigure/server.h>
#include <image_transport/image_transport.h>
#include <omnister/ViewConfig.h>
#include <ros/ros.h>

#include <memory>
#include <mutex>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "omnister/lens/lens_file.h"
#include "omnister/view/view.h"
#include "ros/message/image_input.h"
#include "ros/message/messages.h"
#include "ros/node/callback_threads.h"
#include "ros/node/parameters.h"
#include "ros/node/static_frames.h"

namespace omnister {

/// Private parameters of the view node; what cfg/View.cfg names can be changed live.
struct ViewParameters {
  ViewConfig view = ViewConfig::__getDefault__();
  std::string lens;      ///< lens file; empty: topic lens_model
  std::string frame_id;  ///< of the view; empty: CAMERA_optical gives CAMERA_view_optical
};

/// @throws InputError naming key, value and range
ViewParameters loadViewParameters(Parameters& parameters);

/// Publishes `view/image_raw` with `view/camera_info` (no distortion), and `view/depth/image_raw`
/// (32FC1, along the axis of the view) with `view/depth/camera_info`, made of the topics
/// `image_raw`, `range` and `lens_model`; each is subscribed to only while somebody listens to what
/// comes of it. A static tf carries the frame of the view. Panoramas come with an uncalibrated
/// camera_info, and their depth is the range along the ray.
class ViewServer {
 public:
  /// Returns at once. @throws Error for parameters that do not hold
  ViewServer(const ros::NodeHandle& node, const ros::NodeHandle& private_node);
  ~ViewServer();
  ViewServer(const ViewServer&) = delete;
  ViewServer& operator=(const ViewServer&) = delete;

 private:
  /// Made for one lens and one setting.
  struct Maps {
    ViewGeometry geometry;
    LensFile lens;
    bool anti_alias = true;
    std::unique_ptr<View> image;       // made when first wanted
    std::unique_ptr<DepthView> depth;  // likewise
  };
  /// What became of the messages of one input.
  struct Tally {
    std::uint64_t received = 0;
    std::uint64_t published = 0;
    std::uint64_t missed = 0;  ///< they came faster than they could be taken in
    std::uint64_t failed = 0;
    MissingMessages numbers;
    void take(const std_msgs::Header& header);
  };

  void configure(ViewConfig& config);
  void onConnection();
  void onLens(const LensModelMessage::ConstPtr& message);
  void onImage(const sensor_msgs::ImageConstPtr& image);
  void onRange(const sensor_msgs::ImageConstPtr& range);
  Maps& maps();  ///< mutex_ is held. @throws Error while there is no lens
  /// mutex_ is held. Tells tf where the view is. @return its frame
  const std::string& frameFor(const std::string& camera_frame);
  sensor_msgs::CameraInfo info(const ViewGeometry& geometry, const std_msgs::Header& header) const;
  void say(const std::exception& error);
  /// Publishes nothing for this message. @param tally of its input
  void drop(Tally& tally, const std::exception& error);
  void diagnose(diagnostic_updater::DiagnosticStatusWrapper& status);

  const ViewParameters parameters_;
  CallbackThreads callbacks_;  // before all that uses it
  ros::NodeHandle node_;
  image_transport::ImageTransport transport_;

  image_transport::CameraPublisher image_publisher_;
  image_transport::CameraPublisher depth_publisher_;
  image_transport::Subscriber image_subscriber_;
  ros::Subscriber range_subscriber_;
  ros::Subscriber lens_subscriber_;

  std::mutex mutex_;  ///< all below
  ViewConfig config_;
  std::optional<LensFile> lens_;
  std::string lens_text_;
  ros::Time lens_stamp_;
  std::optional<Maps> maps_;
  Tally images_;
  Tally ranges_;
  std::string problem_;  ///< with the last message; empty when there is none
  std::string camera_frame_;
  std::set<std::string> told_frames_;  ///< of cameras, to tf
  std::string view_frame_;
  Eigen::Matrix3d told_rotation_ = Eigen::Matrix3d::Zero();  ///< of the last static tf
  std::shared_ptr<StaticFrames> static_frames_ = StaticFrames::shared();

  boost::recursive_mutex config_mutex_;
  std::unique_ptr<dynamic_reconfigure::Server<ViewConfig>> config_server_;
  diagnostic_updater::Updater diagnostics_;
  ros::SteadyTimer diagnostics_timer_;
};

}  // namespace omnister
