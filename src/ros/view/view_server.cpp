// SPDX-License-Identifier: Apache-2.0
#include "ros/view/view_server.h"

#include <cv_bridge/cv_bridge.h>
#include <sensor_msgs/distortion_models.h>
#include <sensor_msgs/image_encodings.h>

#include <algorithm>

#include "health/diagnostic_pace.h"
#include "omnister/common/error.h"
#include "ros/message/conversions.h"
#include "ros/message/image_input.h"
#include "ros/node/live_parameters.h"

namespace omnister {
namespace {

namespace enc = sensor_msgs::image_encodings;

constexpr std::uint32_t kLensesWaiting = 16;  // in a shorter queue the one that counts may be lost
constexpr double kWidestPinhole = 3.0;        // [rad]
constexpr double kWarningPeriod = 5.0;        // [s]
constexpr std::size_t kMostFrames = 16;

/// "camera_optical" -> "camera_view_optical".
std::string viewFrame(const std::string& camera_frame) {
  const std::string ending = "_optical";
  const std::size_t n = camera_frame.size();
  const bool optical = n > ending.size() && camera_frame.compare(n - ending.size(), n, ending) == 0;
  return (optical ? camera_frame.substr(0, n - ending.size()) : camera_frame) + "_view_optical";
}

ViewGeometry geometryOf(const ViewConfig& config) {
  return makeViewGeometry(projectionOf(config.projection), {config.width, config.height},
                          config.hfov, viewRotation(config.pan, config.tilt, config.roll));
}

/// The picture in an encoding that can be shown in part: Bayer is debayered, 16-bit grey stays.
cv::Mat picture(const sensor_msgs::ImageConstPtr& image, std::string* encoding) {
  if (image->encoding == enc::MONO16 || image->encoding == enc::TYPE_16UC1) {
    *encoding = enc::MONO16;
    return cv_bridge::toCvShare(image, "")->image;
  }
  const bool color = !(image->encoding == enc::MONO8 || image->encoding == enc::TYPE_8UC1);
  *encoding = color ? enc::BGR8 : enc::MONO8;
  return toMat8(image, color);
}

ViewParameters load(const ros::NodeHandle& private_node) {
  Parameters parameters(private_node);
  return loadViewParameters(parameters);
}

}  // namespace

ViewParameters loadViewParameters(Parameters& parameters) {
  ViewParameters result;
  // The limits are those of cfg/View.cfg; dynamic_reconfigure would clamp silently.
  const ViewConfig& least = ViewConfig::__getMin__();
  const ViewConfig& most = ViewConfig::__getMax__();
  ViewConfig& view = result.view;
  view.projection = parameters.choice("projection", view.projection,
                                      {"pinhole", "cylindrical", "equirectangular"});
  view.pan = parameters.number("pan", view.pan, least.pan, most.pan, "rad");
  view.tilt = parameters.number("tilt", view.tilt, least.tilt, most.tilt, "rad");
  view.roll = parameters.number("roll", view.roll, least.roll, most.roll, "rad");
  view.hfov = parameters.number("hfov", view.hfov, least.hfov,
                                view.projection == "pinhole" ? kWidestPinhole : most.hfov, "rad");
  view.width = parameters.integer("width", view.width, least.width, most.width);
  view.height = parameters.integer("height", view.height, least.height, most.height);
  view.anti_alias = parameters.flag("anti_alias", view.anti_alias);
  result.lens = parameters.text("lens", "");
  result.frame_id = parameters.frame("frame_id", "");
  parameters.warnUnknown();
  return result;
}

ViewServer::ViewServer(const ros::NodeHandle& node, const ros::NodeHandle& private_node)
    : parameters_(load(private_node)),
      node_(callbacks_.on(node)),
      transport_(node_),
      config_(parameters_.view),
      diagnostics_(node, private_node, private_node.getNamespace()) {
  if (!parameters_.lens.empty()) {
    lens_ = fromFileOf(private_node, "lens", [this] { return readLensFile(parameters_.lens); });
  }
  config_server_ = std::make_unique<dynamic_reconfigure::Server<ViewConfig>>(
      config_mutex_, callbacks_.on(private_node));
  config_server_->setCallback([this](ViewConfig& config, std::uint32_t) { configure(config); });

  const image_transport::SubscriberStatusCallback images_changed =
      [this](const image_transport::SingleSubscriberPublisher&) { onConnection(); };
  const ros::SubscriberStatusCallback infos_changed =
      [this](const ros::SingleSubscriberPublisher&) { onConnection(); };
  image_publisher_ = transport_.advertiseCamera("view/image_raw", 1, images_changed, images_changed,
                                                infos_changed, infos_changed);
  depth_publisher_ = transport_.advertiseCamera("view/depth/image_raw", 1, images_changed,
                                                images_changed, infos_changed, infos_changed);
  if (!lens_) {
    lens_subscriber_ = node_.subscribe<LensModelMessage>(
        "lens_model", kLensesWaiting,
        [this](const LensModelMessage::ConstPtr& message) { onLens(message); });
  }
  diagnostics_.setHardwareID("none");
  diagnostics_.add("view", this, &ViewServer::diagnose);
  diagnostics_timer_ = node_.createSteadyTimer(
      ros::WallDuration(kDiagnosticPeriod),
      [this](const ros::SteadyTimerEvent&) { diagnostics_.force_update(); });
  callbacks_.start();
}

ViewServer::~ViewServer() { callbacks_.stop(); }

void ViewServer::configure(ViewConfig& config) {
  const std::lock_guard<std::mutex> lock(mutex_);
  keepFinite(config, config_);
  if (config.projection != "cylindrical" && config.projection != "equirectangular")
    config.projection = "pinhole";
  // Whoever asked sees what became of it.
  if (config.projection == "pinhole") config.hfov = std::min(config.hfov, kWidestPinhole);
  config_ = config;
  maps_.reset();
  if (!camera_frame_.empty()) frameFor(camera_frame_);
}

void ViewServer::onConnection() {
  try {
    const bool images = image_publisher_.getNumSubscribers() > 0;
    if (images && !image_subscriber_) {
      {
        const std::lock_guard<std::mutex> tally(mutex_);
        images_.numbers.reset();
      }
      image_subscriber_ = transport_.subscribe(
          "image_raw", 1, [this](const sensor_msgs::ImageConstPtr& image) { onImage(image); },
          ros::VoidPtr(),
          image_transport::TransportHints("raw", ros::TransportHints().tcpNoDelay()));
    } else if (!images && image_subscriber_) {
      image_subscriber_.shutdown();
      image_subscriber_ = {};
    }
    const bool depths = depth_publisher_.getNumSubscribers() > 0;
    if (depths && !range_subscriber_) {
      {
        const std::lock_guard<std::mutex> tally(mutex_);
        ranges_.numbers.reset();
      }
      range_subscriber_ = node_.subscribe<sensor_msgs::Image>(
          "range", 1, [this](const sensor_msgs::ImageConstPtr& range) { onRange(range); },
          ros::VoidConstPtr(), ros::TransportHints().tcpNoDelay());
    } else if (!depths && range_subscriber_) {
      range_subscriber_.shutdown();
      range_subscriber_ = {};
    }
  } catch (const std::exception& error) {
    say(error);
  }
}

void ViewServer::Tally::take(const std_msgs::Header& header) {
  ++received;
  missed += numbers.before(header);
}

void ViewServer::say(const std::exception& error) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    problem_ = error.what();
  }
  ROS_WARN_THROTTLE(kWarningPeriod, "no view: %s", printable(error.what(), 500).c_str());
}

