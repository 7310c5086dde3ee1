// SPDX-License-Identifier: Apache-2.0
/// @file actionlib takes the stamps of goals and cancels as they come, and reckons with them: one
/// from the end of time ends the process, or cancels every goal there will ever be. Each action
/// that is served has a publishStatus() of its own therefore, called with every change and several
/// times a second.
#pragma once

#include <actionlib_msgs/GoalStatusArray.h>
#include <ros/time.h>

#include <iterator>

namespace omnister::detail {

/// What actionlib's publishStatus() publishes; stamps that are ahead of time become the present. A
/// server's own lock is held.
template <typename Statuses>
actionlib_msgs::GoalStatusArray actionStatus(Statuses& statuses, ros::Time& last_cancel,
                                             const ros::Duration& timeout) {
  const ros::Time now = ros::Time::now();
  if (last_cancel > now) last_cancel = now;
  actionlib_msgs::GoalStatusArray message;
  message.header.stamp = now;
  for (auto status = statuses.begin(); status != statuses.end();) {
    message.status_list.push_back(status->status_);
    ros::Time& end = status->handle_destruction_time_;
    if (end > now) end = now;
    const bool over = !end.isZero() && end + timeout < now;
    status = over ? statuses.erase(status) : std::next(status);
  }
  return message;
}

}  // namespace omnister::detail
