// SPDX-License-Identifier: Apache-2.0
#include "device/camera/v4l2/v4l2_format.h"

#include <linux/videodev2.h>

#include <cstring>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

namespace omnister::device {
namespace {

using Coding = V4l2Coding;

constexpr V4l2Format kFormats[] = {
    {V4L2_PIX_FMT_GREY, "mono8", CV_8UC1, Coding::kPlain},
    {V4L2_PIX_FMT_Y16, "mono16", CV_16UC1, Coding::kPlain},
    {V4L2_PIX_FMT_SRGGB8, "bayer_rggb8", CV_8UC1, Coding::kPlain},
    {V4L2_PIX_FMT_SGRBG8, "bayer_grbg8", CV_8UC1, Coding::kPlain},
    {V4L2_PIX_FMT_SGBRG8, "bayer_gbrg8", CV_8UC1, Coding::kPlain},
    {V4L2_PIX_FMT_SBGGR8, "bayer_bggr8", CV_8UC1, Coding::kPlain},
    {V4L2_PIX_FMT_SRGGB16, "bayer_rggb16", CV_16UC1, Coding::kPlain},
    {V4L2_PIX_FMT_SGRBG16, "bayer_grbg16", CV_16UC1, Coding::kPlain},
    {V4L2_PIX_FMT_SGBRG16, "bayer_gbrg16", CV_16UC1, Coding::kPlain},
    {V4L2_PIX_FMT_SBGGR16, "bayer_bggr16", CV_16UC1, Coding::kPlain},
    {V4L2_PIX_FMT_BGR24, "bgr8", CV_8UC3, Coding::kPlain},
    {V4L2_PIX_FMT_RGB24, "rgb8", CV_8UC3, Coding::kPlain},
    {V4L2_PIX_FMT_YUYV, "bgr8", CV_8UC3, Coding::kYuyv},
    {V4L2_PIX_FMT_UYVY, "bgr8", CV_8UC3, Coding::kUyvy},
    {V4L2_PIX_FMT_NV12, "bgr8", CV_8UC3, Coding::kNv12},
    {V4L2_PIX_FMT_MJPEG, "bgr8", CV_8UC3, Coding::kJpeg},
    {V4L2_PIX_FMT_JPEG, "bgr8", CV_8UC3, Coding::kJpeg},
};

/// Decoders fill up what is missing of a broken picture; a whole one ends with its marker, behind
/// which drivers may leave zeros.
bool endsAsJpeg(const std::uint8_t* data, std::size_t bytes) {
  while (bytes > 2 && data[bytes - 1] == 0) --bytes;
  return bytes > 2 && data[bytes - 2] == 0xff && data[bytes - 1] == 0xd9;
}

}  // namespace

const V4l2Format* findV4l2Format(std::uint32_t fourcc) {
  for (const V4l2Format& format : kFormats) {
    if (format.fourcc == fourcc) return &format;
  }
  return nullptr;
}

bool decodeV4l2(const V4l2Format& format, const std::uint8_t* data, std::size_t bytes,
                const cv::Size& size, std::size_t step, FramePool* pool, Frame* frame) {
  auto* pixels = const_cast<std::uint8_t*>(data);  // cv::Mat knows no constant memory
  const auto rows = static_cast<std::size_t>(size.height);
  if (format.coding == Coding::kJpeg) {
    if (!endsAsJpeg(data, bytes)) return false;
    try {
      frame->image = cv::imdecode(cv::Mat(1, static_cast<int>(bytes), CV_8UC1, pixels),
                                  cv::IMREAD_COLOR | cv::IMREAD_IGNORE_ORIENTATION);
    } catch (const cv::Exception&) {
      return false;
    }
    return frame->image.size() == size;
  }
  if (bytes < step * rows * (format.coding == Coding::kNv12 ? 3 : 2) / 2) return false;
  switch (format.coding) {
    case Coding::kYuyv:
      cv::cvtColor(cv::Mat(size, CV_8UC2, pixels, step), frame->image, cv::COLOR_YUV2BGR_YUYV);
      break;
    case Coding::kUyvy:
      cv::cvtColor(cv::Mat(size, CV_8UC2, pixels, step), frame->image, cv::COLOR_YUV2BGR_UYVY);
      break;
    case Coding::kNv12:
      cv::cvtColor(cv::Mat(size.height * 3 / 2, size.width, CV_8UC1, pixels, step), frame->image,
                   cv::COLOR_YUV2BGR_NV12);
      break;
    default:
      frame->memory = pool->take(step * rows);
      std::memcpy(frame->memory->bytes.data(), data, step * rows);
      frame->image = cv::Mat(size, format.type, frame->memory->bytes.data(), step);
      break;
  }
  return true;
}

}  // namespace omnister::device
