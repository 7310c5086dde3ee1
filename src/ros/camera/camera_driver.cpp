// SPDX-License-Identifier: Apache-2.0
#include "ros/camera/camera_driver.h"

#include <image_transport/image_transport.h>
#include <ros/console.h>

#include <boost/make_shared.hpp>
#include <cmath>
#include <iomanip>
#include <sstream>

#include "omnister/common/numbers.h"
#include "omnister/lens/lens_file.h"
#include "omnister/lens/lens_store.h"
#include "ros/message/conversions.h"
#include "ros/node/live_parameters.h"
#include "ros/node/parameters.h"

namespace omnister {
namespace {

using Steady = std::chrono::steady_clock;
constexpr std::chrono::milliseconds kGrabTimeout(200);
// An unplugged camera is told of once, and again now and then.
constexpr std::chrono::seconds kRepeatProblem(30);
constexpr std::chrono::seconds kPollStatistics(1);
constexpr std::chrono::milliseconds kLookForListeners(50), kLookForLast(250);
// Rates are counted over so long at least [s].
constexpr double kStretch = 0.4;
// Frames that stay away for so long, and for four of their intervals, are a problem [s].
constexpr double kSilent = 0.7;
// A service waits so long for the device; what is asked for is done later all the same.
constexpr std::chrono::seconds kDeviceAnswers(3);
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

/// What the device told; the rest stays.
void fromControls(const device::CameraControls& controls, CameraConfig* config) {
  if (controls.exposure_us) config->exposure_us = *controls.exposure_us;
  if (controls.gain) config->gain = *controls.gain;
  if (controls.black_level) config->black_level = *controls.black_level;
  if (controls.frame_rate_hz) config->frame_rate = *controls.frame_rate_hz;
  if (!controls.exposure_auto.empty()) config->exposure_auto = controls.exposure_auto;
  if (!controls.gain_auto.empty()) config->gain_auto = controls.gain_auto;
}

/// The frame's own memory as a message where that can be; it goes back to its pool with the
/// message.
sensor_msgs::ImagePtr toMessage(const device::Frame& frame) {
  const cv::Mat& image = frame.image;
  if (!frame.memory || frame.memory->bytes.data() != image.data || image.rows == 0) {
    return toImage(image, frame.encoding);
  }
  const std::size_t bytes = image.step[0] * static_cast<std::size_t>(image.rows);
  if (bytes > frame.memory->bytes.size()) return toImage(image, frame.encoding);
  const boost::shared_ptr<sensor_msgs::Image> message(
      new sensor_msgs::Image, [memory = frame.memory](sensor_msgs::Image* done) {
        memory->bytes = std::move(done->data);
        delete done;
      });
  message->width = static_cast<std::uint32_t>(image.cols);
  message->height = static_cast<std::uint32_t>(image.rows);
  message->encoding = frame.encoding;
  message->is_bigendian = 0;
  message->step = static_cast<std::uint32_t>(image.step[0]);
  message->data = std::move(frame.memory->bytes);
  message->data.resize(bytes);
  return message;
}

}  // namespace

CameraParameters loadCameraParameters(const ros::NodeHandle& private_node) {
  Parameters source(private_node);
  CameraParameters p;
  p.device = source.text("device", p.device);
  // Not given: it goes on to say so, as of a camera that is not there.
  if (source.has("device")) source.file("device", p.device, device::checkCameraDevice);
  p.frame_id = source.frame("frame_id", p.frame_id);
  const std::string url = source.text("camera_info_url", "");
  p.lens = source.text("lens", pathOfUrl(url));
  p.store = source.text("store", p.store);
  p.name = source.text("name", p.name);
  if (!p.name.empty()) LensStore(p.store).pathOf(p.name);  // refuses names with path parts
  p.settings.frame_rate_hz =
      source.number("frame_rate", 0.0, 0.0, 1000.0, "Hz (0: the device's own)");
  const double exposure = source.number("exposure_us", 0.0, 0.0, 60e6, "us (0: the device's own)");
  if (exposure > 0.0) p.settings.exposure_us = exposure;
  const auto optional = [&source](const char* key, double min,
                                  double max) -> std::optional<double> {
    source.ignore(key);
    if (!source.has(key)) return std::nullopt;
    return source.number(key, 0.0, min, max);
  };
  p.settings.gain = optional("gain", -100.0, 1000.0);
  p.settings.black_level = optional("black_level", -10000.0, 10000.0);
  p.settings.exposure_auto = source.choice("exposure_auto", "", {"", "off", "once", "continuous"});
  p.settings.gain_auto = source.choice("gain_auto", "", {"", "off", "once", "continuous"});
  p.settings.pixel_format = source.text("pixel_format", "");
  p.settings.trigger = source.choice(
      "trigger", "off",
      {"off", "software", "line0", "line1", "line2", "line3", "line4", "line5", "line6", "line7"});
  constexpr int kMostPixels = 65535;
  p.settings.size.width = source.integer("width", 0, 0, kMostPixels);
  p.settings.size.height = source.integer("height", 0, 0, kMostPixels);
  if ((p.settings.size.width == 0) != (p.settings.size.height == 0)) {
    throw InputError("parameters", "width, height", "expected both, or none");
  }
  p.settings.offset.x = source.integer("offset_x", -1, -1, kMostPixels);
  p.settings.offset.y = source.integer("offset_y", -1, -1, kMostPixels);
  p.settings.binning.width = source.integer("binning_x", 0, 0, 16);
  p.settings.binning.height = source.integer("binning_y", 0, 0, 16);
  p.settings.features = source.texts("features");
  for (const std::string& feature : p.settings.features) {
    if (feature.find('=') != std::string::npos) continue;
    throw InputError("parameter " + private_node.resolveName("features"), "",
                     "has \"" + printable(feature) + "\", expected Name=value");
  }
  p.settings.buffers = source.integer("buffers", p.settings.buffers, 2, 256);
  p.settings.stamp_offset_us = source.number("stamp_offset_us", 0.0, -1e6, 1e6, "us");
  p.settings.stamp_is_exposure_end =
      source.choice("stamp_reference", "exposure_start", {"exposure_start", "exposure_end"}) ==
      "exposure_end";
  p.settings.packet_size = source.integer("packet_size", 0, 0, 16384);
  p.settings.packet_delay_us = source.integer("packet_delay_us", 0, 0, 1000000);
  p.settings.packet_resend = source.flag("packet_resend", true);
  p.settings.socket_buffer_bytes = source.integer("socket_buffer", 0, 0, 1 << 30);
  p.settings.chunks = source.flag("chunks", false);
  p.settings.ptp = source.flag("ptp", false);
  p.settings.loop = source.flag("loop", false);
  p.settings.paced = source.flag("paced", true);
  p.settings.recorded_stamps = source.flag("recorded_stamps", false);
  p.parent_frame_id = source.frame("parent_frame_id", "");
  p.mount = source.pose("mount", p.mount);
  p.retry_period_s = source.number("retry_period", p.retry_period_s, 0.05, 60.0, "s");
  p.start_grace_s = source.number("start_grace", p.start_grace_s, 0.0, 60.0, "s");
  p.watchdog_s = source.number("watchdog", p.watchdog_s, 0.1, 600.0, "s");
  p.exit_on_error = source.flag("exit_on_error", false);
  p.stage_frame_id = source.frame("stage_frame_id", p.stage_frame_id);
  p.stage_child_frame_id = source.frame("stage_child_frame_id", p.stage_child_frame_id);
  p.axis = source.direction("axis", p.axis);
  p.diagnostic_period_s =
      source.number("diagnostic_period", p.diagnostic_period_s, 0.05, 60.0, "s");
  source.warnUnknown();
  return p;
}

std::unique_ptr<device::Camera> openDevice(const CameraParameters& parameters) {
  return device::openCamera(parameters.device, parameters.settings);
}

CameraDriver::CameraDriver(const ros::NodeHandle& node, const ros::NodeHandle& private_node,
                           CameraParameters parameters, OpenCamera open)
    : node_(callbacks_.on(node)),
      parameters_(std::move(parameters)),
      open_(std::move(open)),
      lens_(node_, parameters_.frame_id, parameters_.store, parameters_.name),
      stretch_began_(Steady::now()),
      settings_(parameters_.settings),
      last_frame_(Steady::now()),
      private_node_(callbacks_.on(private_node)),
      diagnostics_(node, private_node, private_node.getNamespace()) {
  if (!parameters_.lens.empty()) {
    lens_.set(fromFileOf(private_node, "lens", [this] { return readLensFile(parameters_.lens); }));
  }
  if (!parameters_.parent_frame_id.empty()) {
    static_frames_ = StaticFrames::shared();
    const ros::Time now = ros::Time::now();
    const std::string link = linkFrame(parameters_.frame_id);
    static_frames_->add(
        toTransformStamped(parameters_.mount, now, parameters_.parent_frame_id, link));
    static_frames_->add(toTransformStamped(opticalInLink(), now, link, parameters_.frame_id));
  }
  images_ = image_transport::ImageTransport(node_).advertiseCamera("image_raw", 4);
  diagnostics_.setHardwareID("none");
  diagnostics_.add("camera", this, &CameraDriver::diagnose);
  trigger_ = node_.advertiseService("trigger", &CameraDriver::onTrigger, this);
  timer_ = node_.createSteadyTimer(ros::WallDuration(parameters_.diagnostic_period_s),
                                   [this](const ros::SteadyTimerEvent&) { report(); });
  thread_ = std::thread(&CameraDriver::run, this);
  pthread_setname_np(thread_.native_handle(), "camera");
  callbacks_.start();
}

CameraDriver::~CameraDriver() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    stop_ = true;
  }
  wake_.notify_all();
  thread_.join();
  {
    // Who still waits is told that nobody comes.
    const std::lock_guard<std::mutex> lock(mutex_);
    tasks_.clear();
  }
  callbacks_.stop();
}