void ViewServer::drop(Tally& tally, const std::exception& error) {
  say(error);
  const std::lock_guard<std::mutex> lock(mutex_);
  ++tally.failed;
}

void ViewServer::onLens(const LensModelMessage::ConstPtr& message) {
  try {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      // Latched lenses of camera and calibration arrive in any order: the later one is right.
      if (lens_ && (message->header.stamp < lens_stamp_ || message->yaml == lens_text_)) return;
    }
    LensFile file = fromLensModelMessage(*message, node_.resolveName("lens_model"));
    const std::lock_guard<std::mutex> lock(mutex_);
    if (lens_ && message->header.stamp < lens_stamp_) return;
    lens_ = std::move(file);
    lens_text_ = message->yaml;
    lens_stamp_ = message->header.stamp;
    maps_.reset();
    if (!message->header.frame_id.empty()) frameFor(message->header.frame_id);
  } catch (const std::exception& error) {
    say(error);
  }
}

ViewServer::Maps& ViewServer::maps() {
  if (!lens_)
    throw Error("no lens yet: nothing on " + node_.resolveName("lens_model") +
                ", and no parameter ~lens");
  if (!maps_) {
    maps_ = Maps();
    maps_->geometry = geometryOf(config_);
    maps_->lens = *lens_;
    maps_->anti_alias = config_.anti_alias;
  }
  return *maps_;
}

const std::string& ViewServer::frameFor(const std::string& camera_frame) {
  const Eigen::Matrix3d rotation = viewRotation(config_.pan, config_.tilt, config_.roll);
  if (camera_frame != camera_frame_ || rotation != told_rotation_) {
    // tf keeps every frame that it was ever told of.
    if (camera_frame.size() > kLongestFrame)
      throw Error("the name of the camera's frame is too long");
    told_frames_.insert(camera_frame);
    if (told_frames_.size() > kMostFrames) {
      told_frames_.erase(camera_frame);
      throw Error("images came with " + std::to_string(kMostFrames) +
                  " other frames already: no further one is told to tf");
    }
    camera_frame_ = camera_frame;
    view_frame_ = parameters_.frame_id.empty() ? viewFrame(camera_frame) : parameters_.frame_id;
    told_rotation_ = rotation;
    Pose T_camera_view = Pose::Identity();
    T_camera_view.linear() = rotation;
    static_frames_->add(
        toTransformStamped(T_camera_view, ros::Time::now(), camera_frame_, view_frame_));
  }
  return view_frame_;
}

