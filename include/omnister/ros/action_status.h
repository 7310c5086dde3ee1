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

/// Stamps that are ahead of time become the present.
template <typename Statuses>
void keepToThePresent(Statuses& statuses, ros::Time& last_cancel) {
  const ros::Time now = ros::Time::now();
  for (auto& status : statuses)
    if (status.handle_destruction_time_ > now) status.handle_destruction_time_ = now;
  if (last_cancel > now) last_cancel = now;
}

/// What actionlib's publishStatus() publishes, with such stamps. A server's own lock is held.
template <typename Statuses>
actionlib_msgs::GoalStatusArray actionStatus(Statuses& statuses, ros::Time& last_cancel,
                                             const ros::Duration& timeout) {
  keepToThePresent(statuses, last_cancel);
  actionlib_msgs::GoalStatusArray message;
  message.header.stamp = ros::Time::now();
  for (auto status = statuses.begin(); status != statuses.end();) {
    message.status_list.push_back(status->status_);
    const ros::Time& end = status->handle_destruction_time_;
    const bool over = !end.isZero() && end + timeout < message.header.stamp;
    status = over ? statuses.erase(status) : std::next(status);
  }
  return message;
}

}  // namespace omnister::detail
