// SPDX-License-Identifier: Apache-2.0
#include "fuzz.h"
#include "ros/message/conversions.h"
#include "ros/message/messages.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  Bytes in(bytes);
  LensModelMessage message;
  message.width = in.take<std::uint16_t>();
  message.height = in.take<std::uint16_t>();
  message.model = std::string(in.text(in.take<std::uint8_t>() % 12));
  message.yaml = std::string(in.rest());
  takes(
      [&] { require(fromLensModelMessage(message, "input").lens != nullptr, "a lens is there"); });
  // Once more, agreeing with the file.
  takes([&] {
    const LensFile file = parseLensFile(message.yaml, "input");
    message.width = static_cast<std::uint32_t>(file.image_size.width);
    message.height = static_cast<std::uint32_t>(file.image_size.height);
    message.model = std::string(file.lens->model());
    fromLensModelMessage(message, "input");
  });
}
