// SPDX-License-Identifier: Apache-2.0
// Every layout of bytes that cameras send, packed here bit by bit after the words of PFNC 2.1 and
// the GigE Vision standard, beside what the driver makes of it.
#include "device/camera/pixel_format.h"

#include <gmock/gmock.h>
#include <linux/videodev2.h>

#include <cmath>
#include <cstring>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <random>

#include "device/camera/v4l2/v4l2_format.h"

namespace omnister::device {
namespace {

constexpr int kWidth = 6, kHeight = 4;

std::vector<unsigned> randomSamples(int bits) {
  std::mt19937 random(7);
  std::uniform_int_distribution<unsigned> value(0, (1u << bits) - 1);
  std::vector<unsigned> samples(kWidth * kHeight);
  for (unsigned& sample : samples) sample = value(random);
  samples[0] = 0;
  samples[1] = (1u << bits) - 1;
  return samples;
}

/// Writes a number of so many bits, lowest bit first, as "10p" and "12p" are defined.
void appendLowestFirst(std::vector<std::uint8_t>* row, std::size_t at_bit, unsigned value,
                       int bits) {
  for (int i = 0; i < bits; ++i) {
    const std::size_t bit = at_bit + static_cast<std::size_t>(i);
    if (row->size() <= bit / 8) row->push_back(0);
    if ((value >> i & 1u) != 0) (*row)[bit / 8] |= static_cast<std::uint8_t>(1u << bit % 8);
  }
}

/// One row as the wire has it.
std::vector<std::uint8_t> pack(Packing packing, int bits, const unsigned* samples) {
  std::vector<std::uint8_t> row;
  for (int i = 0; i < kWidth; ++i) {
    const unsigned value = samples[i];
    switch (packing) {
      case Packing::kPlain:
        row.push_back(static_cast<std::uint8_t>(value & 0xff));
        if (bits > 8) row.push_back(static_cast<std::uint8_t>(value >> 8));
        break;
      case Packing::kLsb10:
      case Packing::kLsb12:
        appendLowestFirst(&row, static_cast<std::size_t>(i * bits), value, bits);
        break;
      default: {
        // GigE Vision: the upper eight bits stand in the outer bytes, the rest in the middle one,
        // the first pixel's in its lower half.
        const int low_bits = bits - 8;
        const auto high = static_cast<std::uint8_t>(value >> low_bits);
        const unsigned low = value & ((1u << low_bits) - 1);
        if (i % 2 == 0) {
          row.push_back(high);
          row.push_back(static_cast<std::uint8_t>(low));
        } else {
          row.back() |= static_cast<std::uint8_t>(low << 4);
          row.push_back(high);
        }
      }
    }
  }
  return row;
}

TEST(PixelFormat, EveryDepthAndPackingBecomesEightOrSixteenBits) {
  int tried = 0;
  for (const char* name :
       {"Mono8",           "Mono10",          "Mono12",          "Mono14",
        "Mono16",          "Mono10p",         "Mono12p",         "Mono10Packed",
        "Mono12Packed",    "BayerGR8",        "BayerRG8",        "BayerGB8",
        "BayerBG8",        "BayerGR10",       "BayerRG10",       "BayerGB10",
        "BayerBG10",       "BayerGR12",       "BayerRG12",       "BayerGB12",
        "BayerBG12",       "BayerGR16",       "BayerRG16",       "BayerGB16",
        "BayerBG16",       "BayerGR10p",      "BayerRG10p",      "BayerGB10p",
        "BayerBG10p",      "BayerGR12p",      "BayerRG12p",      "BayerGB12p",
        "BayerBG12p",      "BayerGR10Packed", "BayerRG10Packed", "BayerGB10Packed",
        "BayerBG10Packed", "BayerGR12Packed", "BayerRG12Packed", "BayerGB12Packed",
        "BayerBG12Packed"}) {
    SCOPED_TRACE(name);
    const PixelFormat* format = findPixelFormat(name);
    ASSERT_NE(format, nullptr);
    EXPECT_EQ(findPixelFormat(format->code), format);
    const std::vector<unsigned> samples = randomSamples(format->bits);
    // Rows stand further apart than they are long.
    constexpr std::size_t kGap = 5;
    std::vector<std::uint8_t> bytes;
    std::size_t step = 0;
    for (int y = 0; y < kHeight; ++y) {
      const std::vector<std::uint8_t> row =
          pack(format->packing, format->bits, samples.data() + y * kWidth);
      EXPECT_EQ(row.size(), static_cast<std::size_t>((kWidth * format->bitsPerPixel() + 7) / 8));
      bytes.insert(bytes.end(), row.begin(), row.end());
      if (y + 1 < kHeight) bytes.insert(bytes.end(), kGap, 0xee);
      step = row.size() + kGap;
    }
    const cv::Mat image = unpack(*format, bytes.data(), {kWidth, kHeight}, step);
    ASSERT_EQ(image.type(), format->type);
    for (int y = 0; y < kHeight; ++y) {
      for (int x = 0; x < kWidth; ++x) {
        const unsigned sample = samples[static_cast<std::size_t>(y * kWidth + x)];
        if (format->bits == 8) {
          ASSERT_EQ(image.at<std::uint8_t>(y, x), sample) << x << " " << y;
        } else {
          ASSERT_EQ(image.at<std::uint16_t>(y, x), sample << (16 - format->bits)) << x << " " << y;
        }
      }
    }
    ++tried;
  }
  EXPECT_EQ(tried, 41);
}

TEST(PixelFormat, EncodingsNameThePatternOfTheMosaic) {
  const struct {
    const char* order;
    const char* encoding;
  } mosaics[] = {
      {"RG", "bayer_rggb"}, {"GR", "bayer_grbg"}, {"GB", "bayer_gbrg"}, {"BG", "bayer_bggr"}};
  for (const auto& mosaic : mosaics) {
    for (const char* depth : {"8", "10", "12", "16", "10p", "12p", "10Packed", "12Packed"}) {
      const std::string name = std::string("Bayer") + mosaic.order + depth;
      const PixelFormat* format = findPixelFormat(name);
      ASSERT_NE(format, nullptr) << name;
      EXPECT_EQ(format->encoding,
                std::string(mosaic.encoding) + (depth == std::string("8") ? "8" : "16"));
    }
  }
  EXPECT_EQ(findPixelFormat("Mono7"), nullptr);
  EXPECT_EQ(findPixelFormat(0u), nullptr);
}

/// ITU-R BT.601, studio range, as cameras send 4:2:2.
cv::Vec3d bgrOf(double y, double u, double v) {
  const double c = 1.164 * (y - 16.0), d = u - 128.0, e = v - 128.0;
  return {c + 2.018 * d, c - 0.391 * d - 0.813 * e, c + 1.596 * e};
}

TEST(PixelFormat, ColourDifferencesBecomeBgr) {
  // Two pixels share their colour differences.
  constexpr std::uint8_t kY[] = {80, 150}, kU = 120, kV = 150;
  const struct {
    const char* name;
    std::vector<std::uint8_t> bytes;
  } cases[] = {{"YUV422_8", {kY[0], kU, kY[1], kV}},
               {"YCbCr422_8", {kY[0], kU, kY[1], kV}},
               {"YUV422_8_UYVY", {kU, kY[0], kV, kY[1]}},
               {"YCbCr422_8_CbYCrY", {kU, kY[0], kV, kY[1]}}};
  for (const auto& test : cases) {
    SCOPED_TRACE(test.name);
    const PixelFormat* format = findPixelFormat(test.name);
    ASSERT_NE(format, nullptr);
    EXPECT_STREQ(format->encoding, "bgr8");
    const cv::Mat image = unpack(*format, test.bytes.data(), {2, 1}, 4);
    ASSERT_EQ(image.type(), CV_8UC3);
    for (int x = 0; x < 2; ++x) {
      const cv::Vec3d expected = bgrOf(kY[x], kU, kV);
      for (int c = 0; c < 3; ++c) EXPECT_NEAR(image.at<cv::Vec3b>(0, x)[c], expected[c], 1.5);
    }
  }
  // One pixel in three bytes; full range.
  const PixelFormat* format = findPixelFormat("YUV8_UYV");
  ASSERT_NE(format, nullptr);
  const std::uint8_t uyv[] = {kU, kY[0], kV};
  const cv::Vec3b bgr = unpack(*format, uyv, {1, 1}, 3).at<cv::Vec3b>(0, 0);
  const double d = kU - 128.0, e = kV - 128.0;
  EXPECT_NEAR(bgr[0], kY[0] + 1.773 * d, 1.5);
  EXPECT_NEAR(bgr[1], kY[0] - 0.344 * d - 0.714 * e, 1.5);
  EXPECT_NEAR(bgr[2], kY[0] + 1.403 * e, 1.5);
}

TEST(PixelFormat, ColoursInBytesStayAsTheyAre) {
  const std::uint8_t bytes[] = {1, 2, 3, 4, 5, 6, 7, 8};
  for (const char* name : {"RGB8", "BGR8", "RGBa8", "BGRa8"}) {
    const PixelFormat* format = findPixelFormat(name);
    ASSERT_NE(format, nullptr);
    EXPECT_TRUE(format->direct());
    const std::size_t pixel = static_cast<std::size_t>(format->bitsPerPixel()) / 8;
    const cv::Mat image = unpack(*format, bytes, {2, 1}, 2 * pixel);
    EXPECT_EQ(std::memcmp(image.data, bytes, 2 * pixel), 0) << name;
  }
}

class V4l2Buffer : public testing::Test {
 protected:
  bool decode(std::uint32_t fourcc, const std::vector<std::uint8_t>& bytes, cv::Size size,
              std::size_t step) {
    frame_ = Frame();
    return decodeV4l2(*findV4l2Format(fourcc), bytes.data(), bytes.size(), size, step, pool_.get(),
                      &frame_);
  }
  const std::shared_ptr<FramePool> pool_ = FramePool::make(4);
  Frame frame_;
};

TEST_F(V4l2Buffer, APictureOfMotionJpegIsWholeOrNone) {
  const cv::Size size(64, 48);
  cv::Mat picture(size, CV_8UC3);
  for (int y = 0; y < size.height; ++y) {
    for (int x = 0; x < size.width; ++x) {
      picture.at<cv::Vec3b>(y, x) =
          cv::Vec3b(static_cast<std::uint8_t>(4 * x), static_cast<std::uint8_t>(5 * y), 100);
    }
  }
  std::vector<std::uint8_t> jpeg;
  ASSERT_TRUE(cv::imencode(".jpg", picture, jpeg, {cv::IMWRITE_JPEG_QUALITY, 98}));
  ASSERT_TRUE(decode(V4L2_PIX_FMT_MJPEG, jpeg, size, 0));
  ASSERT_EQ(frame_.image.type(), CV_8UC3);
  EXPECT_LT(cv::norm(frame_.image, picture, cv::NORM_L1) / (3.0 * picture.total()), 3.0);
  // What a driver leaves behind the picture.
  std::vector<std::uint8_t> padded = jpeg;
  padded.resize(jpeg.size() + 100, 0);
  EXPECT_TRUE(decode(V4L2_PIX_FMT_JPEG, padded, size, 0));
  // Decoders would make up the rest of a torn one.
  int torn = 0;
  for (std::size_t bytes = 0; bytes < jpeg.size(); bytes += 37) {
    EXPECT_FALSE(decode(V4L2_PIX_FMT_MJPEG, {jpeg.begin(), jpeg.begin() + static_cast<long>(bytes)},
                        size, 0))
        << bytes;
    ++torn;
  }
  EXPECT_GT(torn, 10);
  EXPECT_FALSE(decode(V4L2_PIX_FMT_MJPEG, jpeg, {64, 47}, 0));
  EXPECT_FALSE(decode(V4L2_PIX_FMT_MJPEG, {0xff, 0xd8, 1, 2, 3, 0xff, 0xd9}, size, 0));
}

TEST_F(V4l2Buffer, ShortBuffersAreNoFramesAndRowsMayBePadded) {
  const struct {
    std::uint32_t fourcc;
    int type;
    std::size_t step, bytes;
  } cases[] = {{V4L2_PIX_FMT_GREY, CV_8UC1, 10, 40},    {V4L2_PIX_FMT_Y16, CV_16UC1, 18, 72},
               {V4L2_PIX_FMT_SRGGB8, CV_8UC1, 8, 32},   {V4L2_PIX_FMT_SBGGR16, CV_16UC1, 16, 64},
               {V4L2_PIX_FMT_BGR24, CV_8UC3, 30, 120},  {V4L2_PIX_FMT_RGB24, CV_8UC3, 24, 96},
               {V4L2_PIX_FMT_YUYV, CV_8UC3, 20, 80},    {V4L2_PIX_FMT_UYVY, CV_8UC3, 16, 64},
               {V4L2_PIX_FMT_NV12, CV_8UC3, 12, 12 * 6}};
  for (const auto& test : cases) {
    SCOPED_TRACE(std::string(reinterpret_cast<const char*>(&test.fourcc), 4));
    std::vector<std::uint8_t> bytes(test.bytes, 128);
    ASSERT_TRUE(decode(test.fourcc, bytes, {8, 4}, test.step));
    EXPECT_EQ(frame_.image.size(), cv::Size(8, 4));
    EXPECT_EQ(frame_.image.type(), test.type);
    bytes.pop_back();
    EXPECT_FALSE(decode(test.fourcc, bytes, {8, 4}, test.step));
  }
  // Two pixels of 4:2:2, and two by two of 4:2:0, of the same colour.
  constexpr std::uint8_t kY = 120, kU = 110, kV = 150;
  const cv::Vec3d expected = bgrOf(kY, kU, kV);
  const auto check = [&](std::uint32_t fourcc, const std::vector<std::uint8_t>& bytes,
                         cv::Size size, std::size_t step) {
    ASSERT_TRUE(decode(fourcc, bytes, size, step));
    for (int c = 0; c < 3; ++c) EXPECT_NEAR(frame_.image.at<cv::Vec3b>(0, 1)[c], expected[c], 1.5);
  };
  check(V4L2_PIX_FMT_YUYV, {kY, kU, kY, kV}, {2, 1}, 4);
  check(V4L2_PIX_FMT_UYVY, {kU, kY, kV, kY}, {2, 1}, 4);
  check(V4L2_PIX_FMT_NV12, {kY, kY, kY, kY, kU, kV}, {2, 2}, 2);
}

}  // namespace
}  // namespace omnister::device
