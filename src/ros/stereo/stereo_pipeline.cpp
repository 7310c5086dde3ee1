// SPDX-License-Identifier: Apache-2.0
#include "ros/stereo/stereo_pipeline.h"

#include <omnister/StageTimes.h>
#include <sensor_msgs/PointCloud2.h>
#include <sensor_msgs/image_encodings.h>
#include <visualization_msgs/MarkerArray.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <utility>

#include "health/diagnostic_pace.h"
#include "omnister/calibration/rig_file.h"
#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/stereo/input_region.h"
#include "omnister/stereo/matching_limits.h"
#include "omnister/view/epipolar_overlay.h"
#include "ros/message/conversions.h"
#include "ros/message/image_input.h"
#include "ros/message/lens_markers.h"
#include "ros/message/stereo_messages.h"
#include "ros/node/live_parameters.h"
#include "ros/stereo/message_frame.h"
#include "ros/stereo/stereo_parameters.h"

namespace omnister {
namespace {

/// Lenses that may wait to be read: in a shorter queue an older one that comes later pushes out the
/// one that counts.
constexpr std::uint32_t kLensesWaiting = 16;
constexpr std::size_t kMostClicked = 8;  // pixels of the overlay; the oldest go first
constexpr double kWarningPeriod = 5.0;   // [s]
constexpr double kQuiet = 0.7;           // [s] without a cloud that call for no reason
constexpr double kNearlyEmpty = 1.0;     // [%] of the pixels
constexpr double kFuture = 2.0;          // [s] that tf may run ahead of the clock
constexpr std::size_t kCloudsKept = 3;   // messages that are filled again when nobody holds them
constexpr double kSilencePeriod = 10.0;  // [s] without a cloud until it is said why

/// The test that rejected most pixels.
std::string mostRejecting(const MatchStatistics& statistics) {
  const auto most =
      std::max_element(statistics.rejected.begin(), statistics.rejected.end(),
                       [](const auto& a, const auto& b) { return a.second < b.second; });
  return most == statistics.rejected.end() ? "none" : most->first;
}

/// Lap times by name.
class Laps {
 public:
  void lap(const std::string& name) {
    const ros::SteadyTime now = ros::SteadyTime::now();
    seconds_[name] += (now - last_).toSec();
    last_ = now;
  }
  std::map<std::string, double>& seconds() { return seconds_; }

