// SPDX-License-Identifier: Apache-2.0
#include "ros/scan/scan_server.h"

#include <sensor_msgs/image_encodings.h>

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "omnister/common/contained_path.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/image_file.h"
#include "omnister/common/image_motion.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_store.h"
#include "ros/message/conversions.h"
#include "ros/message/image_input.h"
#include "ros/node/action_status.h"
#include "ros/node/parameters.h"

template <>
void actionlib::ActionServer<omnister::ScanAction>::publishStatus() {
  const boost::recursive_mutex::scoped_lock lock(lock_);
  status_pub_.publish(
      omnister::detail::actionStatus(status_list_, last_cancel_, status_list_timeout_));
}

namespace omnister {
namespace {

namespace fs = std::filesystem;
namespace encodings = sensor_msgs::image_encodings;

constexpr double kActionTimeout = 5.0;  // for the stage's action to appear [s]
constexpr double kEndTimeout = 10.0;    // for a cancelled motion to end [s]
constexpr double kRemembered = 20.0;    // readings of the stage are kept this long [s]
constexpr std::size_t kMostStops = 10000;
// Images wait for a reading of the stage after them; more of them means that none comes.
constexpr std::size_t kMostWaiting = 100;
constexpr std::size_t kMostBytesWaiting = std::size_t{1} << 30;
constexpr std::size_t kMostReadings = 20000;
constexpr std::size_t kMostFrames = 100000;
constexpr double kFarthest = 1e4;  // what is farther away is no reading of a stage [m]
constexpr double kSlack = 1e-9;

double age(const ros::SteadyTime& since) { return (ros::SteadyTime::now() - since).toSec(); }

}  // namespace

ScanParameters loadScanParameters(const ros::NodeHandle& private_node) {
  Parameters source(private_node);
  ScanParameters p;
  p.settle_time_s = source.number("settle_time", p.settle_time_s, 0.0, 10.0, "s");
  p.settle_distance_m = source.number("settle_distance", p.settle_distance_m, 0.0, 0.1, "m");
  p.still_px = source.number("still_px", p.still_px, 0.0, 1000.0, "px");
  p.stop_timeout_s = source.number("stop_timeout", p.stop_timeout_s, 0.1, 3600.0, "s");
  p.max_wait_s = source.number("max_wait", p.max_wait_s, 0.05, 60.0, "s");
  p.folder = source.text("folder", "");
  source.warnUnknown();
  return p;
}

std::vector<double> stopsOf(const ScanGoal& goal) {
  const auto refuse = [](const char* key, const std::string& problem) {
    throw InputError("scan", key, problem);
  };
  const auto finite = [&](const char* key, double value) {
    if (!std::isfinite(value)) refuse(key, "is not finite");
  };
  finite("start", goal.start);
  finite("stop", goal.stop);
  finite("step", goal.step);
  finite("speed", goal.speed);
  if (goal.speed < 0.0) refuse("speed", "is negative");
  if (goal.frames > kMostFrames) refuse("frames", "are more than 100000");
  for (const double position : goal.positions) finite("positions", position);
  if (goal.positions.size() > kMostStops) refuse("positions", "are more than 10000");
  if (!goal.positions.empty()) return goal.positions;
  if (goal.step < 0.0) refuse("step", "is negative");
  if (goal.start == goal.stop) refuse("stop", "is the start, and there are no positions");
  if (goal.step == 0.0) return {};
  const double steps = std::floor(std::abs(goal.stop - goal.start) / goal.step + 1e-6);
  if (steps >= static_cast<double>(kMostStops)) refuse("step", "makes more than 10000 stops");
  std::vector<double> stops;
  const double sign = goal.stop > goal.start ? 1.0 : -1.0;
  for (int i = 0; i <= static_cast<int>(steps); ++i) {
    stops.push_back(goal.start + sign * i * goal.step);
  }
  return stops;
}

ScanServer::ScanServer(const ros::NodeHandle& node, const ScanParameters& parameters)
    : parameters_(parameters), node_(callbacks_.on(node)), transport_(node_) {
  frame_publisher_ = node_.advertise<StageFrame>("stage_frames", 100);
  image_publisher_ = transport_.advertise("scan/image_raw", 10);
  state_subscriber_ = node_.subscribe("stage_state", 200, &ScanServer::onState, this);
  mover_ = std::make_unique<Mover>(node_, "move_stage", true);
  server_ = std::make_unique<Server>(
      node_, "scan", [this](const ScanGoalConstPtr& goal) { execute(goal); }, false);
  server_->start();
  callbacks_.start();
}

ScanServer::~ScanServer() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    stopping_ = true;
  }
  wake_.notify_all();
  // Joins the thread of execute(), which sees stopping_ and still needs the server.
  server_->shutdown();
  callbacks_.stop();
}

