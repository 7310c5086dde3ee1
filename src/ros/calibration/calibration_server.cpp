// SPDX-License-Identifier: Apache-2.0
#include "ros/calibration/calibration_server.h"

#include <sensor_msgs/image_encodings.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <limits>

#include "health/diagnostic_pace.h"
#include "omnister/common/contained_path.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_models.h"
#include "omnister/lens/lens_store.h"
#include "ros/message/conversions.h"
#include "ros/message/image_input.h"
#include "ros/node/action_status.h"

template <>
void actionlib::ActionServer<omnister::CalibrateAction>::publishStatus() {
  const boost::recursive_mutex::scoped_lock lock(lock_);
  status_pub_.publish(
      omnister::detail::actionStatus(status_list_, last_cancel_, status_list_timeout_));
}

namespace omnister {
namespace {

namespace fs = std::filesystem;

constexpr double kStageTimeout = 5.0;   // [s] for the stage's action to appear
constexpr double kMoveTimeout = 120.0;  // [s] for one move
constexpr std::size_t kMostPositions = 1000;
constexpr double kResidualMagnification = 100.0;

bool knownModel(const std::string& model) {
  const std::vector<std::string>& names = lensModelNames();
  return model == "auto" || std::find(names.begin(), names.end(), model) != names.end();
}

std::string allModels() {
  std::string text = "auto";
  for (const std::string& name : lensModelNames()) text += ", " + name;
  return text;
}

CalibrationParameters load(const ros::NodeHandle& private_node) {
  Parameters parameters(private_node);
  return loadCalibrationParameters(parameters);
}

}  // namespace

CalibrationParameters loadCalibrationParameters(Parameters& parameters) {
  CalibrationParameters result;
  const std::string target = parameters.text("target", "");
  if (target.empty()) throw InputError("~target", "", "is not set, expected a TARGET.yaml");
  result.target = parameters.file("target", target, readTarget);
  result.model = parameters.text("model", result.model);
  if (!knownModel(result.model))
    throw InputError("~model", "",
                     "is '" + printable(result.model) + "', expected one of " + allModels());
  result.store = parameters.text("store", "");
  result.camera_name = parameters.text("camera_name", result.camera_name);
  LensStore(result.store).pathOf(result.camera_name);  // refuses names that are no file names
  result.views = parameters.integer("views", result.views, 3, 1000);
  result.timeout = parameters.number("timeout", result.timeout, 1.0, 86400.0, "s");
  result.dwell = parameters.number("dwell", result.dwell, 0.0, 600.0, "s");
  for (const std::string& text : parameters.texts("positions")) {
    const auto numbers = parseNumbers(text);
    if (!numbers || numbers->size() > kMostPositions ||
        !std::all_of(numbers->begin(), numbers->end(), [](double x) { return std::isfinite(x); }))
      throw InputError("~positions", "",
                       "is '" + printable(text) + "', expected finite numbers \"0.0 0.1 …\" [m]");
    result.positions.insert(result.positions.end(), numbers->begin(), numbers->end());
  }
  result.start = parameters.flag("start", result.start);
  result.collector.min_move = parameters.number("min_move", result.collector.min_move, 0.0, 1.0);
  result.collector.still_px =
      parameters.number("still_px", result.collector.still_px, 0.01, 1e4, "px");
  result.detector.seconds_per_image =
      parameters.number("seconds_per_image", result.detector.seconds_per_image, 0.01, 600.0, "s");
  result.detector.threads = parameters.integer("threads", 0, 0, 256);
  parameters.warnUnknown();
  return result;
}

CalibrationServer::CalibrationServer(const ros::NodeHandle& node,
                                     const ros::NodeHandle& private_node)
    : parameters_(load(private_node)),
      node_(callbacks_.on(node)),
      transport_(node_),
      diagnostics_(node, private_node, private_node.getNamespace()) {
  lens_publisher_ = node_.advertise<LensModelMessage>("lens_model", 1, true);
  // Latched: the last picture stays to be seen.
  coverage_publisher_ = node_.advertise<sensor_msgs::Image>("coverage", 1, true);
  residuals_publisher_ = node_.advertise<sensor_msgs::Image>("residuals", 1, true);
  goal_publisher_ = node_.advertise<CalibrateActionGoal>("calibrate/goal", 1);
  mover_ = std::make_unique<Mover>(node_, "move_stage", true);
  diagnostics_.setHardwareID("none");
  diagnostics_.add("calibration", this, &CalibrationServer::diagnose);
  diagnostics_timer_ = node_.createSteadyTimer(
      ros::WallDuration(kDiagnosticPeriod),
      [this](const ros::SteadyTimerEvent&) { diagnostics_.force_update(); });
  worker_ = std::thread([this] { run(); });
  server_ = std::make_unique<Server>(
      node_, "calibrate", [this](const CalibrateGoalConstPtr& goal) { execute(goal); }, false);
  server_->start();
  ros::NodeHandle own = callbacks_.on(private_node);
  services_ = {own.advertiseService("start", &CalibrationServer::onStart, this),
               own.advertiseService("save", &CalibrationServer::onSave, this),
               own.advertiseService("reset", &CalibrationServer::onReset, this)};
  callbacks_.start();
  if (parameters_.start) begin();
}

void CalibrationServer::begin() {
  const CalibrateActionGoal goal;
  goal_publisher_.publish(goal);
}

bool CalibrationServer::onStart(std_srvs::Trigger::Request& /*request*/,
                                std_srvs::Trigger::Response& response) {
  if (server_->isActive()) {
    response.success = 0;
    response.message = "it is under way";
    return true;
  }
  begin();
  response.success = 1;
  response.message = "collecting views; see the topic " + node_.resolveName("coverage");
  return true;
}

bool CalibrationServer::onSave(std_srvs::Trigger::Request& /*request*/,
                               std_srvs::Trigger::Response& response) {
  if (server_->isActive()) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      save_now_ = true;
    }
    progress_.notify_all();
    response.success = 1;
    response.message = "fitting the views there are: the action's result and the topic " +
                       node_.resolveName("lens_model") + " tell the outcome";
    return true;
  }
  try {
    const CalibrateResult result = fitAndCommit(parameters_.model);
    response.success = 1;
    response.message = result.lens_file + ": " + result.model + ", RMS " +
                       formatNumber(result.rms_px) + " px over " +
                       std::to_string(result.views_used) + " views";
    std::lock_guard<std::mutex> lock(mutex_);
    collector_.reset();
    state_ = "idle";
  } catch (const std::exception& error) {
    response.success = 0;
    response.message = printable(error.what(), 500);
    std::lock_guard<std::mutex> lock(mutex_);
    state_ = "idle";
  }
  return true;
}