 private:
  ros::SteadyTime last_ = ros::SteadyTime::now();
  std::map<std::string, double> seconds_;
};

std::string tenths(double value) { return formatNumber(std::round(10.0 * value) / 10.0); }

std::int64_t nowNanoseconds() { return static_cast<std::int64_t>(ros::Time::now().toNSec()); }

StereoParameters load(const ros::NodeHandle& private_node) {
  Parameters parameters(private_node);
  return loadStereoParameters(parameters);
}

}  // namespace

StereoPipeline::StereoPipeline(const ros::NodeHandle& node, const ros::NodeHandle& private_node)
    : parameters_(load(private_node)),
      node_(callbacks_.on(node)),
      transport_(node_),
      eyes_(parameters_.rig ? 2 : 1),
      live_(parameters_),
      pairing_(parameters_.pairing),
      last_cloud_(ros::SteadyTime::now()),
      worker_(settingsOf(parameters_)),
      drift_(parameters_.drift),
      diagnostics_(node, private_node, private_node.getNamespace()) {
  const std::vector<std::string> prefixes =
      parameters_.rig ? std::vector<std::string>{"left/", "right/"} : std::vector<std::string>{""};
  std::string files[] = {parameters_.lens, parameters_.lens_displaced};
  std::string keys[] = {"lens", "lens_displaced"};
  if (parameters_.rig && !parameters_.rig_file.empty()) {
    const RigFile rig =
        fromFileOf(private_node, "rig", [this] { return readRigFile(parameters_.rig_file); });
    T_left_right_ = rig.T_ref_disp;
    const std::filesystem::path lenses[] = {rig.reference, rig.displaced};
    for (std::size_t i = 0; i < 2; ++i) {
      if (!files[i].empty()) continue;
      files[i] = lenses[i].string();
      keys[i] = "rig";
    }
  }
  for (std::size_t i = 0; i < eyes_.size(); ++i) {
    eyes_[i].topic = node_.resolveName(prefixes[i] + "image_raw");
    const std::string& file = files[i];
    if (!file.empty()) {
      eyes_[i].lens = fromFileOf(private_node, keys[i], [&file] { return readLensFile(file); });
      eyes_[i].lens_from_file = true;
    }
  }
  tf_listener_ = std::make_unique<TransformInput>(tf_buffer_);
  // Reads the same parameters, which are known to be good by now.
  config_server_ = std::make_unique<dynamic_reconfigure::Server<StereoConfig>>(
      config_mutex_, callbacks_.on(private_node));
  config_server_->updateConfig(toConfig(parameters_));
  config_server_->setCallback([this](StereoConfig& config, std::uint32_t) { configure(config); });
  lens_publisher_ = node_.advertise<visualization_msgs::MarkerArray>("lens_surface", 1, true);
  times_publisher_ = node_.advertise<StageTimes>("timing", 10);

  {
    std::lock_guard<std::mutex> lock(connection_mutex_);
    const ros::SubscriberStatusCallback changed = [this](const ros::SingleSubscriberPublisher&) {
      onConnection();
    };
    points_publisher_ = node_.advertise<sensor_msgs::PointCloud2>("points2", 1, changed, changed);
    depth_publisher_ = node_.advertise<sensor_msgs::Image>("depth", 1, changed, changed);
    range_publisher_ = node_.advertise<sensor_msgs::Image>("range", 1, changed, changed);
    epipolar_publisher_ = node_.advertise<sensor_msgs::Image>("epipolar", 1, changed, changed);
    click_subscribers_ = {
        node_.subscribe("clicked_point", 4, &StereoPipeline::onClickedPoint, this),
        node_.subscribe("epipolar_mouse_left", 4, &StereoPipeline::onClickedPixel, this)};
    for (std::size_t i = 0; i < eyes_.size(); ++i) {
      if (eyes_[i].lens_from_file) continue;
      lens_subscribers_.push_back(node_.subscribe<LensModelMessage>(
          prefixes[i] + "lens_model", kLensesWaiting,
          [this, i](const LensModelMessage::ConstPtr& message) { onLens(message, i); }));
    }
  }
  diagnostics_.setHardwareID("none");
  diagnostics_.add("stereo", this, &StereoPipeline::diagnose);
  diagnostics_.add("calibration", &drift_, &DriftDiagnostic::diagnose);
  // By the steady clock, so that it goes on while a recording pauses.
  diagnostics_timer_ = node_.createSteadyTimer(ros::WallDuration(kDiagnosticPeriod),
                                               [this](const ros::SteadyTimerEvent&) {
                                                 warnOfClock();
                                                 diagnostics_.force_update();
                                               });
  thread_ = std::thread([this] { run(); });
  callbacks_.start();
}

StereoPipeline::~StereoPipeline() {
  callbacks_.stop();
  {
    std::lock_guard<std::mutex> lock(mutex_);
    stopping_ = true;
  }
  wake_.notify_all();
  thread_.join();
}

void StereoPipeline::configure(StereoConfig& config) {
  std::lock_guard<std::mutex> lock(mutex_);
  const StereoConfig before = toConfig(live_);
  keepFinite(config, before);
  // Whoever asks is told what became of it: what contradicts itself stays as it was.
  if (!(config.min_baseline < config.max_baseline)) {
    ROS_WARN("min_baseline %g m is not below max_baseline %g m: both stay", config.min_baseline,
             config.max_baseline);
    config.min_baseline = before.min_baseline;
    config.max_baseline = before.max_baseline;
  }
  if (!(config.min_range < config.max_range)) {
    ROS_WARN("min_range %g m is not below max_range %g m: both stay", config.min_range,
             config.max_range);
    config.min_range = before.min_range;
    config.max_range = before.max_range;
  }
  try {
    parsePixels(config.epipolar_pixels, "epipolar_pixels");
    if (config.epipolar_pixels != before.epipolar_pixels) clicked_.clear();
  } catch (const Error& error) {
    ROS_WARN("%s", error.what());
    config.epipolar_pixels = before.epipolar_pixels;
  }
  try {
    parseRegion(config.roi, eyes_[0].lens ? eyes_[0].lens->image_size : kAnySize, "roi");
  } catch (const Error& error) {
    ROS_WARN("%s", error.what());
    config.roi = before.roi;
  }
  try {
    if (config.mask != before.mask) live_.matching.mask = loadMask(config.mask);
  } catch (const Error& error) {
    ROS_WARN("%s", error.what());
    config.mask = before.mask;
  }
  if (config.stream && parameters_.rig) {
    ROS_WARN("stream is for one camera that moves, not for mode rig");
    config.stream = false;
  }
  const auto known = [](const std::string& value, std::initializer_list<const char*> choices) {
    return std::find(choices.begin(), choices.end(), value) != choices.end();
  };
  if (!known(config.matcher, {"sweep", "thesis"})) config.matcher = before.matcher;
  if (!known(config.cost, {"census", "zncc", "eq3.1"})) config.cost = before.cost;
  if (!known(config.window, {"surface", "ray", "fronto", "best"})) config.window = before.window;
  settlePreset(config, before);
  take(config, live_);
  ++generation_;
  pairing_.setOptions(live_.pairing);
}

void StereoPipeline::pick(const Eigen::Vector2d& pixel) {
  clicked_.emplace_back(pixel.x(), pixel.y());
  if (clicked_.size() > kMostClicked) clicked_.erase(clicked_.begin());
}

void StereoPipeline::onClickedPoint(const geometry_msgs::PointStamped& point) {
  try {
    std::string frame_id;
    LensPtr lens;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      frame_id = reference_frame_;
      if (eyes_[0].lens) lens = eyes_[0].lens->lens;
    }
    if (frame_id.empty() || !lens) throw Error("there is no image or no lens yet");
    const Pose T_camera_point = fromTransform(
        tf_buffer_.lookupTransform(frame_id, point.header.frame_id, ros::Time(0)).transform, "tf");
    const Eigen::Vector3d at =
        T_camera_point * Eigen::Vector3d(point.point.x, point.point.y, point.point.z);
    const auto pixel = lens->project(at);
    if (!pixel) throw Error("the camera does not see it");
    std::lock_guard<std::mutex> lock(mutex_);
    pick(*pixel);
  } catch (const std::exception& error) {
    ROS_WARN("clicked point: %s", printable(error.what(), 300).c_str());
  }
}