void CameraDriver::waitFor(double seconds) {
  const Steady::time_point end = Steady::now() + std::chrono::duration_cast<Steady::duration>(
                                                     std::chrono::duration<double>(seconds));
  while (!stop_ && Steady::now() < end) {
    {
      std::unique_lock<std::mutex> lock(mutex_);
      wake_.wait_until(lock, end, [this] { return stop_.load() || !tasks_.empty(); });
    }
    runTasks();
  }
}

bool CameraDriver::wanted() {
  // Asking goes through the publishers of every transport: not for each frame.
  if (Steady::now() >= wanted_due_) {
    wanted_ = images_.getNumSubscribers() > 0;
    wanted_due_ = Steady::now() + (wanted_ ? kLookForLast : kLookForListeners);
  }
  return wanted_;
}

void CameraDriver::run() {
  while (!stop_) {
    try {
      openIfNeeded();
      runTasks();
      stream();
      pollStatistics();
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

void CameraDriver::setState(const std::string& state, const std::string& problem) {
  bool changed = false;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    changed = state != state_ || problem.empty() != problem_.empty();
    state_ = state;
    problem_ = problem;
  }
  if (changed) reportSoon();
}

void CameraDriver::openIfNeeded() {
  if (camera_) return;
  CameraParameters wanted = parameters_;
  wanted.settings = settings_;
  camera_ = open_(wanted);
  const device::CameraIdentity identity = camera_->identity();
  if (camera_->live()) settings_.identity = identity;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    identity_ = identity;
    opened_once_ = true;
  }
  setState("idle", "");
  ROS_INFO_STREAM("opened " << printable(describe(identity)));
  last_sequence_.reset();
  streamed_ = false;
  torn_ = 0;
  takeRemarks();
  takeControls(camera_->controls());
  statistics_due_ = Steady::time_point();
  lens_.choose(identity.serial, camera_->lensFile());
}

void CameraDriver::close(const std::string& problem) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    ++losses_of_device_;
  }
  setState("lost", problem);
  tell(problem);
  // Takes seconds where the device does not answer.
  if (camera_) camera_->abandon();
  camera_.reset();
  streaming_ = false;
}