bool CalibrationServer::onReset(std_srvs::Trigger::Request& /*request*/,
                                std_srvs::Trigger::Response& response) {
  std::lock_guard<std::mutex> lock(mutex_);
  const std::size_t views = collector_ ? collector_->detections().views.size() : 0;
  collector_.reset();
  response.success = 1;
  response.message = std::to_string(views) + " views forgotten";
  return true;
}

CalibrationServer::~CalibrationServer() {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    stopping_ = true;
  }
  wake_.notify_all();
  progress_.notify_all();
  // Joins the thread of execute(), which sees stopping_ and still needs the server.
  server_->shutdown();
  worker_.join();
  callbacks_.stop();
}

void CalibrationServer::execute(const CalibrateGoalConstPtr& goal) {
  CalibrateResult result;
  result.rms_px = result.holdout_rms_px = result.max_theta =
      std::numeric_limits<double>::quiet_NaN();
  const auto finish = [&](const std::string& message) {
    image_subscriber_.shutdown();
    std::lock_guard<std::mutex> lock(mutex_);
    state_ = "idle";
    last_problem_ = message;
    result.views =
        collector_ ? static_cast<std::uint32_t>(collector_->detections().views.size()) : 0;
    newest_.reset();
    save_now_ = false;
    // After a lens nothing of the views is needed; else the next goal goes on with them.
    if (result.success != 0) collector_.reset();
  };
  try {
    result = calibrateOnce(*goal);
    finish("");
    server_->setSucceeded(result, result.message);
  } catch (const Preempted&) {
    if (moving_) mover_->cancelGoal();
    moving_ = false;
    finish("cancelled");
    result.message = "cancelled";
    server_->setPreempted(result, result.message);
  } catch (const std::exception& error) {
    finish(error.what());
    result.message = error.what();
    ROS_ERROR("calibration failed: %s", printable(error.what(), 500).c_str());
    server_->setAborted(result, result.message);
  }
}

