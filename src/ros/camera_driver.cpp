// SPDX-License-Identifier: Apache-2.0
#include "omnister/ros/camera_driver.h"

#include <image_transport/image_transport.h>
#include <ros/console.h>

#include <boost/make_shared.hpp>
#include <cmath>

#include "omnister/ros/conversions.h"
#include "omnister/ros/parameters.h"

namespace omnister {
namespace {

using Steady = std::chrono::steady_clock;
constexpr std::chrono::milliseconds kGrabTimeout(200);
// An unplugged camera is told of once, and again now and then.
constexpr std::chrono::seconds kRepeatProblem(30);
// The stage of a recording stands at its position this long around a settled frame [s], and no
// longer than the intervals between frames allow.
constexpr double kSettledAround = 0.0491;
constexpr double kSettledShare = 0.4;

double secondsSince(Steady::time_point time) {
  return std::chrono::duration<double>(Steady::now() - time).count();
}

/// A path, or a file:// URL as camera_info_url may be.
std::string pathOfUrl(const std::string& url) {
  const std::string file = "file://";
  if (url.rfind(file, 0) == 0) return url.substr(file.size());
  if (url.find("://") != std::string::npos) {
    throw InputError("parameter camera_info_url", "",
                     "is \"" + printable(url) + "\", expected a path or file:///path");
  }
  return url;
}

std::string describe(const device::CameraIdentity& identity) {
  return identity.vendor + " " + identity.model + " (" + identity.serial + ")";
}

}  // namespace

CameraParameters loadCameraParameters(const ros::NodeHandle& private_node) {
  Parameters source(private_node);
  CameraParameters p;
  p.device = source.text("device", p.device);
  p.frame_id = source.frame("frame_id", p.frame_id);
  const std::string url = source.text("camera_info_url", "");
  p.lens = source.text("lens", pathOfUrl(url));
  p.store = source.text("store", p.store);
  p.name = source.text("name", p.name);
  if (!p.name.empty()) LensStore(p.store).pathOf(p.name);  // refuses names with path parts
  p.settings.frame_rate_hz =
      source.number("frame_rate", 0.0, 0.0, 1000.0, "Hz (0: the device's own)");
  if (source.has("exposure_us")) {
    p.settings.exposure_us = source.number("exposure_us", 0.0, 1.0, 60e6, "us");
  }
  if (source.has("gain")) p.settings.gain = source.number("gain", 0.0, -100.0, 1000.0);
  source.ignore("exposure_us");
  source.ignore("gain");
  p.settings.pixel_format = source.text("pixel_format", "");
  p.settings.trigger =
      source.choice("trigger", "off", {"off", "software", "line0", "line1", "line2", "line3"});
  p.settings.ptp = source.flag("ptp", false);
  p.settings.loop = source.flag("loop", false);
  p.settings.paced = source.flag("paced", true);
  p.settings.recorded_stamps = source.flag("recorded_stamps", false);
  p.parent_frame_id = source.frame("parent_frame_id", "");
  p.mount = source.pose("mount", p.mount);
  p.retry_period_s = source.number("retry_period", p.retry_period_s, 0.05, 60.0, "s");
  p.watchdog_s = source.number("watchdog", p.watchdog_s, 0.1, 600.0, "s");
  p.stage_frame_id = source.frame("stage_frame_id", p.stage_frame_id);
  p.stage_child_frame_id = source.frame("stage_child_frame_id", p.stage_child_frame_id);
  p.axis = source.direction("axis", p.axis);
  source.ignore("diagnostic_period");
  source.warnUnknown();
  return p;
}

std::unique_ptr<device::Camera> openDevice(const CameraParameters& parameters) {
  return device::openCamera(parameters.device, parameters.settings);
}

CameraDriver::CameraDriver(const ros::NodeHandle& node, const ros::NodeHandle& private_node,
                           CameraParameters parameters, OpenCamera open)
    : node_(node),
      parameters_(std::move(parameters)),
      open_(std::move(open)),
      last_report_(Steady::now()),
      last_frame_(Steady::now()),
      diagnostics_(node, private_node, private_node.getNamespace()) {
  lens_publisher_ = node_.advertise<LensModelMessage>("lens_model", 1, true);
  if (!parameters_.lens.empty()) setLens(readLensFile(parameters_.lens));
  if (!parameters_.parent_frame_id.empty()) {
    static_frames_ = StaticFrames::shared();
    const ros::Time now = ros::Time::now();
    const std::string link = linkFrame(parameters_.frame_id);
    static_frames_->add(
        toTransformStamped(parameters_.mount, now, parameters_.parent_frame_id, link));
    static_frames_->add(toTransformStamped(opticalInLink(), now, link, parameters_.frame_id));
  }
  images_ = image_transport::ImageTransport(node_).advertiseCamera("image_raw", 4);
  set_camera_info_ = node_.advertiseService("set_camera_info", &CameraDriver::setCameraInfo, this);
  lens_subscriber_ = node_.subscribe("lens_model", 1, &CameraDriver::onLens, this);
  diagnostics_.setHardwareID("none");
  diagnostics_.add("camera", this, &CameraDriver::diagnose);
  thread_ = std::thread(&CameraDriver::run, this);
}

CameraDriver::~CameraDriver() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    stop_ = true;
  }
  wake_.notify_all();
  thread_.join();
}

