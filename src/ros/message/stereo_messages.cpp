// SPDX-License-Identifier: Apache-2.0
#include "ros/message/stereo_messages.h"

#include <sensor_msgs/image_encodings.h>

#include <array>
#ifdef __SSE2__
#include <emmintrin.h>
#endif

#include <algorithm>
#include <boost/make_shared.hpp>
#include <cstdint>
#include <cstring>
#include <limits>
#include <string>

#include "omnister/common/error.h"
#include "omnister/common/parallel.h"

namespace omnister {
namespace {

/// One point of the cloud as it lies in PointCloud2::data.
struct Point {
  float x, y, z;
  std::uint32_t rgb;  ///< 0x00RRGGBB; the field is declared float32, as PCL has it
  float sigma, score;
  float range;  ///< length of (x, y, z), for who colours or filters by it
};
constexpr std::array<const char*, 7> kFields = {"x", "y", "z", "rgb", "sigma", "score", "range"};
static_assert(sizeof(Point) == kFields.size() * sizeof(float), "the layout is that of kFields");

constexpr std::uint8_t kBigEndian =
#if __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
    1;
#else
    0;
#endif

sensor_msgs::ImagePtr floatImage(cv::Size size, const std_msgs::Header& header) {
  auto message = boost::make_shared<sensor_msgs::Image>();
  message->header = header;
  message->width = static_cast<std::uint32_t>(size.width);
  message->height = static_cast<std::uint32_t>(size.height);
  message->encoding = sensor_msgs::image_encodings::TYPE_32FC1;
  message->is_bigendian = kBigEndian;
  message->step = message->width * sizeof(float);
  message->data.resize(static_cast<std::size_t>(message->step) * message->height);
  return message;
}

/// Everything but the points, of which there is room.
void layOut(cv::Size size, const std_msgs::Header& header, sensor_msgs::PointCloud2* message) {
  message->header = header;
  message->width = static_cast<std::uint32_t>(size.width);
  message->height = static_cast<std::uint32_t>(size.height);
  message->fields.clear();
  std::uint32_t offset = 0;
  for (const char* name : kFields) {
    sensor_msgs::PointField field;
    field.name = name;
    field.offset = offset;
    field.datatype = sensor_msgs::PointField::FLOAT32;
    field.count = 1;
    message->fields.push_back(field);
    offset += sizeof(float);
  }
  message->is_bigendian = kBigEndian;
  message->is_dense = false;
  message->point_step = sizeof(Point);
  message->row_step = message->point_step * message->width;
  message->data.resize(static_cast<std::size_t>(message->row_step) * message->height);
}

/// Copies past the caches, where the processor can: a cloud is larger than they are, and to read
/// what is overwritten takes as long as to write it.
void copyPastCaches(const std::uint8_t* from, std::size_t bytes, std::uint8_t* to) {
#ifdef __SSE2__
  const std::size_t ahead =
      std::min<std::size_t>((16 - reinterpret_cast<std::uintptr_t>(to) % 16) % 16, bytes);
  std::memcpy(to, from, ahead);
  std::size_t i = ahead;
  for (; i + 16 <= bytes; i += 16) {
    const __m128i word = _mm_loadu_si128(reinterpret_cast<const __m128i*>(from + i));
    _mm_stream_si128(reinterpret_cast<__m128i*>(to + i), word);
  }
  std::memcpy(to + i, from + i, bytes - i);
#else
  std::memcpy(to, from, bytes);
#endif
}

/// What was copied past the caches is there before anything that is written from now on.
void finishCopies() {
#ifdef __SSE2__
  _mm_sfence();
#endif
}

std::uint32_t packed(const cv::Vec3b& bgr) {
  return static_cast<std::uint32_t>(bgr[2]) << 16 | static_cast<std::uint32_t>(bgr[1]) << 8 |
         bgr[0];
}

}  // namespace

sensor_msgs::PointCloud2Ptr toPointCloud(const Cloud& cloud, const std_msgs::Header& header) {
  auto message = boost::make_shared<sensor_msgs::PointCloud2>();
  layOut(cloud.xyz.size(), header, message.get());
  std::uint8_t* out = message->data.data();
  for (int v = 0; v < cloud.xyz.rows; ++v) {
    const auto* xyz = cloud.xyz.ptr<cv::Vec3f>(v);
    const auto* bgr = cloud.bgr.ptr<cv::Vec3b>(v);
    const auto* sigma = cloud.sigma.ptr<float>(v);
    const auto* score = cloud.score.ptr<float>(v);
    for (int u = 0; u < cloud.xyz.cols; ++u, out += sizeof(Point)) {
      const auto range = static_cast<float>(cv::norm(xyz[u]));
      const Point point{xyz[u][0], xyz[u][1], xyz[u][2], packed(bgr[u]), sigma[u], score[u], range};
      std::memcpy(out, &point, sizeof point);
    }
  }
  return message;
}

void fillPointCloud(const MatchResult& match, const cv::Mat& rays, const cv::Mat& image,
                    const std_msgs::Header& header, int threads,
                    sensor_msgs::PointCloud2* message) {
  const cv::Size size = match.range.size();
  if (rays.size() != size || rays.type() != CV_32FC3 || image.size() != size ||
      (image.type() != CV_8UC1 && image.type() != CV_8UC3))
    throw Error("range, rays and image of a cloud differ in size");
  layOut(size, header, message);
  constexpr std::size_t kRows = 16;
  parallelFor(
      0, static_cast<std::size_t>(size.height), threads,
      [&](std::size_t row) {
        const int v = static_cast<int>(row);
        const auto* range = match.range.ptr<float>(v);
        const auto* sigma = match.sigma.ptr<float>(v);
        const auto* score = match.score.ptr<float>(v);
        const auto* ray = rays.ptr<cv::Vec3f>(v);
        std::uint8_t* out = message->data.data() + row * message->row_step;
        const auto fill = [&](const auto* grey_or_color, const auto& rgb) {
          constexpr int kBlock = 64;
          alignas(64) Point block[kBlock];
          for (int first = 0; first < size.width; first += kBlock) {
            const int count = std::min(kBlock, size.width - first);
            for (int i = 0; i < count; ++i) {
              const int u = first + i;
              // Without a range all of them are NaN.
              const float r = range[u];
              block[i] = {r * ray[u][0],
                          r * ray[u][1],
                          r * ray[u][2],
                          rgb(grey_or_color[u]),
                          sigma[u],
                          score[u],
                          r};
            }
            copyPastCaches(reinterpret_cast<const std::uint8_t*>(block), count * sizeof(Point),
                           out + first * sizeof(Point));
          }
          finishCopies();
        };
        if (image.type() == CV_8UC1)
          fill(image.ptr<std::uint8_t>(v), [](std::uint8_t grey) { return grey * 0x010101u; });
        else
          fill(image.ptr<cv::Vec3b>(v), packed);
      },
      kRows);
}

Cloud fromPointCloud(const sensor_msgs::PointCloud2& message) {
  const auto refuse = [](const std::string& field, const std::string& problem) {
    throw InputError("cloud message", field, problem);
  };
  constexpr std::uint64_t kMostPoints = 100u << 20;
  const std::uint64_t points = static_cast<std::uint64_t>(message.width) * message.height;
  if (points == 0 || points > kMostPoints)
    refuse("size", "is " + std::to_string(message.width) + "x" + std::to_string(message.height));
  if (message.is_bigendian != kBigEndian) refuse("is_bigendian", "is not this machine's");
  if (message.point_step != sizeof(Point) ||
      message.row_step != static_cast<std::uint64_t>(message.point_step) * message.width ||
      message.data.size() != points * sizeof(Point))
    refuse("data", "does not agree with width, height and a step of 28 bytes a point");
  const std::string expected = "are not x y z rgb sigma score range of float32";
  if (message.fields.size() != kFields.size()) refuse("fields", expected);
  for (std::size_t i = 0; i < kFields.size(); ++i) {
    const sensor_msgs::PointField& field = message.fields[i];
    if (field.name != kFields[i] || field.offset != i * sizeof(float) ||
        field.datatype != sensor_msgs::PointField::FLOAT32 || field.count != 1)
      refuse("fields", expected);
  }
  const cv::Size size(static_cast<int>(message.width), static_cast<int>(message.height));
  Cloud cloud{cv::Mat(size, CV_32FC3), cv::Mat(size, CV_8UC3), cv::Mat(size, CV_32FC1),
              cv::Mat(size, CV_32FC1)};
  const std::uint8_t* in = message.data.data();
  for (int v = 0; v < size.height; ++v) {
    for (int u = 0; u < size.width; ++u, in += sizeof(Point)) {
      Point point{};
      std::memcpy(&point, in, sizeof point);
      cloud.xyz.at<cv::Vec3f>(v, u) = {point.x, point.y, point.z};
      cloud.bgr.at<cv::Vec3b>(v, u) = {static_cast<std::uint8_t>(point.rgb),
                                       static_cast<std::uint8_t>(point.rgb >> 8),
                                       static_cast<std::uint8_t>(point.rgb >> 16)};
      cloud.sigma.at<float>(v, u) = point.sigma;
      cloud.score.at<float>(v, u) = point.score;
    }
  }
  return cloud;
}

sensor_msgs::ImagePtr toDepth(const cv::Mat& range, const cv::Mat& rays,
                              const std_msgs::Header& header) {
  const sensor_msgs::ImagePtr message = floatImage(range.size(), header);
  cv::Mat depth(range.size(), CV_32FC1, message->data.data(), message->step);
  for (int v = 0; v < depth.rows; ++v) {
    const auto* along = range.ptr<float>(v);
    const auto* ray = rays.ptr<cv::Vec3f>(v);
    auto* row = depth.ptr<float>(v);
    for (int u = 0; u < depth.cols; ++u) {
      const float z = along[u] * ray[u][2];
      row[u] = z > 0.0F ? z : std::numeric_limits<float>::quiet_NaN();
    }
  }
  return message;
}

sensor_msgs::ImagePtr toRange(const cv::Mat& range, const std_msgs::Header& header) {
  const sensor_msgs::ImagePtr message = floatImage(range.size(), header);
  range.copyTo(cv::Mat(range.size(), CV_32FC1, message->data.data(), message->step));
  return message;
}

}  // namespace omnister