void ScanServer::onImage(const sensor_msgs::ImageConstPtr& image) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    waiting_.push_back({image, ros::SteadyTime::now()});
    std::size_t bytes = 0;
    for (const Waiting& waiting : waiting_) bytes += waiting.image->data.size();
    for (; waiting_.size() > kMostWaiting || (bytes > kMostBytesWaiting && waiting_.size() > 1);
         ++dropped_) {
      bytes -= waiting_.front().image->data.size();
      waiting_.pop_front();
    }
  }
  wake_.notify_all();
}

void ScanServer::onState(const StageState::ConstPtr& state) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    const ros::Time stamp = state->header.stamp;
    if (!canReckonWith(stamp)) return;
    if (!(std::abs(state->position) <= kFarthest)) return;
    if (!readings_.empty() && stamp < readings_.back().stamp) readings_.clear();
    if (readings_.empty() || stamp != readings_.back().stamp) readings_.emplace_back();
    Reading& reading = readings_.back();
    reading.stamp = stamp;
    reading.position = state->position;
    reading.velocity = state->velocity;
    reading.moving = state->moving;
    reading.homed = state->homed;
    reading.faulty = !state->fault.empty();
    while ((stamp - readings_.front().stamp).toSec() > kRemembered ||
           readings_.size() > kMostReadings) {
      readings_.pop_front();
    }
  }
  wake_.notify_all();
}

void ScanServer::checkPreempted() {
  bool stopping = false;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    stopping = stopping_;
  }
  if (stopping || server_->isPreemptRequested() || !ros::ok()) throw Preempted();
}

void ScanServer::pause() {
  std::unique_lock<std::mutex> lock(mutex_);
  wake_.wait_for(lock, std::chrono::milliseconds(20));
}

void ScanServer::feedback(const std::string& state) {
  ScanFeedback feedback;
  feedback.state = state;
  feedback.index = index_;
  feedback.stops = stops_;
  feedback.frames = static_cast<std::uint32_t>(tagged_.size());
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (!readings_.empty()) feedback.position = readings_.back().position;
  }
  server_->publishFeedback(feedback);
}

void ScanServer::execute(const ScanGoalConstPtr& goal) {
  ScanResult result;
  const auto finish = [&] {
    image_subscriber_.shutdown();
    const std::lock_guard<std::mutex> lock(mutex_);
    waiting_.clear();
    result.frames = static_cast<std::uint32_t>(tagged_.size());
    result.settled = static_cast<std::uint32_t>(std::count_if(
        tagged_.begin(), tagged_.end(), [](const Tagged& tagged) { return tagged.frame.settled; }));
  };
  try {
    run(*goal);
    writeRecording();
    finish();
    result.success = true;
    result.folder = folder_.string();
    server_->setSucceeded(result);
  } catch (const Preempted&) {
    endMove();
    finish();
    result.message = "cancelled";
    server_->setPreempted(result, result.message);
  } catch (const std::exception& e) {
    endMove();
    finish();
    result.message = e.what();
    ROS_ERROR_STREAM("scan failed: " << printable(e.what(), 1000));
    server_->setAborted(result, result.message);
  }
}

void ScanServer::run(const ScanGoal& goal) {
  tagged_.clear();
  last_gray_.release();
  last_obstacle_.clear();
  encoding_.clear();
  size_ = {};
  index_ = stops_ = settled_here_ = 0;
  sweeping_ = false;
  folder_.clear();
  scan_ = std::to_string(ros::Time::now().toNSec());
  const std::vector<double> stops = stopsOf(goal);
  if (!goal.folder.empty()) {
    const fs::path root =
        parameters_.folder.empty() ? LensStore({}).folder() / "scans" : parameters_.folder;
    const fs::path folder = pathInside(root, goal.folder, "scan", "folder");
    std::error_code error;
    if (fs::exists(folder, error) && !fs::is_empty(folder, error)) {
      throw InputError("scan", "folder", "\"" + printable(goal.folder) + "\" is not empty");
    }
    fs::create_directories(folder, error);
    if (error) throw IoError("make the folder", goal.folder, error.value());
    folder_ = folder;
  }
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    waiting_.clear();
    dropped_ = 0;
  }
  arrived_ = ros::TIME_MAX;
  image_subscriber_ = transport_.subscribe("image_raw", 20, &ScanServer::onImage, this);
  if (stops.empty()) {
    runSweep(goal);
  } else {
    runStops(goal, stops);
  }
  const std::lock_guard<std::mutex> lock(mutex_);
  if (dropped_ > 0) {
    throw Error(std::to_string(dropped_) + " images came without a reading of the stage");
  }
}