void CameraDriver::tell(const std::string& problem) {
  if (parameters_.exit_on_error) {
    ROS_ERROR_STREAM(printable(problem, 1000));
    failed_ = true;
    return;
  }
  // What starts beside the camera, or with its power, may be there before it.
  const std::chrono::duration<double> since_start = Steady::now() - started_;
  if (!opened_once_ && since_start.count() < parameters_.start_grace_s) return;
  if (problem == told_problem_ && Steady::now() - told_at_ < kRepeatProblem) return;
  told_problem_ = problem;
  told_at_ = Steady::now();
  ROS_WARN_STREAM("no camera, trying again every " << parameters_.retry_period_s
                                                   << " s: " << printable(problem, 1000));
}

void CameraDriver::stream() {
  if (camera_->finished()) {
    if (streaming_) {
      camera_->stop();
      streaming_ = false;
      setState("finished", "");
      ROS_INFO("the recording is over");
    }
    waitFor(0.1);
    return;
  }
  if (!wanted()) {
    if (streaming_) {
      camera_->stop();
      streaming_ = false;
      setState("idle", "");
      ROS_DEBUG("nobody listens, streaming stops");
    }
    waitFor(std::chrono::duration<double>(kLookForListeners).count());
    return;
  }
  if (!streaming_) {
    camera_->start();
    streaming_ = true;
    streamed_ = false;
    last_frame_ = Steady::now();
    setState("streaming", "");
    ROS_DEBUG("streaming");
  }
  const std::optional<device::Frame> frame = camera_->grab(kGrabTimeout);
  if (frame) {
    countLost(*frame);
    if (streamed_) interval_s_ = secondsSince(last_frame_);
    last_frame_ = Steady::now();
    streamed_ = true;
    publish(*frame);
  } else if (!camera_->finished()) {
    watch();
  }
}

