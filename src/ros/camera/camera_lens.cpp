// SPDX-License-Identifier: Apache-2.0
#include "ros/camera/camera_lens.h"

#include <ros/console.h>

#include <boost/make_shared.hpp>
#include <utility>

#include "omnister/common/error.h"
#include "omnister/lens/lens_part.h"
#include "omnister/lens/lens_store.h"
#include "ros/message/conversions.h"

namespace omnister {

CameraLens::CameraLens(ros::NodeHandle node, std::string frame_id, std::string store,
                       std::string name)
    : frame_id_(std::move(frame_id)), store_(std::move(store)), name_(std::move(name)) {
  publisher_ = node.advertise<LensModelMessage>("lens_model", 1, true);
  set_camera_info_ = node.advertiseService("set_camera_info", &CameraLens::setCameraInfo, this);
  list_lenses_ = node.advertiseService("list_lenses", &CameraLens::listLenses, this);
  roll_back_lens_ = node.advertiseService("roll_back_lens", &CameraLens::rollBack, this);
  subscriber_ = node.subscribe("lens_model", 1, &CameraLens::onLens, this);
}

CameraLens::Calibrated CameraLens::calibrated() const {
  const std::lock_guard<std::mutex> lock(mutex_);
  return {lens_ != nullptr, problem_};
}

void CameraLens::checkSize(cv::Size size) const {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (size_.empty() || size == size_ || (region_ && size == region_->sensor)) return;
  throw InputError("set_camera_info", "width, height",
                   "are " + std::to_string(size.width) + ", " + std::to_string(size.height) +
                       ", expected the images' " + std::to_string(size_.width) + ", " +
                       std::to_string(size_.height));
}

void CameraLens::show(const device::SensorRegion& region) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (region_ && region_->sensor == region.sensor && region_->region == region.region &&
        region_->binning == region.binning)
      return;
    region_ = region;
  }
  publish();
}

sensor_msgs::CameraInfoPtr CameraLens::infoFor(const device::Frame& frame) {
  if (frame.region) show(*frame.region);
  const cv::Size size = frame.image.size();
  std::shared_ptr<const Lens> lens;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    lens = lens_;
    size_ = size;
  }
  auto info = boost::make_shared<sensor_msgs::CameraInfo>();
  const bool part = frame.region && !frame.region->whole();
  if (lens && lens->file.image_size == size) {
    // Calibrated as it streams, a part of the sensor or not.
    *info = lens->info;
    return info;
  }
  if (lens && part && lens->file.image_size == frame.region->sensor) {
    *info = lens->info;
  } else {
    if (lens) {
      ROS_ERROR_STREAM_THROTTLE(30.0, "the lens is of " << lens->file.image_size.width << "x"
                                                        << lens->file.image_size.height
                                                        << " pixels, the images have " << size.width
                                                        << "x" << size.height
                                                        << ": published without calibration");
    }
    const cv::Size whole = part ? frame.region->sensor : size;
    *info = uncalibratedCameraInfo(whole.width, whole.height);
  }
  if (part) {
    // REP 104: the calibration is of the whole sensor, the image a part of it.
    const device::SensorRegion& region = *frame.region;
    info->binning_x = static_cast<std::uint32_t>(region.binning.width);
    info->binning_y = static_cast<std::uint32_t>(region.binning.height);
    info->roi.x_offset = static_cast<std::uint32_t>(region.region.x);
    info->roi.y_offset = static_cast<std::uint32_t>(region.region.y);
    info->roi.width = static_cast<std::uint32_t>(region.region.width);
    info->roi.height = static_cast<std::uint32_t>(region.region.height);
  }
  return info;
}

std::string CameraLens::storeName() const {
  if (!name_.empty()) return name_;
  const std::lock_guard<std::mutex> lock(mutex_);
  return LensStore::nameFrom(serial_);
}

void CameraLens::choose(const std::string& serial,
                        const std::optional<std::filesystem::path>& recorded) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    serial_ = serial;
    if (lens_) return;
  }
  try {
    if (std::optional<LensFile> stored = LensStore(store_).load(storeName())) {
      set(std::move(*stored));
    } else if (recorded) {
      set(readLensFile(*recorded));
    } else {
      ROS_INFO("no calibration of this camera yet");
    }
  } catch (const std::exception& e) {
    ROS_ERROR_STREAM("starting without calibration: " << printable(e.what(), 1000));
    const std::lock_guard<std::mutex> lock(mutex_);
    problem_ = printable(e.what(), 1000);
  }
}

void CameraLens::set(LensFile file) {
  auto lens = std::make_shared<Lens>();
  lens->info = toCameraInfo(file);
  lens->file = std::move(file);
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    lens_ = std::move(lens);
    problem_.clear();
  }
  publish();
}

bool CameraLens::isOfMore() const {
  return lens_ && region_ && !region_->whole() && lens_->file.image_size == region_->sensor;
}

void CameraLens::publish() {
  try {
    std_msgs::Header header;
    header.stamp = ros::Time::now();
    header.frame_id = frame_id_;
    const std::lock_guard<std::mutex> lock(mutex_);
    if (!lens_) return;
    const LensModelMessage message = toLensModelMessage(
        isOfMore() ? partOfLens(lens_->file, region_->region, region_->binning) : lens_->file,
        header);
    if (message.yaml == published_) return;
    published_ = message.yaml;
    publisher_.publish(message);
  } catch (const Error& e) {
    ROS_ERROR_STREAM("lens_model: " << printable(e.what(), 1000));
  }
}

void CameraLens::onLens(const LensModelMessage::ConstPtr& message) {
  try {
    if (message->header.frame_id != frame_id_) return;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      if (message->yaml == published_) return;
    }
    // Published again by us, so that the latched messages of both agree.
    set(fromLensModelMessage(*message, "lens_model"));
    ROS_INFO("took over a new calibration");
  } catch (const std::exception& e) {
    ROS_WARN_STREAM_THROTTLE(10.0, "lens_model refused: " << printable(e.what(), 1000));
  }
}

bool CameraLens::setCameraInfo(sensor_msgs::SetCameraInfo::Request& request,
                               sensor_msgs::SetCameraInfo::Response& response) {
  try {
    LensFile file = fromCameraInfo(request.camera_info, "set_camera_info");
    checkSize(file.image_size);
    file.camera_name = storeName();
    const std::filesystem::path path = LensStore(store_).save(file.camera_name, file);
    set(std::move(file));
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

bool CameraLens::listLenses(ListLenses::Request&, ListLenses::Response& response) {
  try {
    for (const StoredLens& stored : LensStore(store_).versions(storeName())) {
      response.versions.push_back(stored.version);
      response.descriptions.push_back(describe(stored));
      if (stored.current) response.current = stored.version;
    }
    response.success = true;
  } catch (const std::exception& e) {
    response.message = printable(e.what(), 1000);
  }
  return true;
}

bool CameraLens::rollBack(RollBackLens::Request& request, RollBackLens::Response& response) {
  try {
    if (request.version < 0) throw InputError("roll_back_lens", "version", "is negative");
    StoredLens stored = LensStore(store_).rollBack(
        storeName(), request.version == 0 ? std::nullopt : std::optional<int>(request.version));
    response.message = describe(stored);
    response.version = stored.version;
    set(std::move(*stored.file));
    response.success = true;
    ROS_INFO_STREAM("calibration rolled back to " << response.message);
  } catch (const std::exception& e) {
    response.message = printable(e.what(), 1000);
    ROS_WARN_STREAM("roll_back_lens refused: " << response.message);
  }
  return true;
}

}  // namespace omnister
