// SPDX-License-Identifier: Apache-2.0
#include "omnister/common/pose.h"

#include <array>
#include <cmath>
#include <cstdio>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"

namespace omnister {

Pose parsePose(std::string_view text, std::string_view source) {
  const auto numbers = parseNumbers(text);
  if (!numbers || numbers->size() != 7) {
    throw InputError(
        source, "",
        "\"" + printable(text) + "\" is not a pose, expected 7 numbers \"tx ty tz qx qy qz qw\"");
  }
  const auto& n = *numbers;
  for (double value : n) {
    if (!std::isfinite(value)) {
      throw InputError(source, "", "\"" + printable(text) + "\" holds a number that is not finite");
    }
  }
  Eigen::Quaterniond q(n[6], n[3], n[4], n[5]);
  if (!(q.norm() > 1e-6) || !std::isfinite(q.norm())) {
    throw InputError(source, "",
                     "\"" + printable(text) + "\" has a zero quaternion, expected a rotation");
  }
  Pose pose = Pose::Identity();
  pose.linear() = q.normalized().toRotationMatrix();
  pose.translation() = Eigen::Vector3d(n[0], n[1], n[2]);
  return pose;
}

std::string formatPose(const Pose& pose) {
  const Eigen::Vector3d& t = pose.translation();
  const Eigen::Quaterniond q(pose.linear());
  std::array<char, 256> text{};
  std::snprintf(text.data(), text.size(), "%.17g %.17g %.17g %.17g %.17g %.17g %.17g", t.x(), t.y(),
                t.z(), q.x(), q.y(), q.z(), q.w());
  return text.data();
}

}  // namespace omnister
