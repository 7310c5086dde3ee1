// SPDX-License-Identifier: Apache-2.0
/// @file A stage that somebody else drives: its position comes from joint states or tf, and goals
/// may go out as commands (as the position controllers of ros_control take them).
#pragma once

#include <ros/node_handle.h>
#include <sensor_msgs/JointState.h>
#include <tf2_ros/buffer.h>

#include <Eigen/Core>
#include <memory>
#include <mutex>
#include <string>

#include "omnister/device/stage.h"
#include "ros/message/transform_input.h"

namespace omnister {

/// Private parameters `external_…` of the stage node.
struct ExternalStageOptions {
  std::string topic = "/joint_states";
  std::string joint;           ///< name in it; empty: the only one
  std::string frame_id;        ///< with child_frame_id: tf is listened to instead
  std::string child_frame_id;  ///< its translation along the axis is the position
  std::string command_topic;   ///< std_msgs/Float64, target in native units; empty: no commands
  double timeout_s = 0.5;      ///< without a reading for so long the stage is lost
};

/// Listens all the time; openStage() may be called again and again.
class ExternalStageSource : public std::enable_shared_from_this<ExternalStageSource> {
 public:
  /// @param unit_m metres per native unit
  ExternalStageSource(const ros::NodeHandle& node, const ExternalStageOptions& options,
                      const Eigen::Vector3d& axis, double unit_m);

  /// @throws device::StageError while there is no reading
  std::unique_ptr<device::Stage> openStage();

  /// The newest reading. @throws device::StageError when it is too old, or there is none
  device::StageReading read();
  void command(double position_m);
  bool canCommand() const { return static_cast<bool>(command_publisher_); }
  std::string description() const;

 private:
  void onJointState(const sensor_msgs::JointState::ConstPtr& message);
  void lookUp();
  /// @param velocity NaN when not known
  void take(double position, double velocity, const ros::Time& stamp);

  ros::NodeHandle node_;
  const ExternalStageOptions options_;
  const Eigen::Vector3d axis_;
  const double unit_m_;
  std::mutex mutex_;  // guards reading_ and what belongs to it
  device::StageReading reading_;
  ros::SteadyTime received_;
  bool known_ = false;
  std::string problem_;
  std::unique_ptr<tf2_ros::Buffer> buffer_;
  std::unique_ptr<TransformInput> listener_;
  ros::Publisher command_publisher_;
  ros::Subscriber joint_subscriber_;
};

}  // namespace omnister
