// SPDX-License-Identifier: Apache-2.0
/// @file The lines of the Zaber ASCII protocol.
///
///     /1 1 07 move abs 36283:CC     command to device 1, axis 1, with message id and checksum
///     @01 1 07 OK BUSY -- 0:CC      reply: accepted (OK) or rejected (RJ), status, warning, data
///     !01 1 IDLE --:CC              alert, #01 1 07 text:CC info
///
/// The checksum (LRC) is the two's complement of the sum of all bytes between the leading character
/// (which is left out) and the colon, as two hexadecimal digits.
#pragma once

#include <optional>
#include <string>
#include <string_view>

namespace omnister::device {

/// Two upper-case hexadecimal digits. @param body without the leading character and the colon
std::string zaberChecksum(std::string_view body);

/// A command line with checksum and newline.
std::string zaberCommand(int device, int axis, int id, std::string_view command);

struct ZaberReply {
  int device = 0;
  int axis = 0;
  std::optional<int> id;
  bool accepted = false;      ///< OK, not RJ
  bool busy = false;          ///< BUSY, not IDLE
  std::string warning;        ///< two characters, "--" for none
  std::string data;           ///< of a rejected command: the reason
  bool has_checksum = false;  ///< and it was right
};

/// A reply line, taken strictly: whatever is not exactly one is refused, and so is a wrong
/// checksum.
std::optional<ZaberReply> parseZaberReply(std::string_view line);

/// An alert or info line with the right checksum, or none.
bool isZaberNotice(std::string_view line);

}  // namespace omnister::device