void CameraDriver::waitFor(double seconds) {
  const Steady::time_point end = Steady::now() + std::chrono::duration_cast<Steady::duration>(
                                                     std::chrono::duration<double>(seconds));
  while (!stop_ && Steady::now() < end) {
    diagnostics_.update();
    const Steady::time_point slice = std::min(end, Steady::now() + std::chrono::milliseconds(200));
    std::unique_lock<std::mutex> lock(mutex_);
    wake_.wait_until(lock, slice, [this] { return stop_.load(); });
  }
}

bool CameraDriver::wanted() const { return images_.getNumSubscribers() > 0; }

void CameraDriver::run() {
  while (!stop_) {
    diagnostics_.update();
    try {
      if (openIfNeeded()) {
        stream();
      } else {
        waitFor(parameters_.retry_period_s);
      }
    } catch (const std::exception& e) {
      close(e.what());
      waitFor(parameters_.retry_period_s);
    }
  }
  try {
    if (camera_ && streaming_) camera_->stop();
    camera_.reset();
  } catch (const std::exception& e) {
    ROS_WARN_STREAM("closing the camera: " << printable(e.what()));
  }
}

bool CameraDriver::openIfNeeded() {
  if (camera_) return true;
  camera_ = open_(parameters_);
  const device::CameraIdentity identity = camera_->identity();
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    identity_ = identity;
    problem_.clear();
    state_ = "idle";
  }
  diagnostics_.setHardwareID(identity.serial);
  ROS_INFO_STREAM("opened " << printable(describe(identity)));
  last_sequence_.reset();
  takeRemarks();
  chooseLens();
  return true;
}

void CameraDriver::close(const std::string& problem) {
  camera_.reset();
  streaming_ = false;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    state_ = "lost";
    problem_ = problem;
    ++losses_of_device_;
  }
  if (problem == told_problem_ && Steady::now() - told_at_ < kRepeatProblem) return;
  told_problem_ = problem;
  told_at_ = Steady::now();
  ROS_WARN_STREAM("no camera, trying again every " << parameters_.retry_period_s
                                                   << " s: " << printable(problem, 1000));
}

void CameraDriver::stream() {
  const auto setState = [this](const char* state) {
    const std::lock_guard<std::mutex> lock(mutex_);
    state_ = state;
  };
  if (camera_->finished()) {
    if (streaming_) {
      camera_->stop();
      streaming_ = false;
      setState("finished");
      ROS_INFO("the recording is over");
    }
    waitFor(0.1);
    return;
  }
  if (!wanted()) {
    if (streaming_) {
      camera_->stop();
      streaming_ = false;
      setState("idle");
      ROS_DEBUG("nobody listens, streaming stops");
    }
    waitFor(0.02);
    return;
  }
  if (!streaming_) {
    camera_->start();
    streaming_ = true;
    last_frame_ = Steady::now();
    setState("streaming");
    ROS_DEBUG("streaming");
  }
  const std::optional<device::Frame> frame = camera_->grab(kGrabTimeout);
  takeRemarks();
  if (frame) {
    countLost(*frame);
    last_frame_ = Steady::now();
    publish(*frame);
  } else if (!camera_->finished()) {
    watch();
  }
}