void CalibrationServer::checkPreempted() {
  bool stopping = false;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    stopping = stopping_;
  }
  if (stopping || server_->isPreemptRequested() || !ros::ok()) throw Preempted();
}

void CalibrationServer::feedback(const std::string& stage) {
  CalibrateFeedback feedback;
  feedback.stage = stage;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    state_ = stage;
    if (collector_) {
      feedback.views = static_cast<std::uint32_t>(collector_->detections().views.size());
      feedback.images = static_cast<std::uint32_t>(collector_->images());
      feedback.coverage = collector_->coverage();
      feedback.hint = collector_->hint();
    }
  }
  server_->publishFeedback(feedback);
}

void CalibrationServer::moveTo(double position) {
  feedback("moving");
  const ros::SteadyTime start = ros::SteadyTime::now();
  while (!mover_->waitForServer(ros::Duration(0.1))) {
    checkPreempted();
    if ((ros::SteadyTime::now() - start).toSec() > kStageTimeout)
      throw Error("positions were given, but nothing offers the action " +
                  node_.resolveName("move_stage"));
  }
  MoveStageGoal goal;
  goal.position = position;
  mover_->sendGoal(goal);
  moving_ = true;
  while (!mover_->waitForResult(ros::Duration(0.1))) {
    checkPreempted();
    if ((ros::SteadyTime::now() - start).toSec() > kMoveTimeout) {
      mover_->cancelGoal();
      moving_ = false;
      throw Error("the stage did not arrive at " + formatNumber(position) + " m in time");
    }
  }
  moving_ = false;
  const auto result = mover_->getResult();
  if (mover_->getState() != actionlib::SimpleClientGoalState::SUCCEEDED || !result ||
      !result->success)
    throw Error("the stage did not move to " + formatNumber(position) + " m: " +
                printable(result && !result->message.empty() ? result->message
                                                             : mover_->getState().getText()));
}

bool CalibrationServer::waitForViews(std::size_t views, double seconds) {
  const ros::SteadyTime start = ros::SteadyTime::now();
  for (;;) {
    checkPreempted();
    feedback("collecting");
    std::unique_lock<std::mutex> lock(mutex_);
    const auto enough = [&] {
      return save_now_ || (collector_ && collector_->detections().views.size() >= views);
    };
    if (enough()) return true;
    if ((ros::SteadyTime::now() - start).toSec() > seconds) return false;
    progress_.wait_for(lock, std::chrono::milliseconds(200), [&] { return stopping_ || enough(); });
  }
}

