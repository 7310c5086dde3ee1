// SPDX-License-Identifier: Apache-2.0
#include <sensor_msgs/CameraInfo.h>

#include "fuzz.h"
#include "ros/message/camera_info_reading.h"
#include "ros/message/conversions.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  static const char* const kModels[] = {"plumb_bob", "rational_polynomial", "equidistant",
                                        "fisheye", ""};
  Bytes in(bytes);
  sensor_msgs::CameraInfo info;
  info.distortion_model = kModels[in.take<std::uint8_t>() % std::size(kModels)];
  info.width = in.take<std::uint16_t>();
  info.height = in.take<std::uint16_t>();
  info.D.resize(in.take<std::uint8_t>() % 16);
  info.binning_x = in.take<std::uint8_t>();
  const bool raw = in.take<std::uint8_t>() % 2 != 0;
  const auto number = [&](double scale) {
    return raw ? in.take<double>() : scale * in.take<std::int16_t>() / 32768.0;
  };
  info.K = {number(1000), 0, number(1000), 0, number(1000), number(1000), 0, 0, 1};
  for (double& value : info.D) value = number(1.0);
  const bool taken = takes(
      [&] { require(readCameraInfo(info, "input").image_size.width > 0, "an image has a size"); });
  if (!taken || !timeForMore(bytes, 4096)) return;
  // The fit takes most of a second.
  takes([&] { fromCameraInfo(info, "input"); });
}
