// SPDX-License-Identifier: Apache-2.0
/// @file Body of the stereo node and nodelet: images in, organized clouds out.
#pragma once

#include <diagnostic_updater/diagnostic_updater.h>
#include <dynamic_reconfigure/server.h>
#include <geometry_msgs/Point.h>
#include <geometry_msgs/PointStamped.h>
#include <image_transport/image_transport.h>
#include <image_transport/subscriber_filter.h>
#include <message_filters/pass_through.h>
#include <message_filters/sync_policies/approximate_time.h>
#include <message_filters/synchronizer.h>
#include <omnister/StereoConfig.h>
#include <ros/ros.h>
#include <sensor_msgs/PointCloud2.h>
#include <tf2_ros/buffer.h>

#include <array>
#include <condition_variable>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "health/clock_watch.h"
#include "omnister/lens/lens_file.h"
#include "omnister/stereo/matcher.h"
#include "ros/message/image_input.h"
#include "ros/message/messages.h"
#include "ros/message/transform_input.h"
#include "ros/node/callback_threads.h"
#include "ros/node/parameters.h"
#include "ros/stereo/drift_diagnostic.h"
#include "ros/stereo/stereo_parameters.h"
#include "stereo/session/frame_pairing.h"
#include "stereo/session/stereo_worker.h"

namespace omnister {

/// Subscribes only while somebody listens to `points2`, `depth`, `range` or `epipolar`. Matching
/// has its own thread and takes the newest set; whatever it cannot keep up with is dropped and
/// counted. What cfg/Stereo.cfg names can be changed live; a frame is matched with one set of
/// values.
class StereoPipeline {
 public:
  /// Returns at once. @throws Error for parameters that do not hold; nothing is then left running.
  StereoPipeline(const ros::NodeHandle& node, const ros::NodeHandle& private_node);
  ~StereoPipeline();
  StereoPipeline(const StereoPipeline&) = delete;
  StereoPipeline& operator=(const StereoPipeline&) = delete;

 private:
  struct Eye {
    std::string topic;  ///< of its images, resolved
    std::optional<LensFile> lens;
    std::string lens_text;  ///< of the message it came in
    ros::Time lens_stamp;
    bool lens_from_file = false;
    std::uint64_t received = 0;  ///< images
    MissingMessages missing;
  };
  using SyncPolicy =
      message_filters::sync_policies::ApproximateTime<sensor_msgs::Image, sensor_msgs::Image>;

  void onConnection();
  void subscribe();
  void unsubscribe();
  void configure(StereoConfig& config);
  void onClickedPoint(const geometry_msgs::PointStamped& point);
  void onClickedPixel(const geometry_msgs::Point& pixel);
  void pick(const Eigen::Vector2d& pixel);  ///< mutex_ is held
  void publishLens(const std::string& frame_id);
  void onLens(const LensModelMessage::ConstPtr& message, std::size_t eye);
  void count(const sensor_msgs::Image& image, std::size_t eye);
  /// Rig: to the synchronizer.
  void pair(const sensor_msgs::ImageConstPtr& image, std::size_t eye);
  void onImage(const sensor_msgs::ImageConstPtr& image);
  void onImages(const sensor_msgs::ImageConstPtr& left, const sensor_msgs::ImageConstPtr& right);
  void diagnose(diagnostic_updater::DiagnosticStatusWrapper& status);

  void run();
  std::optional<StereoSet> nextJob();
  void pollPairing();  ///< mutex_ is held
  void warnOfLeaps();
  void warnOfClock();
  void putPending(StereoSet job);  ///< mutex_ is held
  void process(const StereoSet& job);
  void publishOverlay(const MatchedSet& matched, const StereoParameters& live);
  sensor_msgs::PointCloud2Ptr cloudMessage();
  PoseAnswer cameraPose(const std::string& frame_id, std::int64_t stamp_ns);
  /// Empties the tf buffer where it is filled from the future. @return true if it was
  bool forgetFuture(const std::string& frame_id);
  std::optional<Pose> rigPose(const sensor_msgs::Image& left, const sensor_msgs::Image& right,
                              std::string* reason) const;
  /// Why there are no clouds though somebody listens; empty while they come as they should. mutex_
  /// is held.
  std::string whySilent() const;
  cv::Size expectedSize(std::size_t eye) const;

