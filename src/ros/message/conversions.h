// SPDX-License-Identifier: Apache-2.0
/// @file Pure conversions between messages and the types of the lower layers. Nothing here talks to
/// a master. Messages are data from a network: what does not add up is refused by InputError.
#pragma once

#include <geometry_msgs/Transform.h>
#include <geometry_msgs/TransformStamped.h>
#include <ros/time.h>
#include <sensor_msgs/CameraInfo.h>
#include <sensor_msgs/Image.h>

#include <opencv2/core/mat.hpp>
#include <string>

#include "omnister/common/pose.h"
#include "omnister/device/camera.h"
#include "omnister/lens/lens_file.h"
#include "ros/message/messages.h"

namespace omnister {

/// Outside the range of ros::Time (before 1970, after 2106) the nearest end of it.
ros::Time toRosTime(device::Stamp stamp);
/// The inverse; tests use it.
device::Stamp fromRosTime(const ros::Time& stamp);

/// Whether sums and differences with other such stamps are times and durations too: ROS throws
/// where they are not. Until 2038.
inline bool canReckonWith(const ros::Time& stamp) { return stamp.sec < (std::uint32_t{1} << 31); }

geometry_msgs::Transform toTransform(const Pose& pose);
/// `child` in `parent`: T_parent_child.
geometry_msgs::TransformStamped toTransformStamped(const Pose& pose, const ros::Time& stamp,
                                                   const std::string& parent,
                                                   const std::string& child);
/// @throws InputError for numbers that are not finite or a zero quaternion
Pose fromTransform(const geometry_msgs::Transform& transform, const std::string& source);

/// An image to be drawn into: `pixels` is its data. The header is left to the caller.
/// @throws Error for no size or an encoding that there is not
sensor_msgs::ImagePtr newImage(cv::Size size, const std::string& encoding, cv::Mat* pixels);

/// Copies the pixels. The header is left to the caller.
/// @throws Error when the encoding does not belong to the type of the pixels
sensor_msgs::ImagePtr toImage(const cv::Mat& image, const std::string& encoding);

/// Checks that width, height, step, encoding and length of the data agree, so that cv_bridge can be
/// trusted with the message. @param max_pixels larger images are refused
/// @throws InputError naming the field
void checkImage(const sensor_msgs::Image& image, std::size_t max_pixels = 100u << 20);

/// True for samples of more than one byte in the order of another machine, which cv_bridge
/// misreads.
bool foreignByteOrder(const sensor_msgs::Image& image);

/// A copy in the byte order of this machine. @param image checked, foreignByteOrder()
sensor_msgs::ImagePtr inOwnByteOrder(const sensor_msgs::Image& image);

/// A checked image as 8-bit grey or BGR: Bayer is debayered, 16 bit is scaled to 8, alpha is
/// dropped.
/// @param color CV_8UC3 (BGR) instead of CV_8UC1
/// @return a view into the message where nothing had to be changed: keep the message as long
/// @throws InputError for what cannot be converted
cv::Mat toMat8(const sensor_msgs::ImageConstPtr& image, bool color);

/// The vehicle-to-optical rotation of REP 103: x forward, y left, z up to z forward, x right, y
/// down.
Pose opticalInLink();

/// "<camera>_optical" -> "<camera>_link"; other names get "_link" behind them.
std::string linkFrame(const std::string& optical_frame);

/// An uncalibrated camera of this size: K all zeros, model empty. The header is left to the caller.
sensor_msgs::CameraInfo uncalibratedCameraInfo(int width, int height);

/// The nearest standard model where there is one, else uncalibrated. Takes some milliseconds.
sensor_msgs::CameraInfo toCameraInfo(const LensFile& file);

/// A lens surface fitted to a calibration of the standard models.
/// @throws InputError for numbers that make no camera, a model that is not standard, or a fit worse
/// than 0.5 px RMS
LensFile fromCameraInfo(const sensor_msgs::CameraInfo& info, const std::string& source);

/// @param header stamp: when the lens was loaded or fitted; frame_id: optical frame
LensModelMessage toLensModelMessage(const LensFile& file, const std_msgs::Header& header);

/// Reads the lens file that the message carries; size and model must agree with the message's own.
/// @throws InputError
LensFile fromLensModelMessage(const LensModelMessage& message, const std::string& source);

}  // namespace omnister