void StereoPipeline::onClickedPixel(const geometry_msgs::Point& pixel) {
  std::lock_guard<std::mutex> lock(mutex_);
  // The left half of the overlay is the reference image.
  const bool inside = eyes_[0].lens && pixel.x >= 0.0 && pixel.y >= 0.0 &&
                      pixel.x < eyes_[0].lens->image_size.width &&
                      pixel.y < eyes_[0].lens->image_size.height;
  // Of a reduced picture; the pixels that are kept are those of the full image.
  const double factor = live_.reduce;
  if (inside) pick({(pixel.x + 0.5) * factor - 0.5, (pixel.y + 0.5) * factor - 0.5});
}

void StereoPipeline::publishLens(const std::string& frame_id) {
  LensFile file;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    if (!eyes_[0].lens || frame_id.empty() || lens_frame_ == frame_id) return;
    lens_frame_ = frame_id;
    file = *eyes_[0].lens;
  }
  lens_publisher_.publish(lensMarkers(file, frame_id));
}

void StereoPipeline::onConnection() {
  std::lock_guard<std::mutex> lock(connection_mutex_);
  const bool wanted = points_publisher_.getNumSubscribers() + depth_publisher_.getNumSubscribers() +
                          range_publisher_.getNumSubscribers() +
                          epipolar_publisher_.getNumSubscribers() >
                      0;
  try {
    if (wanted && !subscribed_) subscribe();
    if (!wanted && subscribed_) unsubscribe();
  } catch (const std::exception& error) {
    ROS_ERROR("cannot subscribe to images: %s", printable(error.what()).c_str());
  }
}

