// SPDX-License-Identifier: Apache-2.0
/// @file Bags of a camera on a stage in a rendered room.
#pragma once

#include <rosbag/bag.h>
#include <tf2_msgs/TFMessage.h>

#include <filesystem>

#include "ros/message/conversions.h"
#include "ros/rendered_views.h"

namespace omnister::test {

const ros::Time kBegin(1000.0);

/// A stage that goes to and fro, resting at each end, with an image a second.
class Recording {
 public:
  explicit Recording(const std::filesystem::path& path, ros::Time begin = kBegin)
      : begin_(begin), bag_(path.string(), rosbag::bagmode::Write) {}

  void lens(const LensFile& file) {
    std_msgs::Header header;
    header.stamp = begin_;
    header.frame_id = "camera_optical";
    bag_.write("/camera/lens_model", begin_, toLensModelMessage(file, header));
  }
  /// Rests at `x` [m] and takes the image belonging there.
  void frame(int number, double x, const cv::Mat& image) {
    const ros::Time stamp = begin_ + ros::Duration(number + 1.0);
    for (const double offset : {-0.2, -0.1, 0.0, 0.1, 0.2}) {
      tf2_msgs::TFMessage transforms;
      const ros::Time time = stamp + ros::Duration(offset);
      transforms.transforms = {toTransformStamped(Pose(Eigen::Translation3d(x, 0, 0)), time,
                                                  "stage_base", "camera_optical")};
      bag_.write("/tf", time, transforms);
    }
    const sensor_msgs::ImagePtr message = toImage(image, "bgr8");
    message->header.stamp = stamp;
    message->header.frame_id = "camera_optical";
    bag_.write("/camera/image_raw", stamp, message);
  }
  rosbag::Bag& bag() { return bag_; }

 private:
  const ros::Time begin_;
  rosbag::Bag bag_;
};

/// Frames at the two rendered places in turn.
inline void recordRoom(const std::filesystem::path& path, int frames, ros::Time begin = kBegin) {
  Recording recording(path, begin);
  recording.lens(views().lens);
  for (int i = 0; i < frames; ++i)
    recording.frame(i, i % 2 == 0 ? 0.0 : kBaseline, i % 2 == 0 ? views().left : views().right);
}

}  // namespace omnister::test
