// SPDX-License-Identifier: Apache-2.0
#include <sensor_msgs/PointCloud2.h>

#include "fuzz.h"
#include "ros/message/stereo_messages.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  Bytes in(bytes);
  const auto flaws = in.take<std::uint32_t>();
  int bit = 0;
  const auto flawed = [&] { return (flaws >> (bit++ % 32) & 1) != 0; };
  Cloud cloud{
      cv::Mat(3, 5, CV_32FC3, cv::Scalar::all(1)), cv::Mat(3, 5, CV_8UC3, cv::Scalar::all(9)),
      cv::Mat(3, 5, CV_32FC1, cv::Scalar::all(1)), cv::Mat(3, 5, CV_32FC1, cv::Scalar::all(1))};
  sensor_msgs::PointCloud2 message = *toPointCloud(cloud, {});
  if (flawed()) message.width = in.take<std::uint32_t>();
  if (flawed()) message.height = in.take<std::uint32_t>();
  if (flawed()) message.point_step = in.take<std::uint32_t>();
  if (flawed()) message.row_step = in.take<std::uint32_t>();
  if (flawed()) message.is_bigendian = in.take<std::uint8_t>();
  if (flawed()) message.fields.resize(in.take<std::uint8_t>() % 9);
  for (sensor_msgs::PointField& field : message.fields) {
    if (flawed()) field.offset = in.take<std::uint32_t>();
    if (flawed()) field.datatype = in.take<std::uint8_t>();
    if (flawed()) field.count = in.take<std::uint32_t>();
    if (flawed()) field.name = std::string(in.text(in.take<std::uint8_t>() % 6));
  }
  if (flawed()) message.data.resize(in.take<std::uint16_t>());
  for (std::size_t i = 0; i < message.data.size() && !in.empty(); ++i)
    message.data[i] = in.take<std::uint8_t>();
  takes([&] {
    const Cloud back = fromPointCloud(message);
    require(back.xyz.rows == static_cast<int>(message.height), "a cloud keeps its grid");
  });
}