sensor_msgs::CameraInfo ViewServer::info(const ViewGeometry& geometry,
                                         const std_msgs::Header& header) const {
  sensor_msgs::CameraInfo info = uncalibratedCameraInfo(geometry.size.width, geometry.size.height);
  info.header = header;
  if (geometry.projection != Projection::kPinhole) return info;
  const double cx = 0.5 * (geometry.size.width - 1);
  const double cy = 0.5 * (geometry.size.height - 1);
  const double f = geometry.focal_px;
  info.distortion_model = sensor_msgs::distortion_models::PLUMB_BOB;
  info.D.assign(5, 0.0);
  info.K = {f, 0, cx, 0, f, cy, 0, 0, 1};
  info.R = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  info.P = {f, 0, cx, 0, 0, f, cy, 0, 0, 0, 1, 0};
  return info;
}

void ViewServer::onImage(const sensor_msgs::ImageConstPtr& image) {
  try {
    sensor_msgs::ImagePtr message;
    sensor_msgs::CameraInfoPtr camera_info;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      images_.take(image->header);
      Maps& maps = this->maps();
      checkFrame(*image, maps.lens.image_size, node_.resolveName("image_raw"));
      if (!maps.image)
        maps.image = std::make_unique<View>(*maps.lens.lens, maps.lens.image_size, maps.geometry,
                                            maps.anti_alias);
      std::string encoding;
      const cv::Mat pixels = picture(image, &encoding);
      cv::Mat view;
      message = newImage(maps.geometry.size, encoding, &view);
      if (view.type() != pixels.type()) throw Error("pixels are not " + printable(encoding));
      maps.image->render(pixels, view);
      message->header = image->header;
      message->header.frame_id = frameFor(image->header.frame_id);
      camera_info =
          boost::make_shared<sensor_msgs::CameraInfo>(info(maps.geometry, message->header));
    }
    image_publisher_.publish(message, camera_info);
    const std::lock_guard<std::mutex> lock(mutex_);
    ++images_.published;
    problem_.clear();
  } catch (const std::exception& error) {
    drop(images_, error);
  }
}

void ViewServer::onRange(const sensor_msgs::ImageConstPtr& range) {
  try {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      ranges_.take(range->header);
    }
    checkImage(*range);
    if (range->encoding != enc::TYPE_32FC1)
      throw InputError(node_.resolveName("range"), "encoding",
                       "is '" + printable(range->encoding) + "', expected 32FC1");
    sensor_msgs::ImagePtr message;
    sensor_msgs::CameraInfoPtr camera_info;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      Maps& maps = this->maps();
      if (!maps.depth)
        maps.depth =
            std::make_unique<DepthView>(*maps.lens.lens, maps.lens.image_size, maps.geometry);
      message =
          toImage(maps.depth->render(cv_bridge::toCvShare(range, "")->image), enc::TYPE_32FC1);
      message->header = range->header;
      message->header.frame_id = frameFor(range->header.frame_id);
      camera_info =
          boost::make_shared<sensor_msgs::CameraInfo>(info(maps.geometry, message->header));
    }
    depth_publisher_.publish(message, camera_info);
    const std::lock_guard<std::mutex> lock(mutex_);
    ++ranges_.published;
    problem_.clear();
  } catch (const std::exception& error) {
    drop(ranges_, error);
  }
}

void ViewServer::diagnose(diagnostic_updater::DiagnosticStatusWrapper& status) {
  const bool images_wanted = image_publisher_.getNumSubscribers() > 0;
  const bool depths_wanted = depth_publisher_.getNumSubscribers() > 0;
  const std::lock_guard<std::mutex> lock(mutex_);
  using diagnostic_msgs::DiagnosticStatus;
  if (!images_wanted && !depths_wanted)
    status.summary(DiagnosticStatus::OK, "idle: nobody listens");
  else if (!problem_.empty())
    status.summary(DiagnosticStatus::WARN, "no view: " + printable(problem_, 300));
  else
    status.summary(DiagnosticStatus::OK, "running");
  for (const auto& [name, tally] : {std::make_pair("images", &images_), {"ranges", &ranges_}}) {
    status.add(std::string(name) + " received", tally->received);
    status.add(std::string(name) + " published", tally->published);
    status.add(std::string(name) + " missed", tally->missed);
    status.add(std::string(name) + " failed", tally->failed);
  }
}

}  // namespace omnister
