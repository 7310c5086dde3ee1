// SPDX-License-Identifier: Apache-2.0
#include <sensor_msgs/Image.h>

#include <boost/make_shared.hpp>

#include "fuzz.h"
#include "ros/message/conversions.h"
#include "ros/message/image_input.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  static const char* const kEncodings[] = {
      "mono8",  "mono16", "bgr8",        "rgb8",         "bgra8",       "rgba8",  "bgr16",
      "rgba16", "16UC1",  "bayer_rggb8", "bayer_gbrg16", "bayer_grbg8", "yuv422", "8UC3",
      "32FC1",  "64FC4",  "8UC999999",   "yuv422_yuy2",  "16SC2",       "8SC1",   "32SC3"};
  Bytes in(bytes);
  const auto image = boost::make_shared<sensor_msgs::Image>();
  const auto kind = in.take<std::uint8_t>();
  if (kind < std::size(kEncodings))
    image->encoding = kEncodings[kind];
  else
    image->encoding = std::string(in.text(kind % 16));
  const bool honest = in.take<std::uint8_t>() % 4 != 0;
  image->is_bigendian = in.take<std::uint8_t>();
  image->width = honest ? in.take<std::uint8_t>() : in.take<std::uint32_t>();
  image->height = honest ? in.take<std::uint8_t>() : in.take<std::uint32_t>();
  image->step = honest ? in.take<std::uint8_t>() + image->width : in.take<std::uint32_t>();
  image->header.stamp.sec = in.take<std::uint32_t>();
  image->header.stamp.nsec = in.take<std::uint32_t>();
  image->header.frame_id = std::string(in.text(in.take<std::uint8_t>() % 8));
  image->data.assign(in.rest().begin(), in.rest().end());
  if (honest) image->data.resize(std::size_t{image->step} * image->height);
  takes([&] { checkImage(*image); });
  for (const bool color : {false, true})
    takes([&] {
      const cv::Mat mat = toMat8(image, color);
      require(mat.rows == static_cast<int>(image->height), "an image keeps its height");
    });
  takes([&] {
    checkFrame(*image, {}, "input");
    const int bits = significantBits(*image);
    require(bits >= 8 && bits <= 16, "8 to 16 significant bits");
    require(toGray(*image, bits).type() == CV_8UC1, "grey is grey");
    require(toBgr(*image, bits).type() == CV_8UC3, "colour is colour");
  });
}
