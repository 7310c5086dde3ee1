// SPDX-License-Identifier: Apache-2.0
#include <vector>

#include "device/camera/pixel_format.h"
#include "fuzz.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  static const char* const kNames[] = {
      "Mono8",       "Mono10",       "Mono12",          "Mono16",   "Mono10p",
      "Mono12p",     "Mono10Packed", "Mono12Packed",    "BayerRG8", "BayerGB12",
      "BayerGR10p",  "BayerBG12p",   "BayerGR10Packed", "RGB8",     "BayerRG12Packed",
      "BGRa8",       "YUV422_8",     "YUV422_8_UYVY",   "YUV8_UYV", "YCbCr422_8",
      "Coord3D_A32f"};
  Bytes in(bytes);
  using namespace omnister::device;
  const PixelFormat* format = findPixelFormat(kNames[in.take<std::uint8_t>() % std::size(kNames)]);
  findPixelFormat(in.take<std::uint32_t>());
  if (format == nullptr) return;
  require(findPixelFormat(format->code) != nullptr, "a format is known by its code");
  const cv::Size size(1 + in.take<std::uint8_t>(), 1 + in.take<std::uint8_t>() % 64);
  const std::size_t step = static_cast<std::size_t>((size.width * format->bitsPerPixel() + 7) / 8) +
                           in.take<std::uint8_t>() % 4;
  // Exactly as much memory as the frame has, so that what is read beyond it is seen.
  std::vector<std::uint8_t> data(step * static_cast<std::size_t>(size.height));
  const std::string_view rest = in.rest();
  for (std::size_t i = 0; i < data.size() && !rest.empty(); ++i)
    data[i] = static_cast<std::uint8_t>(rest[i % rest.size()]);
  const cv::Mat image = unpack(*format, data.data(), size, step);
  require(image.size() == size && image.type() == format->type, "a frame keeps its size");
}
