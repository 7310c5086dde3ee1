// SPDX-License-Identifier: Apache-2.0
/// @file Stereo results as messages.
#pragma once

#include <sensor_msgs/Image.h>
#include <sensor_msgs/PointCloud2.h>

#include "omnister/stereo/cloud.h"

namespace omnister {

/// Organized cloud on the reference image's grid: x y z [m], rgb (packed as PCL and rviz read it),
/// sigma [m], score (0 to 1), range along the ray [m], all float32; NaN where invalid (REP 117).
/// is_dense is false. Nodes use fillPointCloud(), which tests compare with this.
sensor_msgs::PointCloud2Ptr toPointCloud(const Cloud& cloud, const std_msgs::Header& header);

/// The same right from a match, without a cloud between: for a node that is in a hurry.
/// @param rays of the reference lens, as viewingRays() makes them
/// @param image the reference image, CV_8UC1 or CV_8UC3
/// @param message to be filled; may be one that was filled before
/// @throws Error for images of different size
void fillPointCloud(const MatchResult& match, const cv::Mat& rays, const cv::Mat& image,
                    const std_msgs::Header& header, int threads, sensor_msgs::PointCloud2* message);

/// The inverse of toPointCloud(), for clouds of that layout.
/// @throws InputError naming the field that is missing or does not agree with the data
Cloud fromPointCloud(const sensor_msgs::PointCloud2& message);

/// 32FC1 [m]: distance along z (REP 118), NaN for rays at or past 90 degrees and where invalid.
/// @param range along the rays [m]
sensor_msgs::ImagePtr toDepth(const cv::Mat& range, const cv::Mat& rays,
                              const std_msgs::Header& header);

/// 32FC1 [m]: distance along the ray, NaN where invalid.
sensor_msgs::ImagePtr toRange(const cv::Mat& range, const std_msgs::Header& header);

}  // namespace omnister
