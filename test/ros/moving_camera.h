// SPDX-License-Identifier: Apache-2.0
/// @file A camera on a stage as stereo nodes hear it, in the rendered room.
#pragma once

#include <tf2_ros/transform_broadcaster.h>
#include <unistd.h>

#include <filesystem>
#include <string>

#include "ros/message/conversions.h"
#include "ros/rendered_views.h"
#include "ros/ros_test.h"

namespace omnister::test {

/// Its file, there as long as the tests run.
inline const std::string& lensPath() {
  struct Folder {
    std::filesystem::path path = std::filesystem::temp_directory_path() /
                                 ("omnister_stereo_test." + std::to_string(getpid()));
    std::string file = (path / "lens.yaml").string();
    Folder() {
      std::filesystem::create_directories(path);
      writeLensFile(file, lensFile());
    }
    ~Folder() { std::filesystem::remove_all(path); }
  };
  static const Folder folder;
  return folder.file;
}

/// A camera on a stage as its messages show it.
class Camera {
 public:
  explicit Camera(const std::string& name)
      : node_(name),
        base_(name + "_base"),
        optical_(name + "_optical"),
        images_(node_.advertise<sensor_msgs::Image>("image_raw", 10)) {}

  /// Rests at `x` [m] around `stamp`.
  void rest(double x, const ros::Time& stamp) {
    for (const double offset : {-0.2, -0.1, 0.0, 0.1, 0.2}) {
      transforms_.sendTransform(toTransformStamped(Pose(Eigen::Translation3d(x, 0, 0)),
                                                   stamp + ros::Duration(offset), base_, optical_));
    }
  }
  /// Is at `x` [m] at this moment.
  void pass(double x, const ros::Time& stamp) {
    transforms_.sendTransform(
        toTransformStamped(Pose(Eigen::Translation3d(x, 0, 0)), stamp, base_, optical_));
  }
  void publish(sensor_msgs::ImagePtr image, const ros::Time& stamp) {
    image->header.stamp = stamp;
    image->header.frame_id = optical_;
    images_.publish(image);
  }
  int listeners() const { return static_cast<int>(images_.getNumSubscribers()); }
  const std::string& base() const { return base_; }
  const std::string& optical() const { return optical_; }
  ros::NodeHandle& node() { return node_; }

 private:
  ros::NodeHandle node_;
  std::string base_;
  std::string optical_;
  ros::Publisher images_;
  tf2_ros::TransformBroadcaster transforms_;
};

inline ros::NodeHandle parametersFor(const Camera& camera, const std::string& name) {
  ros::NodeHandle node("~" + name);
  node.setParam("lens", lensPath());
  node.setParam("fixed_frame", camera.base());
  node.setParam("min_baseline", 0.1);
  node.setParam("max_baseline", 0.3);
  node.setParam("max_range", 20.0);
  return node;
}

/// Publishes the pair with the given stamps, when everybody is there to hear it.
inline void publishPair(Camera& camera, const ros::Time& first, const ros::Time& second) {
  ASSERT_TRUE(eventually([&] { return camera.listeners() > 0; }));
  camera.rest(0.0, first);
  camera.publish(toImage(views().left, "bgr8"), first);
  camera.rest(kBaseline, second);
  camera.publish(toImage(views().right, "bgr8"), second);
}

}  // namespace omnister::test