void StereoPipeline::subscribe() {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    last_cloud_ = ros::SteadyTime::now();
    reason_ = "no image on " + eyes_[0].topic;
  }
  const image_transport::TransportHints hints("raw", ros::TransportHints().tcpNoDelay());
  {
    std::lock_guard<std::mutex> lock(mutex_);
    for (Eye& eye : eyes_) eye.missing.reset();
    last_image_ = {};
  }
  if (parameters_.rig) {
    left_subscriber_ =
        std::make_unique<image_transport::SubscriberFilter>(transport_, "left/image_raw", 4, hints);
    right_subscriber_ = std::make_unique<image_transport::SubscriberFilter>(
        transport_, "right/image_raw", 4, hints);
    SyncPolicy policy(8);
    left_subscriber_->registerCallback(
        [this](const sensor_msgs::ImageConstPtr& image) { pair(image, 0); });
    right_subscriber_->registerCallback(
        [this](const sensor_msgs::ImageConstPtr& image) { pair(image, 1); });
    policy.setMaxIntervalDuration(ros::Duration(parameters_.max_skew));
    policy.setReset(true);
    synchronizer_ = std::make_unique<message_filters::Synchronizer<SyncPolicy>>(
        static_cast<const SyncPolicy&>(policy), to_synchronizer_[0], to_synchronizer_[1]);
    synchronizer_->registerCallback(boost::bind(&StereoPipeline::onImages, this,
                                                boost::placeholders::_1, boost::placeholders::_2));
  } else {
    image_subscriber_ = transport_.subscribe(
        "image_raw", 4, [this](const sensor_msgs::ImageConstPtr& image) { onImage(image); },
        ros::VoidPtr(), hints);
  }
  subscribed_ = true;
}

void StereoPipeline::unsubscribe() {
  image_subscriber_.shutdown();
  synchronizer_.reset();
  left_subscriber_.reset();
  right_subscriber_.reset();
  subscribed_ = false;
  std::lock_guard<std::mutex> lock(mutex_);
  pairing_.reset("nobody listens");
  if (pending_) ++drops_["nobody listens"];
  pending_.reset();
}

void StereoPipeline::pair(const sensor_msgs::ImageConstPtr& image, std::size_t eye) {
  count(*image, eye);
  const ros::Time now = ros::Time::now(), stamp = image->header.stamp;
  // The synchronizer takes differences of stamps and a tenth more, which ROS must be able to hold.
  constexpr double kFarthest = 9e8;  // [s]
  const bool near = now.isZero() || std::abs(stamp.toSec() - now.toSec()) < kFarthest;
  if (!near || !canReckonWith(stamp))
    return drop("bad image", eyes_[eye].topic + ": the stamp is decades off", true);
  to_synchronizer_[eye].add(image);
}

void StereoPipeline::count(const sensor_msgs::Image& image, std::size_t eye) {
  std::lock_guard<std::mutex> lock(mutex_);
  ++eyes_[eye].received;
  if (eye == 0) {
    const ros::SteadyTime now = ros::SteadyTime::now();
    if (!last_image_.isZero()) image_interval_ = (now - last_image_).toSec();
    last_image_ = now;
  }
  // More came than could be taken in: the older ones went.
  if (const std::uint32_t missing = eyes_[eye].missing.before(image.header))
    drops_["missed"] += missing;
}

void StereoPipeline::warn(const std::string& name, const std::string& text) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    const ros::SteadyTime now = ros::SteadyTime::now();
    const auto last = warned_.find(name);
    if (last != warned_.end() && (now - last->second).toSec() < kWarningPeriod) return;
    warned_[name] = now;
  }
  ROS_WARN("%s", printable(text, 500).c_str());
}

void StereoPipeline::drop(const std::string& name, const std::string& reason, bool fault) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    ++drops_[name];
    reason_ = reason;
  }
  if (fault) warn(name, reason);
}

void StereoPipeline::onLens(const LensModelMessage::ConstPtr& message, std::size_t eye) {
  const std::string topic = node_.resolveName(!parameters_.rig ? "lens_model"
                                              : eye == 0       ? "left/lens_model"
                                                               : "right/lens_model");
  try {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      // Latched lenses of camera and calibration arrive in any order: the later one is right.
      Eye& known = eyes_[eye];
      if (known.lens && message->header.stamp < known.lens_stamp) return;
      if (known.lens && message->yaml == known.lens_text) {
        known.lens_stamp = message->header.stamp;
        return;
      }
    }
    LensFile file = fromLensModelMessage(*message, topic);
    const std::string model(file.lens->model());
    {
      std::lock_guard<std::mutex> lock(mutex_);
      // A later one may have come while this was read by another thread.
      if (eyes_[eye].lens && message->header.stamp < eyes_[eye].lens_stamp) return;
      eyes_[eye].lens = std::move(file);
      eyes_[eye].lens_text = message->yaml;
      eyes_[eye].lens_stamp = message->header.stamp;
      if (eye == 0) lens_frame_.clear();
    }
    if (eye == 0) publishLens(message->header.frame_id);
    ROS_INFO("new lens on %s: %s, %ux%u", topic.c_str(), model.c_str(), message->width,
             message->height);
  } catch (const std::exception& error) {
    drop("bad lens", error.what(), true);
  }
}