void CameraDriver::watch() {
  const double silent = secondsSince(last_frame_);
  const double slow =
      parameters_.settings.frame_rate_hz > 0.0 ? 3.0 / parameters_.settings.frame_rate_hz : 0.0;
  if (silent <= std::max(parameters_.watchdog_s, slow) || parameters_.settings.trigger != "off")
    return;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    problem_ = "no frame for " + std::to_string(static_cast<int>(silent)) + " s";
  }
  ROS_WARN_STREAM_THROTTLE(10.0,
                           "the camera gives no frame for " << static_cast<int>(silent) << " s");
}

void CameraDriver::takeRemarks() {
  for (const std::string& remark : camera_->takeRemarks()) {
    ROS_WARN_STREAM(printable(remark, 1000));
  }
}

void CameraDriver::countLost(const device::Frame& frame) {
  const std::uint64_t gap = last_sequence_ && frame.sequence > *last_sequence_ + 1
                                ? frame.sequence - *last_sequence_ - 1
                                : 0;
  last_sequence_ = frame.sequence;
  told_problem_.clear();
  const std::lock_guard<std::mutex> lock(mutex_);
  ++frames_;
  lost_ += gap;
  problem_.clear();
}

void CameraDriver::publish(const device::Frame& frame) {
  const sensor_msgs::ImagePtr image = toImage(frame.image, frame.encoding);
  image->header.stamp = toRosTime(frame.stamp);
  image->header.frame_id = parameters_.frame_id;

  std::shared_ptr<const Lens> lens;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    lens = lens_;
  }
  auto info = boost::make_shared<sensor_msgs::CameraInfo>();
  if (lens && lens->file.image_size == frame.image.size()) {
    *info = lens->info;
  } else {
    *info = uncalibratedCameraInfo(frame.image.cols, frame.image.rows);
    if (lens) {
      ROS_ERROR_STREAM_THROTTLE(30.0, "the lens is of "
                                          << lens->file.image_size.width << "x"
                                          << lens->file.image_size.height
                                          << " pixels, the images have " << frame.image.cols << "x"
                                          << frame.image.rows << ": published without calibration");
    }
  }
  info->header = image->header;
  publishRecordedStage(frame, image->header.stamp);
  images_.publish(image, info);
}

void CameraDriver::publishRecordedStage(const device::Frame& frame, const ros::Time& stamp) {
  if (!frame.stage_position_m) return;
  if (!stage_publisher_) stage_publisher_ = node_.advertise<StageState>("stage_state", 10);
  const Pose pose(Eigen::Translation3d(parameters_.axis * *frame.stage_position_m));
  const bool settled = frame.settled.value_or(true);
  std::vector<ros::Time> times = {stamp};
  double around = kSettledAround;
  if (recorded_stamp_ < stamp) {
    around = std::min(around, kSettledShare * (stamp - recorded_stamp_).toSec());
  }
  recorded_stamp_ = stamp;
  if (settled && stamp.toSec() > around) {
    // Whoever asks whether the stage stood still finds it standing around the stamp.
    times = {stamp - ros::Duration(around), stamp, stamp + ros::Duration(around)};
  }
  std::vector<geometry_msgs::TransformStamped> transforms;
  for (const ros::Time& time : times) {
    transforms.push_back(toTransformStamped(pose, time, parameters_.stage_frame_id,
                                            parameters_.stage_child_frame_id));
  }
  transforms_.sendTransform(transforms);
  StageState state;
  state.header.stamp = stamp;
  state.header.frame_id = parameters_.stage_frame_id;
  state.position = *frame.stage_position_m;
  state.velocity = settled ? 0.0 : std::nan("");
  state.homed = true;
  state.moving = !settled;
  stage_publisher_.publish(state);
}

