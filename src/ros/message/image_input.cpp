// SPDX-License-Identifier: Apache-2.0
#include "ros/message/image_input.h"

#include <cv_bridge/cv_bridge.h>
#include <sensor_msgs/image_encodings.h>

#include <boost/make_shared.hpp>
#include <opencv2/core.hpp>
#include <utility>

#include "omnister/common/error.h"
#include "ros/message/conversions.h"
#include "ros/node/parameters.h"

namespace omnister {
namespace {

namespace enc = sensor_msgs::image_encodings;

/// The encoding of the same picture with 8 bits a sample; nameless ones are taken as grey or BGR.
std::string eightBit(const std::string& encoding) {
  if (encoding == enc::TYPE_8UC1 || encoding == enc::TYPE_16UC1 || encoding == enc::MONO16)
    return enc::MONO8;
  if (encoding == enc::TYPE_8UC3 || encoding == enc::TYPE_16UC3) return enc::BGR8;
  if (encoding == enc::TYPE_8UC4 || encoding == enc::TYPE_16UC4) return enc::BGRA8;
  if (encoding.size() > 2 && encoding.compare(encoding.size() - 2, 2, "16") == 0)
    return encoding.substr(0, encoding.size() - 2) + "8";
  return encoding;
}

InputError badEncoding(const std::exception& error) {
  return InputError("image", "encoding", printable(error.what()));
}

/// The message's own pixels, as they are.
cv::Mat nativePixels(const sensor_msgs::Image& image) {
  try {
    return cv_bridge::toCvShare(image, {})->image;
  } catch (const cv_bridge::Exception& error) {
    throw badEncoding(error);
  } catch (const cv::Exception& error) {
    throw badEncoding(error);
  }
}

cv::Mat convert(const sensor_msgs::Image& image, int bits, const std::string& wanted) {
  if (foreignByteOrder(image)) return convert(*inOwnByteOrder(image), bits, wanted);
  try {
    const cv::Mat native = nativePixels(image);
    cv_bridge::CvImage eight(image.header, eightBit(image.encoding));
    switch (native.depth()) {
      case CV_8U:
        eight.image = native;
        break;
      case CV_16U:
        native.convertTo(eight.image, CV_8U, 1.0 / (1 << (bits - 8)));
        break;
      default:
        throw InputError(
            "image", "encoding",
            "is '" + printable(image.encoding) + "', expected 8 or 16 bit grey, colour or Bayer");
    }
    if (eight.encoding == wanted) return eight.image.clone();
    return cv_bridge::cvtColor(boost::make_shared<cv_bridge::CvImage>(eight), wanted)->image;
  } catch (const cv_bridge::Exception& error) {
    throw badEncoding(error);
  } catch (const cv::Exception& error) {
    throw badEncoding(error);
  }
}

}  // namespace

std::uint32_t MissingMessages::before(const std_msgs::Header& header) {
  constexpr int kLate = 4;  // what publishers of images keep in their queues
  older_ = header.stamp < stamp_ ? older_ + 1 : 0;
  if (older_ > kLate) reset();
  if (older_ > 0) return 0;
  stamp_ = header.stamp;
  const std::uint32_t last = std::exchange(last_, header.seq);
  return last != 0 && header.seq > last ? header.seq - last - 1 : 0;
}

void checkFrame(const sensor_msgs::Image& image, cv::Size expected, const std::string& topic) {
  const auto refuse = [&](const char* place, const std::string& problem) {
    throw InputError(topic, place, problem);
  };
  checkImage(image);
  if (image.header.stamp.isZero()) refuse("header.stamp", "is 0, expected the time of exposure");
  if (image.header.frame_id.empty())
    refuse("header.frame_id", "is empty, expected the optical frame");
  if (image.header.frame_id.size() > kLongestFrame)
    refuse("header.frame_id", "is longer than " + std::to_string(kLongestFrame) + " characters");
  if (expected.area() > 0 && (static_cast<int>(image.width) != expected.width ||
                              static_cast<int>(image.height) != expected.height))
    refuse("size", "is " + std::to_string(image.width) + "x" + std::to_string(image.height) +
                       ", expected the lens' " + std::to_string(expected.width) + "x" +
                       std::to_string(expected.height));
  const int depth = enc::bitDepth(image.encoding);
  const int channels = enc::numChannels(image.encoding);
  if ((depth != 8 && depth != 16) || channels < 1 || channels > 4 ||
      image.encoding.find("SC") != std::string::npos)
    refuse("encoding",
           "is '" + printable(image.encoding) + "', expected 8 or 16 bit grey, colour or Bayer");
  if (image.data.size() != static_cast<std::size_t>(image.step) * image.height)
    refuse("data", "has " + std::to_string(image.data.size()) + " bytes, expected step x height, " +
                       std::to_string(static_cast<std::size_t>(image.step) * image.height));
}

int significantBits(const sensor_msgs::Image& image) {
  if (enc::bitDepth(image.encoding) != 16) return 8;
  if (foreignByteOrder(image)) return significantBits(*inOwnByteOrder(image));
  const cv::Mat native = nativePixels(image);
  if (native.depth() != CV_16U) return 8;
  double brightest = 0.0;
  cv::minMaxLoc(native.reshape(1), nullptr, &brightest);
  int bits = 8;
  while (bits < 16 && brightest >= (1 << bits)) ++bits;
  return bits;
}

cv::Mat toGray(const sensor_msgs::Image& image, int bits) {
  return convert(image, bits, enc::MONO8);
}

cv::Mat toBgr(const sensor_msgs::Image& image, int bits) { return convert(image, bits, enc::BGR8); }

}  // namespace omnister