void ScanServer::beginMove(double position, double speed) {
  const ros::SteadyTime start = ros::SteadyTime::now();
  while (!mover_->waitForServer(ros::Duration(0.05))) {
    checkPreempted();
    if (age(start) > kActionTimeout) {
      throw Error("nothing offers the action " + node_.resolveName("move_stage"));
    }
  }
  MoveStageGoal goal;
  goal.position = position;
  goal.speed = speed;
  mover_->sendGoal(goal);
  moving_ = true;
}

bool ScanServer::moveOver(double position) {
  if (!mover_->getState().isDone()) return false;
  moving_ = false;
  const MoveStageResultConstPtr result = mover_->getResult();
  if (mover_->getState() == actionlib::SimpleClientGoalState::SUCCEEDED && result &&
      result->success) {
    return true;
  }
  throw Error("the stage did not move to " + formatNumber(position) + " m: " +
              printable(result && !result->message.empty() ? result->message
                                                           : mover_->getState().getText()));
}

void ScanServer::moveTo(double position, double speed) {
  beginMove(position, speed);
  while (!moveOver(position)) {
    checkPreempted();
    tagWaiting();
    feedback("moving");
    pause();
  }
}

void ScanServer::endMove() {
  if (!moving_) return;
  mover_->cancelGoal();
  const ros::SteadyTime start = ros::SteadyTime::now();
  while (!mover_->getState().isDone() && age(start) < kEndTimeout && ros::ok()) {
    ros::WallDuration(0.01).sleep();
  }
  moving_ = false;
}

void ScanServer::runStops(const ScanGoal& goal, const std::vector<double>& stops) {
  stops_ = static_cast<std::uint32_t>(stops.size());
  const std::uint32_t wanted = std::max<std::uint32_t>(1, goal.frames);
  for (index_ = 0; index_ < stops_; ++index_) {
    arrived_ = ros::TIME_MAX;
    moveTo(stops[index_], goal.speed);
    arrived_ = ros::Time::now();
    settled_here_ = 0;
    last_obstacle_ = "no image came";
    const ros::SteadyTime start = ros::SteadyTime::now();
    while (settled_here_ < wanted) {
      checkPreempted();
      tagWaiting();
      feedback("settling");
      if (age(start) > parameters_.stop_timeout_s + parameters_.max_wait_s) {
        throw Error("no settled image at " + formatNumber(stops[index_]) + " m within " +
                    formatNumber(parameters_.stop_timeout_s) + " s: " + last_obstacle_);
      }
      if (settled_here_ < wanted) pause();
    }
  }
}

void ScanServer::runSweep(const ScanGoal& goal) {
  moveTo(goal.start, 0.0);
  tagged_.clear();
  sweeping_ = true;
  index_ = 0;
  stops_ = 1;
  arrived_ = ros::Time::now();
  beginMove(goal.stop, goal.speed);
  while (!moveOver(goal.stop)) {
    checkPreempted();
    tagWaiting();
    feedback("moving");
    pause();
  }
  // Those that were taken before the end and have no reading after them yet.
  const ros::Time end = ros::Time::now();
  const ros::SteadyTime start = ros::SteadyTime::now();
  while (age(start) < parameters_.max_wait_s) {
    checkPreempted();
    tagWaiting();
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      const bool read = !readings_.empty() && readings_.back().stamp > end;
      if (read && (waiting_.empty() || waiting_.front().image->header.stamp > end)) break;
    }
    pause();
  }
  if (tagged_.empty()) throw Error("no image came during the sweep");
}

void ScanServer::tagWaiting() {
  while (true) {
    Waiting next;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      if (waiting_.empty()) return;
      next = waiting_.front();
    }
    if (!tag(next.image, age(next.since) < parameters_.max_wait_s)) return;
    const std::lock_guard<std::mutex> lock(mutex_);
    if (!waiting_.empty() && waiting_.front().image == next.image) waiting_.pop_front();
  }
}

bool ScanServer::restsAround(const ros::Time& stamp, bool* later) const {
  const ros::Duration around(parameters_.settle_time_s);
  *later = readings_.empty() || readings_.back().stamp < stamp + around;
  const Reading* before = nullptr;
  double low = INFINITY, high = -INFINITY;
  bool moving = false;
  for (const Reading& reading : readings_) {
    const ros::Time time = reading.stamp;
    if (time <= stamp - around) {
      // The last one before tells of the beginning.
      before = &reading;
      low = high = reading.position;
      moving = reading.moving;
      continue;
    }
    low = std::min(low, reading.position);
    high = std::max(high, reading.position);
    moving = moving || reading.moving || reading.faulty;
    if (time >= stamp + around) break;
  }
  return before != nullptr && !moving && high - low <= parameters_.settle_distance_m + kSlack;
}