  /// Warns, throttled by name.
  void warn(const std::string& name, const std::string& text);
  /// Counts a dropped frame or set and remembers why; `fault`: also warns.
  void drop(const std::string& name, const std::string& reason, bool fault);

  const StereoParameters parameters_;  ///< as loaded; what may change is in live_
  std::optional<Pose> T_left_right_;
  CallbackThreads callbacks_;  // before all that uses it
  ros::NodeHandle node_;
  image_transport::ImageTransport transport_;
  tf2_ros::Buffer tf_buffer_;
  std::unique_ptr<TransformInput> tf_listener_;

  std::mutex connection_mutex_;  ///< subscribers and publishers
  ros::Publisher points_publisher_;
  ros::Publisher depth_publisher_;
  ros::Publisher range_publisher_;
  ros::Publisher epipolar_publisher_;
  ros::Publisher times_publisher_;
  ros::Publisher lens_publisher_;
  std::vector<ros::Subscriber> click_subscribers_;
  image_transport::Subscriber image_subscriber_;
  std::unique_ptr<image_transport::SubscriberFilter> left_subscriber_;
  std::unique_ptr<image_transport::SubscriberFilter> right_subscriber_;
  std::array<message_filters::PassThrough<sensor_msgs::Image>, 2> to_synchronizer_;
  std::unique_ptr<message_filters::Synchronizer<SyncPolicy>> synchronizer_;
  std::vector<ros::Subscriber> lens_subscribers_;
  bool subscribed_ = false;

  mutable std::mutex mutex_;  ///< all below
  std::condition_variable wake_;
  bool stopping_ = false;
  std::vector<Eye> eyes_;
  StereoParameters live_;
  std::size_t generation_ = 0;        ///< of live_
  std::vector<cv::Point2d> clicked_;  ///< pixels of the overlay; empty: those of live_
  std::string reference_frame_;       ///< optical frame of the last reference image
  std::string lens_frame_;            ///< the frame that the lens marker was published in
  FramePairing pairing_;
  std::optional<StereoSet> pending_;  ///< newest set that waits to be matched
  bool in_work_ = false;              ///< a set is being matched
  std::map<std::string, std::size_t> drops_;
  std::map<std::string, ros::SteadyTime> warned_;
  std::string reason_ = "no image yet";
  std::size_t leaps_ = 0;  ///< of pairing_, that were warned of
  std::size_t clouds_ = 0;
  ros::SteadyTime last_start_;   ///< of a match
  ros::SteadyTime last_cloud_;   ///< or since when somebody listens
  ros::SteadyTime last_image_;   ///< of the reference camera; zero: none yet
  double image_interval_ = 0.0;  ///< between the last two [s]
  double skew_ = 0.0;            ///< rig: between the stamps of the last pair [s]
  double most_skew_ = -1.0;      ///< of all pairs; negative: none yet
  MatchStatistics last_statistics_;
  int last_positions_ = 0;   ///< displaced images of the last cloud
  std::string last_remark_;  ///< what is wrong with its images, where it is next to nothing

  StereoWorker worker_;                ///< used by thread_ only
  std::size_t worker_generation_ = 0;  ///< of live_ that worker_ was set up with
  std::vector<sensor_msgs::PointCloud2Ptr> cloud_messages_;  ///< likewise
  std::thread thread_;

  DriftDiagnostic drift_;
  diagnostic_updater::Updater diagnostics_;
  ros::SteadyTimer diagnostics_timer_;
  ClockWatch clock_watch_;  ///< used by it only
  boost::recursive_mutex config_mutex_;
  std::unique_ptr<dynamic_reconfigure::Server<StereoConfig>> config_server_;
};

}  // namespace omnister