CalibrateResult CalibrationServer::calibrateOnce(const CalibrateGoal& goal) {
  const std::string model = goal.model.empty() ? parameters_.model : goal.model;
  if (!knownModel(model))
    throw InputError("goal", "model",
                     "is '" + printable(model) + "', expected one of " + allModels());
  if (goal.views > 1000) throw InputError("goal", "views", "is more than 1000");
  if (!std::isfinite(goal.timeout) || goal.timeout < 0.0)
    throw InputError("goal", "timeout", "is not a number of seconds");
  if (goal.positions.size() > kMostPositions)
    throw InputError("goal", "positions", "are more than " + std::to_string(kMostPositions));
  for (const double position : goal.positions)
    if (!std::isfinite(position)) throw InputError("goal", "positions", "are not all finite");
  const std::size_t views =
      goal.views > 0 ? goal.views : static_cast<std::size_t>(parameters_.views);
  const double timeout = goal.timeout > 0.0 ? goal.timeout : parameters_.timeout;

  const std::vector<double> positions =
      goal.positions.empty() ? parameters_.positions : goal.positions;

  {
    std::lock_guard<std::mutex> lock(mutex_);
    newest_.reset();
    last_problem_.clear();
    save_now_ = false;
    views_wanted_ = views;
  }
  image_subscriber_ = transport_.subscribe(
      "image_raw", 1, [this](const sensor_msgs::ImageConstPtr& image) { onImage(image); });
  const ros::SteadyTime start = ros::SteadyTime::now();
  const auto left = [&] { return timeout - (ros::SteadyTime::now() - start).toSec(); };

  const auto collected = [&] {
    std::lock_guard<std::mutex> lock(mutex_);
    return collector_ ? collector_->detections().views.size() : 0;
  };
  for (const double position : positions) {
    const std::size_t before = collected();
    if (before >= views || left() <= 0.0) break;
    moveTo(position);
    waitForViews(before + 1, std::min(parameters_.dwell, left()));
  }
  const bool enough = waitForViews(views, left());
  image_subscriber_.shutdown();
  if (!enough) {
    std::string message;
    Detections detections;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      if (collector_) detections = collector_->detections();
      const int images = collector_ ? collector_->images() : 0;
      message = std::to_string(detections.views.size()) + " of " + std::to_string(views) +
                " views within " + formatNumber(timeout) + " s, from " + std::to_string(images) +
                " images on " + node_.resolveName("image_raw") +
                (last_problem_.empty() ? "" : " (" + last_problem_ + ")");
    }
    if (!detections.views.empty())
      message += "; they are kept in " + keepViews(detections).string() +
                 ": start again to go on, or call ~save to fit them";
    throw Error(message);
  }
  CalibrateResult result = fitAndCommit(model);
  checkPreempted();
  return result;
}

fs::path CalibrationServer::keepViews(const Detections& detections) const {
  const fs::path path = pathInside(LensStore(parameters_.store).folder(),
                                   parameters_.camera_name + "_detections.csv", "~store", "");
  writeFileAtomically(path, formatDetections(detections), Previous::kKeep);
  return path;
}

CalibrateResult CalibrationServer::fitAndCommit(const std::string& model) {
  const std::lock_guard<std::mutex> one(fit_mutex_);
  Detections detections;
  std::string frame_id;
  cv::Mat picture;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    if (!collector_ || collector_->detections().views.empty())
      throw Error("there are no views yet: start first");
    detections = collector_->detections();
    frame_id = frame_id_;
    picture = collector_->draw({std::to_string(detections.views.size()) + " views"});
    state_ = "fitting";
  }
  publishPicture(coverage_publisher_, picture, frame_id, ros::Time::now());
  if (server_->isActive()) feedback("fitting");
  // The views are worth keeping even if the fit refuses them.
  keepViews(detections);
  CalibrationOptions options;
  options.model = model;
  options.threads = parameters_.detector.threads;
  CalibrationResult fit = calibrate(detections, options);
  if (server_->isActive()) {
    checkPreempted();
    feedback("saving");
  }
  fit.file.camera_name = parameters_.camera_name;
  const fs::path path = LensStore(parameters_.store).save(parameters_.camera_name, fit.file);
  publishLens(fit.file, frame_id);

  CalibrateResult result;
  result.success = true;
  for (const std::string& warning : fit.warnings)
    result.message += (result.message.empty() ? "" : "; ") + printable(warning, 500);
  result.lens_file = path.string();
  result.model = std::string(fit.file.lens->model());
  result.rms_px = fit.rms_px;
  result.holdout_rms_px = fit.holdout_rms_px.value_or(std::numeric_limits<double>::quiet_NaN());
  result.max_theta = fit.file.lens->maxTheta();
  result.views_used = static_cast<std::uint32_t>(std::count_if(
      fit.views.begin(), fit.views.end(), [](const ViewResult& view) { return view.used; }));
  result.points = static_cast<std::uint32_t>(fit.points);
  std::vector<std::vector<Eigen::Vector2d>> residuals;
  for (const ViewResult& view : fit.views)
    residuals.push_back(view.used ? view.residuals : std::vector<Eigen::Vector2d>());
  char summary[120];
  std::snprintf(summary, sizeof summary, "%s: RMS %.3f px, %u views, residuals x %.0f",
                result.model.c_str(), result.rms_px, result.views_used, kResidualMagnification);
  publishPicture(residuals_publisher_,
                 drawResiduals(detections, residuals, kResidualMagnification, {summary}), frame_id,
                 ros::Time::now());
  ROS_INFO("calibrated %s: %s, %u views, %u corners, RMS %.3f px", parameters_.camera_name.c_str(),
           result.model.c_str(), result.views_used, result.points, result.rms_px);
  return result;
}