cv::Size StereoPipeline::expectedSize(std::size_t eye) const {
  std::lock_guard<std::mutex> lock(mutex_);
  return eyes_[eye].lens ? eyes_[eye].lens->image_size : cv::Size();
}

void StereoPipeline::onImage(const sensor_msgs::ImageConstPtr& image) {
  count(*image, 0);
  try {
    checkFrame(*image, expectedSize(0), eyes_[0].topic);
  } catch (const std::exception& error) {
    return drop("bad image", error.what(), true);
  }
  PairingFrame frame;
  frame.stamp_ns = static_cast<std::int64_t>(image->header.stamp.toNSec());
  frame.frame_id = image->header.frame_id;
  frame.image = toStereoFrame(image);
  {
    std::lock_guard<std::mutex> lock(mutex_);
    pairing_.add(std::move(frame), nowNanoseconds());
  }
  wake_.notify_all();
}

void StereoPipeline::onImages(const sensor_msgs::ImageConstPtr& left,
                              const sensor_msgs::ImageConstPtr& right) {
  StereoSet job;
  try {
    checkFrame(*left, expectedSize(0), eyes_[0].topic);
    checkFrame(*right, expectedSize(1), eyes_[1].topic);
  } catch (const std::exception& error) {
    return drop("bad image", error.what(), true);
  }
  std::string why;
  const std::optional<Pose> T_left_right = rigPose(*left, *right, &why);
  if (!T_left_right) return drop("no pose", "no pose between the cameras: " + why, true);
  job.reference = toStereoFrame(left);
  job.displaced = {toStereoFrame(right)};
  job.T_ref_disp = {*T_left_right};
  {
    std::lock_guard<std::mutex> lock(mutex_);
    skew_ = std::abs((left->header.stamp - right->header.stamp).toSec());
    most_skew_ = std::max(most_skew_, skew_);
    putPending(std::move(job));
  }
  wake_.notify_all();
}

std::optional<Pose> StereoPipeline::rigPose(const sensor_msgs::Image& left,
                                            const sensor_msgs::Image& right,
                                            std::string* reason) const {
  if (T_left_right_) return T_left_right_;
  try {
    // The cameras are joined rigidly, so the latest pose between them will do.
    return fromTransform(
        tf_buffer_.lookupTransform(left.header.frame_id, right.header.frame_id, ros::Time(0))
            .transform,
        "tf");
  } catch (const std::exception& error) {
    *reason = error.what();
    return std::nullopt;
  }
}

bool StereoPipeline::forgetFuture(const std::string& frame_id) {
  // A single transform from the future pushes all others out of the buffer until its time has come.
  try {
    const ros::Time latest =
        tf_buffer_.lookupTransform(parameters_.fixed_frame, frame_id, ros::Time(0)).header.stamp;
    if ((latest - ros::Time::now()).toSec() < kFuture) return false;
    tf_buffer_.clear();
    return true;
  } catch (const tf2::TransformException&) {
    return false;
  }
}

PoseAnswer StereoPipeline::cameraPose(const std::string& frame_id, std::int64_t stamp_ns) {
  PoseAnswer answer;
  // tf2 takes time 0 for "the latest".
  if (stamp_ns <= 0) {
    answer.reason = "the stamp is before all tf";
    return answer;
  }
  ros::Time stamp;
  try {
    stamp.fromNSec(static_cast<std::uint64_t>(stamp_ns));
    answer.T_fixed_camera = fromTransform(
        tf_buffer_.lookupTransform(parameters_.fixed_frame, frame_id, stamp).transform, "tf");
    answer.state = PoseAnswer::State::kKnown;
  } catch (const tf2::ExtrapolationException& error) {
    answer.reason = printable(error.what(), 300);
    bool past = answer.reason.find("into the past") != std::string::npos;
    // Of a fixed frame that somebody hung below another one tf says that it is that one's future.
    if ((past || stamp < ros::Time::now()) && forgetFuture(frame_id)) {
      answer.reason = "tf ran ahead of the clock: it starts anew";
      past = true;
    }
    answer.state = past ? PoseAnswer::State::kNever : PoseAnswer::State::kLater;
  } catch (const tf2::TransformException& error) {
    // A frame that nobody has published yet may still come.
    answer.reason = printable(error.what(), 300);
    answer.state = PoseAnswer::State::kLater;
  } catch (const std::exception& error) {
    answer.reason = error.what();
  }
  return answer;
}