std::string CameraDriver::storeName() const {
  if (!parameters_.name.empty()) return parameters_.name;
  const std::lock_guard<std::mutex> lock(mutex_);
  return LensStore::nameFrom(identity_.serial);
}

void CameraDriver::chooseLens() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (lens_) return;
  }
  try {
    if (std::optional<LensFile> stored = LensStore(parameters_.store).load(storeName())) {
      setLens(std::move(*stored));
    } else if (const auto recorded = camera_->lensFile()) {
      setLens(readLensFile(*recorded));
    } else {
      ROS_INFO("no calibration of this camera yet");
    }
  } catch (const std::exception& e) {
    ROS_ERROR_STREAM("starting without calibration: " << printable(e.what(), 1000));
  }
}

void CameraDriver::setLens(LensFile file) {
  auto lens = std::make_shared<Lens>();
  lens->info = toCameraInfo(file);
  lens->file = std::move(file);
  std_msgs::Header header;
  header.stamp = ros::Time::now();
  header.frame_id = parameters_.frame_id;
  const LensModelMessage message = toLensModelMessage(lens->file, header);
  lens->yaml = message.yaml;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    lens_ = std::move(lens);
  }
  lens_publisher_.publish(message);
}

void CameraDriver::onLens(const LensModelMessage::ConstPtr& message) {
  try {
    if (message->header.frame_id != parameters_.frame_id) return;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      if (lens_ && lens_->yaml == message->yaml) return;
    }
    // Published again by us, so that the latched messages of both agree.
    setLens(fromLensModelMessage(*message, "lens_model"));
    ROS_INFO("took over a new calibration");
  } catch (const std::exception& e) {
    ROS_WARN_STREAM_THROTTLE(10.0, "lens_model refused: " << printable(e.what(), 1000));
  }
}

bool CameraDriver::setCameraInfo(sensor_msgs::SetCameraInfo::Request& request,
                                 sensor_msgs::SetCameraInfo::Response& response) {
  try {
    LensFile file = fromCameraInfo(request.camera_info, "set_camera_info");
    file.camera_name = storeName();
    const std::filesystem::path path = LensStore(parameters_.store).save(file.camera_name, file);
    setLens(std::move(file));
    response.success = true;
    response.status_message = "saved as " + path.string();
    ROS_INFO_STREAM("calibration " << response.status_message);
  } catch (const std::exception& e) {
    response.success = false;
    response.status_message = e.what();
    ROS_WARN_STREAM("set_camera_info refused: " << printable(e.what(), 1000));
  }
  return true;
}

void CameraDriver::diagnose(diagnostic_updater::DiagnosticStatusWrapper& status) {
  using diagnostic_msgs::DiagnosticStatus;
  const std::lock_guard<std::mutex> lock(mutex_);
  const double seconds = secondsSince(last_report_);
  const double rate =
      seconds > 0.0 ? static_cast<double>(frames_ - frames_at_last_report_) / seconds : 0.0;
  frames_at_last_report_ = frames_;
  last_report_ = Steady::now();
  if (state_ == "lost" || state_ == "opening") {
    status.summary(DiagnosticStatus::ERROR, state_ == "lost" ? "no camera" : "opening the camera");
  } else if (!problem_.empty()) {
    status.summary(DiagnosticStatus::ERROR, problem_);
  } else {
    status.summary(DiagnosticStatus::OK, state_);
  }
  status.add("state", state_);
  status.add("camera", describe(identity_));
  status.add("frames published", frames_);
  status.add("frames lost", lost_);
  status.add("rate [Hz]", rate);
  status.add("failed attempts and losses of the device", losses_of_device_);
  status.add("last problem", printable(problem_));
  status.add("calibrated", lens_ ? "yes" : "no");
}

}  // namespace omnister