void CameraDriver::watch() {
  if (settings_.trigger != "off") return;
  const double silent = secondsSince(last_frame_);
  if (silent <= std::max(parameters_.watchdog_s, slowest_s_)) {
    // Said before it is acted upon, as the frames came until now.
    if (streamed_ && silent > std::max({kSilent, 4.0 * interval_s_, slowest_s_})) {
      setState("streaming",
               "no frame since " + formatNumber(std::round(10.0 * silent) / 10.0) + " s");
    }
    return;
  }
  std::ostringstream problem;
  problem << std::fixed << std::setprecision(1) << "the camera gives no frame for " << silent
          << " s";
  if (camera_->live()) {
    // A camera whose frames come torn is not lost, and opening it again would not mend that.
    const std::uint64_t torn = camera_->statistics().incomplete;
    if (torn <= torn_) {
      if (!streamed_) {
        problem << " although it was started (a firewall, packets larger than the network lets "
                   "through, or too many of them for it?)";
      }
      throw device::CameraError(problem.str());
    }
    problem << ": " << torn - torn_
            << " came incomplete (a lower frame_rate, larger packet_size, packet_delay_us or "
               "socket_buffer may help)";
    torn_ = torn;
    last_frame_ = Steady::now();
  }
  setState("streaming", problem.str());
  ROS_WARN_STREAM_THROTTLE(10.0, problem.str());
}

void CameraDriver::takeRemarks() {
  for (const std::string& remark : camera_->takeRemarks()) {
    ROS_WARN_STREAM(printable(remark, 1000));
  }
  for (const std::string& detail : camera_->takeDetails()) {
    ROS_DEBUG_STREAM(printable(detail, 1000));
  }
}

void CameraDriver::pollStatistics() {
  // A device that has gone silent may not answer either, and the watchdog must not wait for it.
  if (streaming_ && streamed_ && secondsSince(last_frame_) > 0.5 * kSilent) return;
  if (Steady::now() < statistics_due_) return;
  statistics_due_ = Steady::now() + kPollStatistics;
  takeRemarks();
  const device::CameraStatistics statistics = camera_->statistics();
  // Only what is torn while nothing else comes counts for the watchdog.
  if (secondsSince(last_frame_) < kPollStatistics.count()) torn_ = statistics.incomplete;
  const std::lock_guard<std::mutex> lock(mutex_);
  statistics_ = statistics;
}