std::optional<StereoSet> StereoPipeline::nextJob() {
  std::unique_lock<std::mutex> lock(mutex_);
  const auto due_in = [&] {
    return live_.min_period - (ros::SteadyTime::now() - last_start_).toSec();
  };
  if (!stopping_ && !(pending_ && due_in() <= 0.0)) {
    double pause = pairing_.waiting() ? 0.01 : 0.2;
    if (pending_) pause = std::clamp(due_in(), 0.001, pause);
    wake_.wait_for(lock, std::chrono::duration<double>(pause));
  }
  if (stopping_) return std::nullopt;
  if (!parameters_.rig) pollPairing();
  if (!pending_ || due_in() > 0.0) return std::nullopt;
  in_work_ = true;
  return std::exchange(pending_, std::nullopt);
}

void StereoPipeline::pollPairing() {
  const std::optional<FrameSet> set =
      pairing_.poll([this](const std::string& frame_id,
                           std::int64_t stamp) { return cameraPose(frame_id, stamp); },
                    nowNanoseconds());
  if (!pairing_.reason().empty()) reason_ = pairing_.reason();
  if (!set) return;
  putPending(toStereoSet(*set));
}

void StereoPipeline::putPending(StereoSet job) {
  if (pending_) ++drops_["busy"];
  pending_ = std::move(job);
}

void StereoPipeline::warnOfLeaps() {
  std::string reason;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    const std::size_t leaps = pairing_.leaps();
    if (leaps == leaps_) return;
    leaps_ = leaps;
    reason = pairing_.reason();
  }
  warn("leap", reason);
}

void StereoPipeline::warnOfClock() {
  // A recording's clock goes as it likes.
  if (!ros::Time::isSystemTime()) return;
  if (const std::optional<double> by =
          clock_watch_.jump(ros::Time::now().toSec(), ros::SteadyTime::now().toSec()))
    ROS_WARN("the clock of this machine was set %s by %.1f s", *by > 0.0 ? "ahead" : "back",
             std::abs(*by));
}

void StereoPipeline::run() {
  for (;;) {
    std::optional<StereoSet> job;
    try {
      job = nextJob();
      if (job) process(*job);
      warnOfLeaps();
    } catch (const std::exception& error) {
      drop("failed", error.what(), true);
    }
    double silence = 0.0;
    std::string why;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      in_work_ = false;
      if (stopping_) return;
      silence = (ros::SteadyTime::now() - last_cloud_).toSec();
      const auto said = warned_.find("silence");
      if (said != warned_.end())
        silence = std::min(silence, (ros::SteadyTime::now() - said->second).toSec());
      if (silence >= kSilencePeriod) warned_["silence"] = ros::SteadyTime::now();
      why = reason_;
    }
    if (silence < kSilencePeriod) continue;
    std::lock_guard<std::mutex> lock(connection_mutex_);
    if (subscribed_) ROS_INFO("no cloud for %.0f s: %s", silence, printable(why, 500).c_str());
  }
}

void StereoPipeline::publishOverlay(const MatchedSet& matched, const StereoParameters& live) {
  std::vector<cv::Point2d> pixels;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    pixels = clicked_;
  }
  if (pixels.empty()) pixels = parsePixels(live.epipolar_pixels, "epipolar_pixels");
  for (cv::Point2d& pixel : pixels)
    pixel = (pixel + cv::Point2d(0.5, 0.5)) / live.reduce - cv::Point2d(0.5, 0.5);
  StereoGeometry geometry;
  geometry.reference_lens = matched.lens;
  geometry.reference_size = matched.grey.size();
  geometry.displaced = {matched.displaced_from};
  if (pixels.empty()) pixels = defaultPixels(geometry.reference_size);
  const auto picture = [&](const StereoFrame& image) {
    return reducedImage(image.bgr(matched.bits), live.reduce);
  };
  const sensor_msgs::ImagePtr message =
      toImage(drawEpipolarOverlay(picture(*matched.image), picture(*matched.displaced), geometry,
                                  live.matching, matched.result, pixels),
              sensor_msgs::image_encodings::BGR8);
  message->header = messageOf(*matched.image).header;
  epipolar_publisher_.publish(message);
}

