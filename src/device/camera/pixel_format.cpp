// SPDX-License-Identifier: Apache-2.0
#include "device/camera/pixel_format.h"

#include <array>
#include <cstring>
#include <opencv2/imgproc.hpp>

namespace omnister::device {
namespace {

using P = Packing;

constexpr PixelFormat kFormats[] = {
    {0x01080001, "Mono8", "mono8", CV_8UC1, P::kPlain, 8},
    {0x01100003, "Mono10", "mono16", CV_16UC1, P::kPlain, 10},
    {0x01100005, "Mono12", "mono16", CV_16UC1, P::kPlain, 12},
    {0x01100025, "Mono14", "mono16", CV_16UC1, P::kPlain, 14},
    {0x01100007, "Mono16", "mono16", CV_16UC1, P::kPlain, 16},
    {0x010a0046, "Mono10p", "mono16", CV_16UC1, P::kLsb10, 10},
    {0x010c0047, "Mono12p", "mono16", CV_16UC1, P::kLsb12, 12},
    {0x010c0004, "Mono10Packed", "mono16", CV_16UC1, P::kGige10, 10},
    {0x010c0006, "Mono12Packed", "mono16", CV_16UC1, P::kGige12, 12},
    {0x01080008, "BayerGR8", "bayer_grbg8", CV_8UC1, P::kPlain, 8},
    {0x01080009, "BayerRG8", "bayer_rggb8", CV_8UC1, P::kPlain, 8},
    {0x0108000a, "BayerGB8", "bayer_gbrg8", CV_8UC1, P::kPlain, 8},
    {0x0108000b, "BayerBG8", "bayer_bggr8", CV_8UC1, P::kPlain, 8},
    {0x0110000c, "BayerGR10", "bayer_grbg16", CV_16UC1, P::kPlain, 10},
    {0x0110000d, "BayerRG10", "bayer_rggb16", CV_16UC1, P::kPlain, 10},
    {0x0110000e, "BayerGB10", "bayer_gbrg16", CV_16UC1, P::kPlain, 10},
    {0x0110000f, "BayerBG10", "bayer_bggr16", CV_16UC1, P::kPlain, 10},
    {0x01100010, "BayerGR12", "bayer_grbg16", CV_16UC1, P::kPlain, 12},
    {0x01100011, "BayerRG12", "bayer_rggb16", CV_16UC1, P::kPlain, 12},
    {0x01100012, "BayerGB12", "bayer_gbrg16", CV_16UC1, P::kPlain, 12},
    {0x01100013, "BayerBG12", "bayer_bggr16", CV_16UC1, P::kPlain, 12},
    {0x0110002e, "BayerGR16", "bayer_grbg16", CV_16UC1, P::kPlain, 16},
    {0x0110002f, "BayerRG16", "bayer_rggb16", CV_16UC1, P::kPlain, 16},
    {0x01100030, "BayerGB16", "bayer_gbrg16", CV_16UC1, P::kPlain, 16},
    {0x01100031, "BayerBG16", "bayer_bggr16", CV_16UC1, P::kPlain, 16},
    {0x010a0056, "BayerGR10p", "bayer_grbg16", CV_16UC1, P::kLsb10, 10},
    {0x010a0058, "BayerRG10p", "bayer_rggb16", CV_16UC1, P::kLsb10, 10},
    {0x010a0054, "BayerGB10p", "bayer_gbrg16", CV_16UC1, P::kLsb10, 10},
    {0x010a0052, "BayerBG10p", "bayer_bggr16", CV_16UC1, P::kLsb10, 10},
    {0x010c0057, "BayerGR12p", "bayer_grbg16", CV_16UC1, P::kLsb12, 12},
    {0x010c0059, "BayerRG12p", "bayer_rggb16", CV_16UC1, P::kLsb12, 12},
    {0x010c0055, "BayerGB12p", "bayer_gbrg16", CV_16UC1, P::kLsb12, 12},
    {0x010c0053, "BayerBG12p", "bayer_bggr16", CV_16UC1, P::kLsb12, 12},
    {0x010c0026, "BayerGR10Packed", "bayer_grbg16", CV_16UC1, P::kGige10, 10},
    {0x010c0027, "BayerRG10Packed", "bayer_rggb16", CV_16UC1, P::kGige10, 10},
    {0x010c0028, "BayerGB10Packed", "bayer_gbrg16", CV_16UC1, P::kGige10, 10},
    {0x010c0029, "BayerBG10Packed", "bayer_bggr16", CV_16UC1, P::kGige10, 10},
    {0x010c002a, "BayerGR12Packed", "bayer_grbg16", CV_16UC1, P::kGige12, 12},
    {0x010c002b, "BayerRG12Packed", "bayer_rggb16", CV_16UC1, P::kGige12, 12},
    {0x010c002c, "BayerGB12Packed", "bayer_gbrg16", CV_16UC1, P::kGige12, 12},
    {0x010c002d, "BayerBG12Packed", "bayer_bggr16", CV_16UC1, P::kGige12, 12},
    {0x02180014, "RGB8", "rgb8", CV_8UC3, P::kPlain, 8},
    {0x02180015, "BGR8", "bgr8", CV_8UC3, P::kPlain, 8},
    {0x02200016, "RGBa8", "rgba8", CV_8UC4, P::kPlain, 8},
    {0x02200017, "BGRa8", "bgra8", CV_8UC4, P::kPlain, 8},
    {0x02100032, "YUV422_8", "bgr8", CV_8UC3, P::kYuyv, 8},
    {0x0210001f, "YUV422_8_UYVY", "bgr8", CV_8UC3, P::kUyvy, 8},
    {0x0210003b, "YCbCr422_8", "bgr8", CV_8UC3, P::kYuyv, 8},
    {0x02100043, "YCbCr422_8_CbYCrY", "bgr8", CV_8UC3, P::kUyvy, 8},
    {0x02180020, "YUV8_UYV", "bgr8", CV_8UC3, P::kUyv, 8},
};

/// Samples of one row, in full 16-bit scale.
void unpackRow(Packing packing, int bits, const std::uint8_t* in, int count, std::uint16_t* out) {
  const int shift = 16 - bits;
  const auto store = [&](int i, unsigned value) {
    out[i] = static_cast<std::uint16_t>(value << shift);
  };
  switch (packing) {
    case P::kPlain:
      for (int i = 0; i < count; ++i) store(i, in[2 * i] | in[2 * i + 1] << 8);
      break;
    case P::kLsb10:
      for (int i = 0; i < count; ++i) {
        const std::uint8_t* b = in + i * 10 / 8;
        store(i, ((b[0] | b[1] << 8) >> (i * 10 % 8)) & 0x3ff);
      }
      break;
    case P::kLsb12:
      for (int i = 0; i < count; ++i) {
        const std::uint8_t* b = in + i * 12 / 8;
        store(i, ((b[0] | b[1] << 8) >> (i * 12 % 8)) & 0xfff);
      }
      break;
    case P::kGige10:
      for (int i = 0; i < count; ++i) {
        const std::uint8_t* b = in + i / 2 * 3;
        store(i, i % 2 == 0 ? b[0] << 2 | (b[1] & 0x3) : b[2] << 2 | (b[1] >> 4 & 0x3));
      }
      break;
    case P::kGige12:
      for (int i = 0; i < count; ++i) {
        const std::uint8_t* b = in + i / 2 * 3;
        store(i, i % 2 == 0 ? b[0] << 4 | (b[1] & 0xf) : b[2] << 4 | b[1] >> 4);
      }
      break;
    default:
      break;
  }
}

}  // namespace

const PixelFormat* findPixelFormat(std::uint32_t code) {
  for (const PixelFormat& format : kFormats) {
    if (format.code == code) return &format;
  }
  return nullptr;
}

const PixelFormat* findPixelFormat(const std::string& name) {
  for (const PixelFormat& format : kFormats) {
    if (name == format.name) return &format;
  }
  return nullptr;
}

namespace {

/// Rows of 4:2:2 with a whole last pair: where the width is odd, the colour that is missing is that
/// of the pair before.
cv::Mat wholePairs(const std::uint8_t* data, cv::Size size, std::size_t step) {
  const cv::Mat given(size, CV_8UC2, const_cast<std::uint8_t*>(data), step);
  if (size.width % 2 == 0) return given;
  cv::Mat pairs(size.height, size.width + 1, CV_8UC2, cv::Scalar(128, 128));
  given.copyTo(pairs.colRange(0, size.width));
  if (size.width > 2) given.col(size.width - 2).copyTo(pairs.col(size.width));
  return pairs;
}

}  // namespace

cv::Mat unpack(const PixelFormat& format, const std::uint8_t* data, cv::Size size,
               std::size_t step) {
  auto* bytes = const_cast<std::uint8_t*>(data);  // cv::Mat knows no constant memory
  cv::Mat out;
  if (format.direct()) {
    // Row by row: a cv::Mat takes no step that cuts a sample in two.
    out.create(size, format.type);
    for (int y = 0; y < size.height; ++y) {
      std::memcpy(out.ptr(y), data + static_cast<std::size_t>(y) * step,
                  static_cast<std::size_t>(size.width) * out.elemSize());
    }
    return out;
  }
  switch (format.packing) {
    case P::kYuyv:
    case P::kUyvy:
      cv::cvtColor(wholePairs(data, size, step), out,
                   format.packing == P::kYuyv ? cv::COLOR_YUV2BGR_YUYV : cv::COLOR_YUV2BGR_UYVY);
      return out.colRange(0, size.width);
    case P::kUyv: {
      const cv::Mat uyv(size, CV_8UC3, bytes, step);
      cv::Mat ycrcb(size, CV_8UC3);
      cv::mixChannels({uyv}, {ycrcb}, {1, 0, 2, 1, 0, 2});
      cv::cvtColor(ycrcb, out, cv::COLOR_YCrCb2BGR);
      return out;
    }
    default:
      break;
  }
  out.create(size, CV_16UC1);
  // Two bytes are read at once: the last ones from a copy with one byte more.
  const std::size_t row_bytes =
      (static_cast<std::size_t>(size.width) * static_cast<std::size_t>(format.bitsPerPixel()) + 7) /
      8;
  std::vector<std::uint8_t> row(row_bytes + 3);
  for (int y = 0; y < size.height; ++y) {
    std::memcpy(row.data(), data + static_cast<std::size_t>(y) * step, row_bytes);
    unpackRow(format.packing, format.bits, row.data(), size.width, out.ptr<std::uint16_t>(y));
  }
  return out;
}

}  // namespace omnister::device
