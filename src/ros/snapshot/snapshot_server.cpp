// SPDX-License-Identifier: Apache-2.0
#include "ros/snapshot/snapshot_server.h"

#include <ros/callback_queue.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/PointCloud2.h>
#include <sensor_msgs/image_encodings.h>

#include <opencv2/core.hpp>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/stereo/cloud.h"
#include "ros/message/conversions.h"
#include "ros/message/stereo_messages.h"
#include "ros/node/parameters.h"

namespace omnister {

SnapshotServer::SnapshotServer(const ros::NodeHandle& node, const ros::NodeHandle& private_node)
    : node_(callbacks_.on(node)) {
  Parameters parameters(private_node);
  cloud_path_ = parameters.text("cloud", "cloud.ply");
  range_path_ = parameters.text("range", "range.tiff");
  timeout_ = parameters.number("timeout", timeout_, 0.1, 3600.0, "s");
  parameters.warnUnknown();
  parameters.file("cloud", cloud_path_, checkCloudPath);
  parameters.file("range", range_path_, checkRangePath);
  ros::NodeHandle service_node = callbacks_.on(private_node);
  service_ = service_node.advertiseService("save", &SnapshotServer::onSave, this);
  callbacks_.start();
}

bool SnapshotServer::onSave(std_srvs::Trigger::Request&, std_srvs::Trigger::Response& response) {
  if (busy_.exchange(true)) {
    response.message = "another call waits for a cloud already";
    response.success = false;
    return true;
  }
  try {
    response.message = save();
    response.success = true;
  } catch (const std::exception& error) {
    response.message = printable(error.what(), 500);
    response.success = false;
  }
  busy_ = false;
  return true;
}

std::string SnapshotServer::save() const {
  // A queue of its own: the service waits here while the messages come in.
  ros::CallbackQueue queue;
  ros::NodeHandle node(node_);
  node.setCallbackQueue(&queue);
  sensor_msgs::PointCloud2ConstPtr cloud_message;
  sensor_msgs::ImageConstPtr range_message;
  const ros::Subscriber points = node.subscribe<sensor_msgs::PointCloud2>(
      "points2", 2,
      [&](const sensor_msgs::PointCloud2ConstPtr& message) { cloud_message = message; });
  const ros::Subscriber ranges = node.subscribe<sensor_msgs::Image>(
      "range", 2, [&](const sensor_msgs::ImageConstPtr& message) { range_message = message; });
  const auto paired = [&] {
    return cloud_message && range_message &&
           cloud_message->header.stamp == range_message->header.stamp;
  };
  const ros::SteadyTime start = ros::SteadyTime::now();
  while (ros::ok() && !paired()) {
    queue.callOne(ros::WallDuration(0.05));
    if ((ros::SteadyTime::now() - start).toSec() > timeout_)
      throw Error("no cloud with a range image on " + points.getTopic() + " and " +
                  ranges.getTopic() + " within " + formatNumber(timeout_) + " s");
  }
  if (!paired()) throw Error("the node goes down");

  const Cloud cloud = fromPointCloud(*cloud_message);
  checkImage(*range_message);
  if (range_message->encoding != sensor_msgs::image_encodings::TYPE_32FC1)
    throw InputError(ranges.getTopic(), "encoding",
                     "is '" + printable(range_message->encoding) + "', expected 32FC1");
  const cv::Mat range(static_cast<int>(range_message->height),
                      static_cast<int>(range_message->width), CV_32FC1,
                      const_cast<std::uint8_t*>(range_message->data.data()), range_message->step);
  const auto cloud_file = stageCloud(cloud_path_, cloud);
  const auto range_file = stageRange(range_path_, range);
  cloud_file->commit();
  range_file->commit();
  // NOLINTNEXTLINE(misc-redundant-expression): what is NaN is not equal.
  const int points_seen = cv::countNonZero(range == range);
  return std::to_string(points_seen) + " points of " + std::to_string(cloud.xyz.total()) +
         " pixels";
}

}  // namespace omnister