sensor_msgs::PointCloud2Ptr StereoPipeline::cloudMessage() {
  // What nobody holds any more is there to be filled again: fresh memory costs milliseconds.
  for (const sensor_msgs::PointCloud2Ptr& message : cloud_messages_)
    if (message.unique()) {
      // Whoever let go of it last has read it before.
      std::atomic_thread_fence(std::memory_order_acquire);
      return message;
    }
  auto message = boost::make_shared<sensor_msgs::PointCloud2>();
  if (cloud_messages_.size() < kCloudsKept) cloud_messages_.push_back(message);
  return message;
}

void StereoPipeline::process(const StereoSet& job) {
  const ros::SteadyTime start = ros::SteadyTime::now();
  Laps laps;
  std::vector<LensFile> lenses;
  StereoParameters live;
  std::size_t generation = 0;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    last_start_ = start;
    live = live_;
    generation = generation_;
    reference_frame_ = messageOf(*job.reference).header.frame_id;
    for (const Eye& eye : eyes_)
      if (eye.lens) lenses.push_back(*eye.lens);
  }
  if (lenses.size() != eyes_.size())
    return drop("no lens", "no lens yet: nothing on lens_model, and no parameter ~lens", false);
  // A lens may have come after the images.
  const LensFile& reference_lens = lenses.front();
  const LensFile& displaced_lens = lenses.back();
  if (generation != worker_generation_) {
    worker_.configure(settingsOf(live));
    worker_generation_ = generation;
  }
  const PreparedSet prepared =
      worker_.prepare(job, reference_lens, displaced_lens, eyes_.front().topic, eyes_.back().topic);
  publishLens(messageOf(*job.reference).header.frame_id);
  laps.lap("convert");
  if (!live.stream) worker_.matcherFor(prepared.geometry);
  laps.lap("prepare");
  StereoSet placed = job;
  if (parameters_.rig && live.use_prior) {
    // Where the cameras stand, if anybody says; only that takes a prior along.
    const std_msgs::Header& header = messageOf(*job.reference).header;
    const PoseAnswer answer =
        cameraPose(header.frame_id, static_cast<std::int64_t>(header.stamp.toNSec()));
    if (answer.state == PoseAnswer::State::kKnown) placed.T_fixed_reference = answer.T_fixed_camera;
  }
  const std::optional<MatchedSet> matched = worker_.match(placed, prepared);
  if (!matched)
    return drop("no baseline", "the camera stands where the stream's reference was taken", false);
  const MatchResult& result = matched->result;
  laps.lap("match");

  const std_msgs::Header& header = messageOf(*matched->image).header;
  if (points_publisher_.getNumSubscribers() > 0) {
    const sensor_msgs::PointCloud2Ptr message = cloudMessage();
    fillPointCloud(result, worker_.rays(*matched), worker_.picture(*matched, true), header,
                   live.matching.threads, message.get());
    points_publisher_.publish(message);
  }
  if (depth_publisher_.getNumSubscribers() > 0)
    depth_publisher_.publish(toDepth(result.range, worker_.rays(*matched), header));
  if (range_publisher_.getNumSubscribers() > 0)
    range_publisher_.publish(toRange(result.range, header));

  laps.lap("publish");
  if (epipolar_publisher_.getNumSubscribers() > 0) {
    publishOverlay(*matched, live);
    laps.lap("overlay");
  }
  // Of a cloud that is next to nothing: what is wrong with its images.
  std::string remark;
  if (result.statistics.valid * 20 < matched->grey.total()) {
    for (const std::string& line : imageRemarks(prepared.reference, prepared.displaced))
      remark += (remark.empty() ? "" : "; ") + line;
    const double percent = 100.0 * static_cast<double>(result.statistics.valid) /
                           static_cast<double>(matched->grey.total());
    if (remark.empty() && percent < kNearlyEmpty)
      remark = formatNumber(std::round(10.0 * percent) / 10.0) +
               " % of the pixels have a range, most are rejected by the test '" +
               mostRejecting(result.statistics) +
               "': does the camera stand where tf says that it does?";
    if (!remark.empty()) warn("nearly empty", "clouds are nearly empty: " + remark);
  }

  StageTimes times;
  times.header = header;
  laps.seconds()["total"] = (ros::SteadyTime::now() - start).toSec();
  for (const auto& [stage, seconds] : result.statistics.seconds)
    if (stage != "total") laps.seconds()["match " + stage] = seconds;
  for (const auto& [stage, seconds] : laps.seconds()) {
    times.stages.push_back(stage);
    times.seconds.push_back(seconds);
  }
  times.age = (ros::Time::now() - header.stamp).toSec();
  times_publisher_.publish(times);
  // A stream's ranges lie on the pixels of another image.
  if (matched->image == job.reference) drift_.look(job, prepared, result.range);

  std::lock_guard<std::mutex> lock(mutex_);
  ++clouds_;
  last_cloud_ = ros::SteadyTime::now();
  last_statistics_ = result.statistics;
  last_statistics_.seconds = laps.seconds();
  last_positions_ = matched->positions;
  last_remark_ = remark;
  reason_.clear();
}

