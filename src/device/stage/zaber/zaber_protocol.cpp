// SPDX-License-Identifier: Apache-2.0
#include "device/stage/zaber/zaber_protocol.h"

#include <cstdio>

namespace omnister::device {
namespace {

bool isDigit(char c) { return c >= '0' && c <= '9'; }

bool isPrintable(std::string_view text) {
  for (const char c : text) {
    if (c < 0x20 || c > 0x7e) return false;
  }
  return true;
}

/// The next word; words are separated by one blank each.
std::string_view takeWord(std::string_view* text) {
  const std::size_t end = std::min(text->find(' '), text->size());
  const std::string_view word = text->substr(0, end);
  text->remove_prefix(std::min(end + 1, text->size()));
  return word;
}

std::optional<int> parseDigits(std::string_view word, std::size_t longest) {
  if (word.empty() || word.size() > longest) return std::nullopt;
  int value = 0;
  for (const char c : word) {
    if (!isDigit(c)) return std::nullopt;
    value = 10 * value + (c - '0');
  }
  return value;
}

/// Takes a checksum off the end. @return false when it is wrong
bool takeChecksum(std::string_view* body, bool* had_one) {
  *had_one = false;
  const std::size_t colon = body->rfind(':');
  if (colon == std::string_view::npos) return true;
  if (body->size() - colon != 3) return false;
  if (body->substr(colon + 1) != zaberChecksum(body->substr(0, colon))) return false;
  *had_one = true;
  *body = body->substr(0, colon);
  return true;
}

}  // namespace

std::string zaberChecksum(std::string_view body) {
  unsigned sum = 0;
  for (const char c : body) sum += static_cast<unsigned char>(c);
  char text[3];
  std::snprintf(text, sizeof(text), "%02X", (~sum + 1u) & 0xffu);
  return text;
}

std::string zaberCommand(int device, int axis, int id, std::string_view command) {
  char head[32];
  std::snprintf(head, sizeof(head), "%d %d %02d", device, axis, id);
  std::string body = head;
  if (!command.empty()) body += " " + std::string(command);
  return "/" + body + ":" + zaberChecksum(body) + "\n";
}

std::optional<ZaberReply> parseZaberReply(std::string_view line) {
  if (line.empty() || line.front() != '@' || !isPrintable(line)) return std::nullopt;
  line.remove_prefix(1);
  ZaberReply reply;
  if (!takeChecksum(&line, &reply.has_checksum)) return std::nullopt;
  const std::optional<int> device = parseDigits(takeWord(&line), 2);
  const std::optional<int> axis = parseDigits(takeWord(&line), 1);
  if (!device || !axis) return std::nullopt;
  reply.device = *device;
  reply.axis = *axis;
  std::string_view word = takeWord(&line);
  if (!word.empty() && isDigit(word.front())) {
    reply.id = parseDigits(word, 2);
    if (!reply.id) return std::nullopt;
    word = takeWord(&line);
  }
  if (word != "OK" && word != "RJ") return std::nullopt;
  reply.accepted = word == "OK";
  word = takeWord(&line);
  if (word != "IDLE" && word != "BUSY") return std::nullopt;
  reply.busy = word == "BUSY";
  reply.warning = std::string(takeWord(&line));
  if (reply.warning.size() != 2) return std::nullopt;
  if (line.empty()) return std::nullopt;
  reply.data = std::string(line);
  return reply;
}

bool isZaberNotice(std::string_view line) {
  if (line.empty() || (line.front() != '!' && line.front() != '#') || !isPrintable(line)) {
    return false;
  }
  line.remove_prefix(1);
  bool had_checksum = false;
  if (!takeChecksum(&line, &had_checksum)) return false;
  return parseDigits(takeWord(&line), 2) && parseDigits(takeWord(&line), 1);
}

}  // namespace omnister::device