void CameraDriver::takeControls(const device::CameraControls& controls) {
  // At most three frames may be missing, and the first comes after the exposure.
  slowest_s_ = controls.exposure_us.value_or(0.0) * 2e-6;
  const double rate = controls.frame_rate_hz.value_or(settings_.frame_rate_hz);
  if (rate > 0.0) slowest_s_ = std::max(slowest_s_, 3.0 / rate);
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    controls_ = controls;
    controls_changed_ = true;
  }
  reportSoon();
}

void CameraDriver::callDevice(const Task& task) {
  std::packaged_task<void(device::Camera*)> packaged(task);
  std::future<void> done = packaged.get_future();
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (stop_) throw Error("the driver ends");
    tasks_.push_back(std::move(packaged));
  }
  wake_.notify_all();
  if (done.wait_for(kDeviceAnswers) != std::future_status::ready) {
    throw Error("the camera is being opened, and takes its time");
  }
  try {
    done.get();
  } catch (const std::future_error&) {
    throw Error("the driver ends");
  }
}

void CameraDriver::runTasks() {
  while (true) {
    std::packaged_task<void(device::Camera*)> task;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      if (tasks_.empty()) return;
      task = std::move(tasks_.front());
      tasks_.pop_front();
    }
    task(camera_.get());
    if (camera_) takeRemarks();
  }
}

bool CameraDriver::onTrigger(std_srvs::Trigger::Request& /*request*/,
                             std_srvs::Trigger::Response& response) {
  try {
    callDevice([this](device::Camera* camera) {
      if (!camera) throw device::CameraError("there is no camera now");
      if (settings_.trigger != "software") {
        throw device::CameraError("the parameter trigger is \"" + settings_.trigger +
                                  "\", not \"software\"");
      }
      if (!streaming_) throw device::CameraError("nobody listens to the images");
      camera->trigger();
    });
    response.success = true;
  } catch (const std::exception& e) {
    response.success = false;
    response.message = e.what();
  }
  return true;
}

void CameraDriver::configure(CameraConfig& config) {
  keepFinite(config, config_);
  device::CameraControls wanted;
  // What is as it was is not touched: it may be another's choice, or the device's own.
  if (config.exposure_us > 0.0 && config.exposure_us != config_.exposure_us) {
    wanted.exposure_us = config.exposure_us;
  }
  if (config.gain != config_.gain) wanted.gain = config.gain;
  if (config.black_level != config_.black_level) wanted.black_level = config.black_level;
  if (config.frame_rate > 0.0 && config.frame_rate != config_.frame_rate) {
    wanted.frame_rate_hz = config.frame_rate;
  }
  if (config.exposure_auto != config_.exposure_auto) wanted.exposure_auto = config.exposure_auto;
  if (config.gain_auto != config_.gain_auto) wanted.gain_auto = config.gain_auto;
  try {
    callDevice([this, wanted](device::Camera* camera) {
      device::CameraControls taken = wanted;
      if (camera) {
        const device::CameraControls now = camera->setControls(wanted);
        takeControls(now);
        if (now.exposure_us) taken.exposure_us = now.exposure_us;
        if (now.gain) taken.gain = now.gain;
        if (now.black_level) taken.black_level = now.black_level;
        if (now.frame_rate_hz) taken.frame_rate_hz = now.frame_rate_hz;
      }
      // A camera that comes back gets them again.
      if (wanted.exposure_us) settings_.exposure_us = taken.exposure_us;
      if (wanted.gain) settings_.gain = taken.gain;
      if (wanted.black_level) settings_.black_level = taken.black_level;
      if (wanted.frame_rate_hz) settings_.frame_rate_hz = *taken.frame_rate_hz;
      if (!wanted.exposure_auto.empty()) settings_.exposure_auto = wanted.exposure_auto;
      if (!wanted.gain_auto.empty()) settings_.gain_auto = wanted.gain_auto;
    });
    const std::lock_guard<std::mutex> lock(mutex_);
    fromControls(controls_, &config);
  } catch (const std::exception& e) {
    ROS_WARN_STREAM("configuration: " << printable(e.what(), 1000));
  }
  config_ = config;
}

void CameraDriver::reportSoon() {
  callbacks_.post([this] { report(); });
}