std::string StereoPipeline::whySilent() const {
  const ros::SteadyTime now = ros::SteadyTime::now();
  const double silence = (now - last_cloud_).toSec();
  // Before the second image nobody knows how fast they come.
  const double frames = image_interval_ > 0.0 ? 3.0 * image_interval_ : kWarningPeriod;
  const double images = last_image_.isZero() ? silence : (now - last_image_).toSec();
  if (images > std::max(kQuiet, frames))
    return "no image for " + tenths(images) + " s on " + eyes_[0].topic;
  const auto matching = last_statistics_.seconds.find("total");
  const double seconds = matching != last_statistics_.seconds.end() ? matching->second : 0.0;
  const bool patient = pairing_.moving() || in_work_ || pending_;
  const double usual = std::max({kQuiet, frames, 2.0 * seconds + live_.min_period});
  if (silence <= (patient ? std::max(kWarningPeriod, usual) : usual)) return {};
  return reason_.empty() ? "for " + tenths(silence) + " s" : reason_;
}

void StereoPipeline::diagnose(diagnostic_updater::DiagnosticStatusWrapper& status) {
  bool subscribed = false;
  {
    std::lock_guard<std::mutex> lock(connection_mutex_);
    subscribed = subscribed_;
  }
  std::lock_guard<std::mutex> lock(mutex_);
  const std::string silent = whySilent();
  using diagnostic_msgs::DiagnosticStatus;
  if (!subscribed)
    status.summary(DiagnosticStatus::OK, "idle: nobody listens");
  else if (!silent.empty())
    status.summary(DiagnosticStatus::WARN, "no cloud: " + printable(silent, 300));
  else if (clouds_ > 0 && !last_remark_.empty())
    status.summary(DiagnosticStatus::WARN, "clouds are nearly empty: " + last_remark_);
  else
    status.summary(DiagnosticStatus::OK, "running");
  for (const Eye& eye : eyes_) {
    status.add("lens of " + eye.topic, eye.lens ? std::string(eye.lens->lens->model()) : "none");
    status.add("images of " + eye.topic, eye.received);
  }
  status.add("clouds", clouds_);
  if (clouds_ > 0) {
    status.add("valid pixels", last_statistics_.valid);
    status.add("displaced images", last_positions_);
    for (const auto& [stage, seconds] : last_statistics_.seconds)
      status.add("seconds, " + stage, seconds);
    for (const auto& [test, pixels] : last_statistics_.rejected)
      status.add("pixels rejected, " + test, pixels);
  }
  if (parameters_.rig && most_skew_ >= 0.0) {
    status.add("between left and right [s]", skew_);
    status.add("between left and right, most [s]", most_skew_);
  }
  if (pairing_.missedBaseline()) status.add("baseline missed [m]", *pairing_.missedBaseline());
  for (const auto& [name, count] : pairing_.counts()) status.add("frames, " + name, count);
  for (const auto& [name, count] : drops_) status.add("dropped, " + name, count);
  // What is on its way: with these, every image is accounted for.
  status.add("frames, waiting", pairing_.waitingFrames());
  status.add("sets, waiting or matched", (pending_ ? 1 : 0) + (in_work_ ? 1 : 0));
}

}  // namespace omnister
