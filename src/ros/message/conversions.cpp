// SPDX-License-Identifier: Apache-2.0
#include "ros/message/conversions.h"

#include <cv_bridge/cv_bridge.h>
#include <sensor_msgs/image_encodings.h>

#include <algorithm>
#include <boost/make_shared.hpp>
#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>

namespace omnister {
namespace enc = sensor_msgs::image_encodings;

ros::Time toRosTime(device::Stamp stamp) {
  const std::int64_t ns = stamp.time_since_epoch().count();
  if (ns <= 0) return ros::Time(0, 0);
  const std::int64_t seconds = ns / 1000000000;
  if (seconds > std::numeric_limits<std::uint32_t>::max()) return ros::TIME_MAX;
  return ros::Time(static_cast<std::uint32_t>(seconds),
                   static_cast<std::uint32_t>(ns % 1000000000));
}

device::Stamp fromRosTime(const ros::Time& stamp) {
  return device::Stamp(std::chrono::nanoseconds(static_cast<std::int64_t>(stamp.toNSec())));
}

geometry_msgs::Transform toTransform(const Pose& pose) {
  const Eigen::Quaterniond q(pose.rotation());
  geometry_msgs::Transform transform;
  transform.translation.x = pose.translation().x();
  transform.translation.y = pose.translation().y();
  transform.translation.z = pose.translation().z();
  transform.rotation.x = q.x();
  transform.rotation.y = q.y();
  transform.rotation.z = q.z();
  transform.rotation.w = q.w();
  return transform;
}

geometry_msgs::TransformStamped toTransformStamped(const Pose& pose, const ros::Time& stamp,
                                                   const std::string& parent,
                                                   const std::string& child) {
  geometry_msgs::TransformStamped stamped;
  stamped.header.stamp = stamp;
  stamped.header.frame_id = parent;
  stamped.child_frame_id = child;
  stamped.transform = toTransform(pose);
  return stamped;
}

Pose fromTransform(const geometry_msgs::Transform& transform, const std::string& source) {
  const Eigen::Vector3d t(transform.translation.x, transform.translation.y,
                          transform.translation.z);
  const Eigen::Quaterniond q(transform.rotation.w, transform.rotation.x, transform.rotation.y,
                             transform.rotation.z);
  if (!t.allFinite()) throw InputError(source, "translation", "is not finite");
  if (!q.coeffs().allFinite() || !(q.norm() > 1e-6)) {
    throw InputError(source, "rotation", "is zero or not finite");
  }
  Pose pose = Pose::Identity();
  pose.linear() = q.normalized().toRotationMatrix();
  pose.translation() = t;
  return pose;
}

sensor_msgs::ImagePtr newImage(cv::Size size, const std::string& encoding, cv::Mat* pixels) {
  if (size.width < 1 || size.height < 1) throw Error("an image without pixels");
  int type = 0;
  try {
    type = cv_bridge::getCvType(encoding);
  } catch (const cv_bridge::Exception&) {
    throw Error("\"" + printable(encoding) + "\" is no image encoding");
  }
  auto message = boost::make_shared<sensor_msgs::Image>();
  message->width = static_cast<std::uint32_t>(size.width);
  message->height = static_cast<std::uint32_t>(size.height);
  message->encoding = encoding;
  message->is_bigendian = 0;
  const std::size_t step = CV_ELEM_SIZE(type) * static_cast<std::size_t>(size.width);
  message->step = static_cast<std::uint32_t>(step);
  message->data.resize(step * static_cast<std::size_t>(size.height));
  *pixels = cv::Mat(size, type, message->data.data(), step);
  return message;
}

sensor_msgs::ImagePtr toImage(const cv::Mat& image, const std::string& encoding) {
  if (image.dims != 2) throw Error("an image without pixels");
  cv::Mat pixels;
  sensor_msgs::ImagePtr message = newImage(image.size(), encoding, &pixels);
  if (pixels.type() != image.type()) {
    throw Error("pixels of type " + cv::typeToString(image.type()) + " are not " +
                printable(encoding));
  }
  image.copyTo(pixels);
  return message;
}

void checkImage(const sensor_msgs::Image& image, std::size_t max_pixels) {
  const auto refuse = [](const std::string& field, const std::string& problem) {
    throw InputError("image message", field, problem);
  };
  if (image.width == 0 || image.height == 0) {
    refuse("size", "is " + std::to_string(image.width) + "x" + std::to_string(image.height) +
                       ", expected at least 1x1");
  }
  const std::uint64_t pixels = static_cast<std::uint64_t>(image.width) * image.height;
  if (pixels > max_pixels) {
    refuse("size", "is " + std::to_string(image.width) + "x" + std::to_string(image.height) +
                       ", expected at most " + std::to_string(max_pixels) + " pixels");
  }
  std::uint64_t bytes = 0;
  try {
    bytes = static_cast<std::uint64_t>(enc::numChannels(image.encoding)) *
            static_cast<std::uint64_t>(enc::bitDepth(image.encoding)) / 8;
  } catch (const std::runtime_error&) {
    refuse("encoding", "\"" + printable(image.encoding) + "\" is not known");
  }
  if (image.step < image.width * bytes) {
    refuse("step", "is " + std::to_string(image.step) + ", expected at least " +
                       std::to_string(image.width * bytes));
  }
  if (enc::bitDepth(image.encoding) == 16 && image.step % 2 != 0) {
    refuse("step", "is " + std::to_string(image.step) + ", expected whole samples of 2 bytes");
  }
  const std::uint64_t needed = static_cast<std::uint64_t>(image.step) * image.height;
  if (image.data.size() < needed) {
    refuse("data", "has " + std::to_string(image.data.size()) + " bytes, expected " +
                       std::to_string(needed));
  }
}

bool foreignByteOrder(const sensor_msgs::Image& image) {
  const std::uint16_t one = 1;
  const bool big_here = *reinterpret_cast<const std::uint8_t*>(&one) == 0;
  return enc::bitDepth(image.encoding) > 8 && (image.is_bigendian != 0) != big_here;
}

sensor_msgs::ImagePtr inOwnByteOrder(const sensor_msgs::Image& image) {
  const auto copy = boost::make_shared<sensor_msgs::Image>(image);
  const std::size_t sample = static_cast<std::size_t>(enc::bitDepth(image.encoding)) / 8;
  const std::size_t row = sample * static_cast<std::size_t>(enc::numChannels(image.encoding)) *
                          static_cast<std::size_t>(image.width);
  for (std::size_t v = 0; v < image.height; ++v) {
    std::uint8_t* begin = copy->data.data() + v * image.step;
    for (std::size_t i = 0; i + sample <= row; i += sample)
      std::reverse(begin + i, begin + i + sample);
  }
  copy->is_bigendian = image.is_bigendian == 0 ? 1 : 0;
  return copy;
}

cv::Mat toMat8(const sensor_msgs::ImageConstPtr& image, bool color) {
  checkImage(*image);
  if (foreignByteOrder(*image)) return toMat8(inOwnByteOrder(*image), color);
  const std::string target = color ? enc::BGR8 : enc::MONO8;
  try {
    const bool floating =
        image->encoding.rfind("32F", 0) == 0 || image->encoding.rfind("64F", 0) == 0;
    if (floating) {
      throw InputError(
          "image message", "encoding",
          "is " + printable(image->encoding) + ", expected 8 or 16 bit grey, colour or Bayer");
    }
    // Plain one- and three-channel types say nothing of their meaning; take them for grey and BGR.
    std::string source = image->encoding;
    if (source == enc::TYPE_8UC1) source = enc::MONO8;
    if (source == enc::TYPE_16UC1) source = enc::MONO16;
    if (source == enc::TYPE_8UC3) source = enc::BGR8;
    if (source == enc::TYPE_16UC3) source = enc::BGR16;
    if (source == image->encoding) {
      return cv_bridge::toCvShare(image, target)->image;
    }
    const int depth = enc::bitDepth(source) == 16 ? CV_16U : CV_8U;
    const cv::Mat view(static_cast<int>(image->height), static_cast<int>(image->width),
                       CV_MAKETYPE(depth, enc::numChannels(source)),
                       const_cast<std::uint8_t*>(image->data.data()), image->step);
    return cv_bridge::cvtColor(boost::make_shared<cv_bridge::CvImage>(image->header, source, view),
                               target)
        ->image;
  } catch (const cv_bridge::Exception& e) {
    throw InputError("image message", "encoding",
                     printable(image->encoding) + " cannot be taken as " + target);
  } catch (const cv::Exception& e) {
    throw InputError("image message", "data", "cannot be converted: " + printable(e.err));
  }
}

Pose opticalInLink() {
  Pose pose = Pose::Identity();
  // Columns: the optical frame's x (right), y (down), z (forward) in the link's x forward, y left,
  // z up.
  pose.linear() << 0, 0, 1,  //
      -1, 0, 0,              //
      0, -1, 0;
  return pose;
}

std::string linkFrame(const std::string& optical_frame) {
  for (const std::string suffix : {"_optical_frame", "_optical"}) {
    if (optical_frame.size() > suffix.size() &&
        optical_frame.compare(optical_frame.size() - suffix.size(), suffix.size(), suffix) == 0) {
      return optical_frame.substr(0, optical_frame.size() - suffix.size()) + "_link";
    }
  }
  return optical_frame + "_link";
}

sensor_msgs::CameraInfo uncalibratedCameraInfo(int width, int height) {
  sensor_msgs::CameraInfo info;
  info.width = static_cast<std::uint32_t>(width);
  info.height = static_cast<std::uint32_t>(height);
  return info;
}

}  // namespace omnister