void CalibrationServer::publishLens(const LensFile& file, const std::string& frame_id) {
  std_msgs::Header header;
  header.stamp = ros::Time::now();
  header.frame_id = frame_id;
  lens_publisher_.publish(toLensModelMessage(file, header));
}

void CalibrationServer::onImage(const sensor_msgs::ImageConstPtr& image) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    if (newest_) ++dropped_;
    newest_ = image;
  }
  wake_.notify_all();
}

void CalibrationServer::run() {
  for (;;) {
    sensor_msgs::ImageConstPtr image;
    {
      std::unique_lock<std::mutex> lock(mutex_);
      wake_.wait(lock, [&] { return stopping_ || newest_; });
      if (stopping_) return;
      image = std::move(newest_);
      newest_.reset();
    }
    try {
      look(image);
    } catch (const std::exception& error) {
      ROS_WARN_THROTTLE(5.0, "%s", printable(error.what(), 500).c_str());
      std::lock_guard<std::mutex> lock(mutex_);
      last_problem_ = error.what();
    }
  }
}

void CalibrationServer::look(const sensor_msgs::ImageConstPtr& image) {
  checkFrame(*image, {}, node_.resolveName("image_raw"));
  const cv::Mat gray = toGray(*image, significantBits(*image));
  const std::optional<ViewDetections> found =
      detectTarget(gray, parameters_.target, parameters_.detector);
  cv::Mat picture;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    if (state_ == "idle" || state_ == "fitting" || state_ == "saving") return;
    // Views of images of another size cannot go on.
    if (!collector_ || collector_->detections().image_size != gray.size())
      collector_.emplace(gray.size(), parameters_.collector);
    frame_id_ = image->header.frame_id;
    switch (collector_->add(gray, found)) {
      case ViewCollector::Verdict::kNotFound:
        last_problem_ = "the target was not found in the last image";
        break;
      case ViewCollector::Verdict::kMoving:
        last_problem_ = "the target moves in the image";
        break;
      case ViewCollector::Verdict::kAlike:
        last_problem_ = "the target is where it was in an earlier view";
        break;
      case ViewCollector::Verdict::kTaken:
        last_problem_.clear();
        break;
    }
    if (coverage_publisher_.getNumSubscribers() > 0) picture = collector_->draw(guidance());
  }
  progress_.notify_all();
  if (!picture.empty())
    publishPicture(coverage_publisher_, picture, image->header.frame_id, image->header.stamp);
}

std::vector<std::string> CalibrationServer::guidance() const {
  char progress[80];
  std::snprintf(progress, sizeof progress, "%zu of %zu views, %.0f %% covered",
                collector_->detections().views.size(), views_wanted_,
                100.0 * collector_->coverage());
  return {progress, "next: " + collector_->hint(),
          last_problem_.empty() ? "taken: now hold it elsewhere" : last_problem_};
}

void CalibrationServer::publishPicture(const ros::Publisher& publisher, const cv::Mat& picture,
                                       const std::string& frame_id, const ros::Time& stamp) const {
  const sensor_msgs::ImagePtr message = toImage(picture, sensor_msgs::image_encodings::BGR8);
  message->header.frame_id = frame_id;
  message->header.stamp = stamp;
  publisher.publish(message);
}

void CalibrationServer::diagnose(diagnostic_updater::DiagnosticStatusWrapper& status) {
  std::lock_guard<std::mutex> lock(mutex_);
  using diagnostic_msgs::DiagnosticStatus;
  status.summary(DiagnosticStatus::OK, state_ == "idle" && !last_problem_.empty()
                                           ? "idle; " + printable(last_problem_, 300)
                                           : state_);
  if (collector_) {
    status.add("views", collector_->detections().views.size());
    status.add("images", collector_->images());
    status.add("coverage", collector_->coverage());
  }
  status.add("images dropped while busy", dropped_);
}

}  // namespace omnister