void CameraDriver::report() {
  bool opened = false;
  bool changed = false;
  device::CameraControls controls;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    opened = opened_once_;
    changed = std::exchange(controls_changed_, false);
    controls = controls_;
    if (opened) diagnostics_.setHardwareID(identity_.serial);
  }
  if (opened && !config_server_) {
    // Not before there is a device: what is not known is not written to the parameters. Who asks
    // for something from now on waits until it can be done.
    const boost::recursive_mutex::scoped_lock lock(config_mutex_);
    config_server_ =
        std::make_unique<dynamic_reconfigure::Server<CameraConfig>>(config_mutex_, private_node_);
    config_ = CameraConfig::__getDefault__();
    fromControls(controls, &config_);
    config_server_->updateConfig(config_);
    // The server calls back at once.
    config_server_->setCallback([this](CameraConfig& config, std::uint32_t) {
      if (config_ready_) configure(config);
    });
    config_ready_ = true;
  } else if (changed && config_server_) {
    const boost::recursive_mutex::scoped_lock lock(config_mutex_);
    fromControls(controls, &config_);
    config_server_->updateConfig(config_);
  }
  diagnostics_.force_update();
}

void CameraDriver::countLost(const device::Frame& frame) {
  const std::uint64_t gap = last_sequence_ && frame.sequence > *last_sequence_ + 1
                                ? frame.sequence - *last_sequence_ - 1
                                : 0;
  last_sequence_ = frame.sequence;
  told_problem_.clear();
  bool back = false;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    ++frames_;
    lost_ += gap;
    last_number_ = frame.number;
    back = !problem_.empty();
    problem_.clear();
  }
  if (back) reportSoon();
}

void CameraDriver::publish(const device::Frame& frame) {
  const sensor_msgs::CameraInfoPtr info = lens_.infoFor(frame);
  const sensor_msgs::ImagePtr image = toMessage(frame);
  image->header.stamp = toRosTime(frame.stamp);
  image->header.frame_id = parameters_.frame_id;
  // Those in our process get this very message: they see by its number what they missed.
  image->header.seq = ++published_;
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

void CameraDriver::diagnose(diagnostic_updater::DiagnosticStatusWrapper& status) {
  using diagnostic_msgs::DiagnosticStatus;
  const CameraLens::Calibrated calibrated = lens_.calibrated();
  const std::lock_guard<std::mutex> lock(mutex_);
  const double seconds = secondsSince(stretch_began_);
  if (seconds >= kStretch) {
    rate_hz_ = static_cast<double>(frames_ - frames_then_) / seconds;
    lost_lately_ = lost_ - lost_then_;
    frames_then_ = frames_;
    lost_then_ = lost_;
    stretch_began_ = Steady::now();
  }
  if (state_ == "lost" || state_ == "opening") {
    status.summary(DiagnosticStatus::ERROR, state_ == "lost" ? "no camera" : "opening the camera");
  } else if (!problem_.empty()) {
    status.summary(DiagnosticStatus::ERROR, problem_);
  } else if (lost_lately_ > 0) {
    status.summary(DiagnosticStatus::WARN,
                   "frames get lost: " + std::to_string(lost_lately_) + " just now");
  } else if (!calibrated.yes && !calibrated.problem.empty()) {
    status.summary(DiagnosticStatus::WARN, "the stored calibration cannot be used");
  } else {
    status.summary(DiagnosticStatus::OK, state_);
  }
  status.add("state", state_);
  status.add("camera", describe(identity_));
  status.add("link", printable(statistics_.link));
  status.add("frames published", frames_);
  status.add("frames lost", lost_);
  status.add("number of the last frame", last_number_);
  status.add("rate [Hz]", rate_hz_);
  status.add("frames incomplete", statistics_.incomplete);
  status.add("frames without memory", statistics_.underruns);
  status.add("packets missing", statistics_.missing_packets);
  status.add("packets sent again", statistics_.resent_packets);
  if (statistics_.temperature_c) status.add("temperature [C]", *statistics_.temperature_c);
  status.add("failed attempts and losses of the device", losses_of_device_);
  status.add("last problem", printable(problem_));
  status.add("calibrated", calibrated.yes               ? "yes"
                           : calibrated.problem.empty() ? "no"
                                                        : "no: " + calibrated.problem);
}

}  // namespace omnister