bool ScanServer::tag(const sensor_msgs::ImageConstPtr& image, bool patient) {
  Tagged tagged;
  bool rests = false;
  bool known = false;
  const ros::Time stamp = image->header.stamp;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    bool later = false;
    rests = restsAround(stamp, &later);
    if (later && patient) return false;
    const auto after = std::find_if(readings_.begin(), readings_.end(),
                                    [&](const Reading& r) { return r.stamp >= stamp; });
    if (after != readings_.end() && after != readings_.begin()) {
      const Reading& last = *(after - 1);
      const double share = (stamp - last.stamp).toSec() / (after->stamp - last.stamp).toSec();
      tagged.frame.position = last.position + share * (after->position - last.position);
      tagged.frame.velocity = last.velocity + share * (after->velocity - last.velocity);
      known = last.homed && after->homed && !last.faulty && !after->faulty;
    }
  }
  // An image without a position is of no use to anybody.
  if (!known) {
    last_obstacle_ = "the stage gives no reading around the images, or is not homed";
    return true;
  }
  tagged.frame.header = image->header;
  tagged.frame.scan = scan_;
  const bool here = stamp > arrived_;
  if (sweeping_) {
    if (!here) return true;
    index_ = static_cast<std::uint32_t>(tagged_.size());
  }
  tagged.frame.index = index_;
  if (!rests) {
    last_obstacle_ = "the stage does not rest";
    last_gray_.release();
  } else {
    // The picture may swing for longer than the stage.
    cv::Mat gray = toGray(*image, significantBits(*image)).clone();
    const bool first = last_gray_.empty();
    const bool look = parameters_.still_px > 0.0 && !first;
    // Where there is nothing to see, the stage's word is enough.
    const double motion = look ? imageMotion(last_gray_, gray).value_or(0.0) : 0.0;
    tagged.frame.settled = motion <= parameters_.still_px && (look || parameters_.still_px == 0.0);
    if (motion > parameters_.still_px) {
      last_obstacle_ = "the picture moved by " + formatNumber(std::round(motion * 100.0) / 100.0) +
                       " px from one image to the next";
    }
    last_gray_ = std::move(gray);
  }
  if (tagged.frame.settled && here) ++settled_here_;
  if (!folder_.empty() && (sweeping_ || (tagged.frame.settled && here))) keep(*image, &tagged);
  frame_publisher_.publish(tagged.frame);
  if (tagged.frame.settled) image_publisher_.publish(image);
  if (tagged_.size() >= kMostFrames) throw Error("more than 100000 images");
  // Nobody asks for the names again.
  tagged.frame.header.frame_id.clear();
  tagged.frame.scan.clear();
  tagged_.push_back(std::move(tagged));
  return true;
}

void ScanServer::keep(const sensor_msgs::Image& image, Tagged* tagged) {
  // A PNG has its own order of bytes, and so has the image.
  const bool swapped = image.is_bigendian != 0 && encodings::bitDepth(image.encoding) == 16;
  const bool bayer = encodings::isBayer(image.encoding) && !swapped;
  char name[32];
  std::snprintf(name, sizeof(name), "%05zu.png", tagged_.size());
  const std::string encoding = bayer ? image.encoding : "";
  if (!encoding_.empty() && encoding != encoding_) {
    throw Error("the images change their encoding on the way");
  }
  encoding_ = encoding;
  const cv::Size size(static_cast<int>(image.width), static_cast<int>(image.height));
  if (!size_.empty() && size != size_) throw Error("the images change their size on the way");
  size_ = size;
  // As the sensor gave them where a recording can say so; else as they look.
  cv::Mat pixels;
  if (bayer || (encodings::isMono(image.encoding) && !swapped)) {
    checkImage(image);
    const int type = encodings::bitDepth(image.encoding) == 16 ? CV_16UC1 : CV_8UC1;
    pixels = cv::Mat(static_cast<int>(image.height), static_cast<int>(image.width), type,
                     const_cast<std::uint8_t*>(image.data.data()), image.step);
  } else {
    pixels = toBgr(image, significantBits(image));
  }
  writeImage(folder_ / name, pixels);
  tagged->file = name;
}

void ScanServer::writeRecording() {
  if (folder_.empty()) return;
  std::string text = "version: 1\n";
  if (!encoding_.empty()) text += "encoding: " + encoding_ + "\n";
  text += "frames:\n";
  for (const Tagged& tagged : tagged_) {
    if (tagged.file.empty()) continue;
    char line[200];
    std::snprintf(line, sizeof(line),
                  "  - {image: %s, stamp: %u.%09u, stage_position_m: %.9f, settled: %s}\n",
                  tagged.file.c_str(), tagged.frame.header.stamp.sec,
                  tagged.frame.header.stamp.nsec, tagged.frame.position,
                  tagged.frame.settled ? "true" : "false");
    text += line;
  }
  writeFileAtomically(folder_ / "replay.yaml", text);
}

}  // namespace omnister
