// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/range_warp.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "stereo/sweep/grid/geometry.h"
#include "stereo/sweep/refine/joint_refinement.h"

namespace omnister {

cv::Mat warpRange(const cv::Mat& range, const LensPtr& lens, const Pose& T_new_old,
                  const LensPtr& new_lens, cv::Size new_size, int threads) {
  if (!lens || !new_lens || range.type() != CV_32FC1 || range.empty())
    throw Error("a range image is warped between lenses, and is one channel of 32-bit floats");
  constexpr float kNone = std::numeric_limits<float>::infinity();
  const PointMaker rays(*lens, range.size(), threads);
  const ProjectionTable table(sweep::widen(new_lens), new_size, threads);
  const Eigen::Matrix3f R = T_new_old.linear().cast<float>();
  const Eigen::Vector3f t = T_new_old.translation().cast<float>();
  struct Place {
    int at;
    float range;
  };
  std::vector<std::vector<Place>> places(range.rows);
  parallelFor(0, static_cast<std::size_t>(range.rows), threads, [&](std::size_t row) {
    const int y = static_cast<int>(row);
    std::vector<cv::Vec3f> nodes, of_row(range.cols);
    rays.row(y, nodes, of_row.data());
    std::vector<float> x(range.cols), y_of(range.cols), z(range.cols);
    const float* from = range.ptr<float>(y);
    for (int i = 0; i < range.cols; ++i) {
      const bool known = from[i] > 0.0f && from[i] < kNone;
      const Eigen::Vector3f ray(of_row[i][0], of_row[i][1], of_row[i][2]);
      const Eigen::Vector3f point = R * (known ? from[i] : kNone) * ray + t;
      x[i] = point.x();
      y_of[i] = point.y();
      z[i] = point.z();
    }
    std::vector<float> column(range.cols), line(range.cols);
    table.project(x.data(), y_of.data(), z.data(), range.cols, column.data(), line.data());
    for (int i = 0; i < range.cols; ++i) {
      const float distance = std::sqrt(x[i] * x[i] + y_of[i] * y_of[i] + z[i] * z[i]);
      const float pixel_x = std::round(column[i]), pixel_y = std::round(line[i]);
      // NaN fails.
      if (!(distance < kNone && pixel_x >= 0 && pixel_y >= 0 &&
            pixel_x < static_cast<float>(new_size.width) &&
            pixel_y < static_cast<float>(new_size.height)))
        continue;
      places[row].push_back(
          {static_cast<int>(pixel_y) * new_size.width + static_cast<int>(pixel_x), distance});
    }
  });
  cv::Mat nearest(new_size, CV_32FC1, cv::Scalar(kNone));
  for (const auto& of_row : places) {
    for (const Place& place : of_row) {
      float& old = nearest.at<float>(place.at / new_size.width, place.at % new_size.width);
      old = std::min(old, place.range);
    }
  }
  cv::Mat out(new_size, CV_32FC1);
  parallelFor(0, static_cast<std::size_t>(new_size.height), threads, [&](std::size_t row) {
    const int y = static_cast<int>(row);
    for (int x = 0; x < new_size.width; ++x) {
      const float own = nearest.at<float>(y, x);
      float& to = out.at<float>(y, x);
      to = own < kNone ? own : std::numeric_limits<float>::quiet_NaN();
      if (own < kNone || x == 0 || y == 0 || x + 1 == new_size.width || y + 1 == new_size.height)
        continue;
      // Between two neighbours on one surface.
      const auto between = [&](float a, float b) {
        if (a < kNone && b < kNone && std::fabs(a - b) < 0.05f * (a + b)) to = 0.5f * (a + b);
      };
      between(nearest.at<float>(y - 1, x), nearest.at<float>(y + 1, x));
      if (std::isnan(to)) between(nearest.at<float>(y, x - 1), nearest.at<float>(y, x + 1));
    }
  });
  return out;
}

}  // namespace omnister
