// SPDX-License-Identifier: Apache-2.0
#include "sim/camera/gige_wire.h"

#include <arpa/inet.h>
#include <ifaddrs.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cstring>

#include "omnister/device/camera.h"

namespace omnister::sim {
namespace {

using Bytes = std::vector<std::uint8_t>;
using std::chrono::milliseconds;

constexpr std::uint16_t kControlPort = 3956;
constexpr milliseconds kLook(50);
constexpr std::size_t kKept = 8;  // frames that packets can be asked for again of
// Frame numbers soon pass their end, as those of a camera that has run for a while.
constexpr std::uint16_t kFirstNumber = 65400;
constexpr int kSocketBuffer = 4 << 20;

// Registers that every GigE Vision camera has.
constexpr std::uint32_t kCapability = 0x0934, kHeartBeat = 0x0938, kControl = 0x0a00,
                        kPacketSize = 0x0d04, kStreamPort = 0x0d00, kStreamAddress = 0x0d18;
constexpr std::uint32_t kCanSendAgain = 1u << 2;
constexpr std::uint32_t kDiscoveryBytes = 0xf8;
// Of the packets' headers.
constexpr std::uint8_t kKey = 0x42, kWantsAnswer = 0x01;
constexpr std::size_t kHeader = 8, kIpAndUdp = 28;
enum Command : std::uint16_t {
  kDiscover = 0x0002,
  kSendAgain = 0x0040,
  kReadRegisters = 0x0080,
  kWriteRegisters = 0x0082,
  kReadMemory = 0x0084,
  kWriteMemory = 0x0086,
};
constexpr std::uint16_t kDone = 0x0000, kNotImplemented = 0x8001, kInvalidParameter = 0x8002,
                        kInvalidAddress = 0x8003, kAccessDenied = 0x8006;
constexpr std::uint8_t kLeader = 1, kTrailer = 2, kPayload = 3;
constexpr std::uint16_t kImage = 0x0001, kWithChunks = 0x4000;

void put16(Bytes* out, std::uint32_t value) {
  out->push_back(static_cast<std::uint8_t>(value >> 8));
  out->push_back(static_cast<std::uint8_t>(value));
}
void put32(Bytes* out, std::uint32_t value) {
  put16(out, value >> 16);
  put16(out, value & 0xffff);
}
std::uint32_t get16(const Bytes& in, std::size_t at) { return in[at] * 256u + in[at + 1]; }
std::uint32_t get32(const Bytes& in, std::size_t at) {
  return get16(in, at) << 16 | get16(in, at + 2);
}

std::optional<in_addr> addressOf(const std::string& interface) {
  in_addr address{};
  if (inet_pton(AF_INET, interface.c_str(), &address) == 1) return address;
  ifaddrs* list = nullptr;
  if (getifaddrs(&list) != 0) return std::nullopt;
  std::optional<in_addr> found;
  for (const ifaddrs* i = list; i && !found; i = i->ifa_next) {
    if (i->ifa_addr && i->ifa_addr->sa_family == AF_INET && interface == i->ifa_name) {
      found = reinterpret_cast<const sockaddr_in*>(i->ifa_addr)->sin_addr;
    }
  }
  freeifaddrs(list);
  return found;
}

/// @return -1 where it cannot be bound
int openSocket(in_addr address, std::uint16_t port, bool shared) {
  const int file = socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
  if (file < 0) return -1;
  const int yes = 1;
  if (shared) setsockopt(file, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
  setsockopt(file, SOL_SOCKET, SO_SNDBUF, &kSocketBuffer, sizeof kSocketBuffer);
  sockaddr_in own{};
  own.sin_family = AF_INET;
  own.sin_addr = address;
  own.sin_port = htons(port);
  if (bind(file, reinterpret_cast<const sockaddr*>(&own), sizeof own) == 0) return file;
  close(file);
  return -1;
}

bool same(const sockaddr_in& a, const sockaddr_in& b) {
  return a.sin_addr.s_addr == b.sin_addr.s_addr && a.sin_port == b.sin_port;
}

}  // namespace

GigeWire::GigeWire(const std::string& interface, ArvFakeCamera* camera, bool resend,
                   std::function<void()> on_write)
    : camera_(camera), on_write_(std::move(on_write)), number_(kFirstNumber) {
  const std::optional<in_addr> address = addressOf(interface);
  if (address) control_ = openSocket(*address, kControlPort, false);
  if (control_ >= 0) stream_ = openSocket(*address, 0, false);
  if (control_ < 0 || stream_ < 0) {
    for (const int file : {control_, stream_}) {
      if (file >= 0) close(file);
    }
    throw device::CameraError("no camera can listen on \"" + printable(interface) +
                              "\": there is no such interface, or another camera has port 3956");
  }
  // Whoever looks for cameras asks everybody. Without this it is found by its address only.
  broadcast_ = openSocket({INADDR_BROADCAST}, kControlPort, true);
  const GInetAddress* own = g_inet_address_new_from_bytes(
      reinterpret_cast<const guint8*>(&address->s_addr), G_SOCKET_FAMILY_IPV4);
  arv_fake_camera_set_inet_address(camera_, const_cast<GInetAddress*>(own));
  g_object_unref(const_cast<GInetAddress*>(own));
  const std::uint32_t capability = read(kCapability);
  write(kCapability, resend ? capability | kCanSendAgain : capability & ~kCanSendAgain);
  thread_ = std::thread(&GigeWire::serve, this);
}

GigeWire::~GigeWire() {
  stop_ = true;
  thread_.join();
  for (const int file : {control_, broadcast_, stream_}) {
    if (file >= 0) close(file);
  }
}

std::uint32_t GigeWire::read(std::uint32_t address) const {
  guint32 value = 0;
  arv_fake_camera_read_register(camera_, address, &value);
  return value;
}

void GigeWire::write(std::uint32_t address, std::uint32_t value) {
  arv_fake_camera_write_register(camera_, address, value);
}

void GigeWire::serve() {
  std::array<pollfd, 2> waiting = {{{control_, POLLIN, 0}, {broadcast_, POLLIN, 0}}};
  Bytes request;
  while (!stop_) {
    if (poll(waiting.data(), waiting.size(), static_cast<int>(kLook.count())) > 0) {
      for (const pollfd& file : waiting) {
        if ((file.revents & POLLIN) == 0) continue;
        request.resize(2048);
        sockaddr_in client{};
        socklen_t size = sizeof client;
        const ssize_t got = recvfrom(file.fd, request.data(), request.size(), MSG_DONTWAIT,
                                     reinterpret_cast<sockaddr*>(&client), &size);
        if (got < static_cast<ssize_t>(kHeader)) continue;
        request.resize(static_cast<std::size_t>(got));
        answer(control_, request, client);
      }
    }
    watchHeartBeat();
  }
}

void GigeWire::watchHeartBeat() {
  if (!controller_) return;
  if (std::chrono::steady_clock::now() - heard_ < milliseconds(read(kHeartBeat))) return;
  controller_.reset();
  controlled_ = false;
  write(kControl, 0);
  write(ARV_FAKE_CAMERA_REGISTER_ACQUISITION, 0);
}

bool GigeWire::mayWrite(const sockaddr_in& client) const {
  return controller_ && same(*controller_, client);
}

bool GigeWire::writeRegister(std::uint32_t address, std::uint32_t value,
                             const sockaddr_in& client) {
  if (address == kControl) {
    if (controller_ && !same(*controller_, client)) return false;
    controller_.reset();
    if (value != 0) controller_ = client;
    heard_ = std::chrono::steady_clock::now();
    controlled_ = value != 0;
  } else if (!mayWrite(client)) {
    return false;
  }
  write(address, value);
  return true;
}

void GigeWire::answer(int socket, const Bytes& request, const sockaddr_in& client) {
  const std::uint32_t command = get16(request, 2), length = get16(request, 4);
  if (request[0] != kKey || request.size() < kHeader + length) return;
  if (controller_ && same(*controller_, client)) heard_ = std::chrono::steady_clock::now();
  std::uint16_t status = kDone;
  Bytes reply;
  const auto at = [&](std::size_t word) { return get32(request, kHeader + 4 * word); };
  switch (command) {
    case kDiscover:
      reply.resize(kDiscoveryBytes);
      arv_fake_camera_read_memory(camera_, 0, kDiscoveryBytes, reply.data());
      break;
    case kSendAgain:
      // It is asked for from the port that the stream goes to.
      if (client.sin_addr.s_addr == htonl(read(kStreamAddress))) sendAgain(request);
      return;
    case kReadRegisters:
      for (std::size_t i = 0; i < length / 4; ++i) put32(&reply, read(at(i)));
      break;
    case kWriteRegisters: {
      std::uint32_t done = 0;
      for (; done < length / 8 && status == kDone; ++done) {
        if (!writeRegister(at(2 * done), at(2 * done + 1), client)) status = kAccessDenied;
      }
      put32(&reply, done);
      if (status == kDone) on_write_();
      break;
    }
    case kReadMemory: {
      const std::uint32_t size = length >= 8 ? at(1) & 0xffff : 0;
      constexpr std::uint32_t kMost = 536;
      if (size == 0 || size > kMost) {
        status = kInvalidParameter;
        break;
      }
      put32(&reply, at(0));
      reply.resize(4 + size);
      if (!arv_fake_camera_read_memory(camera_, at(0), size, reply.data() + 4)) {
        status = kInvalidAddress;
      }
      break;
    }
    case kWriteMemory:
      if (length < 8) {
        status = kInvalidParameter;
      } else if (!mayWrite(client)) {
        status = kAccessDenied;
      } else if (!arv_fake_camera_write_memory(camera_, at(0), length - 4,
                                               request.data() + kHeader + 4)) {
        status = kInvalidAddress;
      } else {
        on_write_();
      }
      put32(&reply, length);
      break;
    default:
      status = kNotImplemented;
      break;
  }
  if ((request[1] & kWantsAnswer) == 0) return;
  if (status != kDone) reply.clear();
  Bytes packet;
  put16(&packet, status);
  put16(&packet, command + 1);
  put16(&packet, static_cast<std::uint32_t>(reply.size()));
  put16(&packet, get16(request, 6));
  packet.insert(packet.end(), reply.begin(), reply.end());
  sendto(socket, packet.data(), packet.size(), MSG_NOSIGNAL,
         reinterpret_cast<const sockaddr*>(&client), sizeof client);
}

std::uint32_t GigeWire::packetsOf(const Sent& sent) {
  const std::size_t payload = (sent.frame.data.size() + sent.packet_bytes - 1) / sent.packet_bytes;
  return static_cast<std::uint32_t>(payload) + 2;
}

void GigeWire::sendPacket(const Sent& sent, std::uint32_t packet) {
  if (std::uniform_real_distribution<double>()(random_) < loss_) return;
  const std::uint32_t last = packetsOf(sent) - 1;
  const std::uint8_t kind = packet == 0 ? kLeader : packet == last ? kTrailer : kPayload;
  const std::uint32_t type = kImage | (sent.frame.chunks ? kWithChunks : 0u);
  Bytes bytes;
  bytes.reserve(kHeader + sent.packet_bytes);
  put16(&bytes, 0);
  put16(&bytes, sent.number);
  put32(&bytes, static_cast<std::uint32_t>(kind) << 24 | packet);
  if (kind == kLeader) {
    put32(&bytes, type);
    put32(&bytes, static_cast<std::uint32_t>(sent.frame.timestamp >> 32));
    put32(&bytes, static_cast<std::uint32_t>(sent.frame.timestamp));
    for (const std::uint32_t value : {sent.frame.pixel_format, sent.frame.width, sent.frame.height,
                                      sent.frame.x, sent.frame.y, 0u}) {
      put32(&bytes, value);
    }
  } else if (kind == kTrailer) {
    put32(&bytes, type);
    put32(&bytes, sent.frame.height);
  } else {
    const std::size_t from = (packet - 1) * sent.packet_bytes;
    const std::size_t to = std::min(from + sent.packet_bytes, sent.frame.data.size());
    bytes.insert(bytes.end(), sent.frame.data.begin() + static_cast<std::ptrdiff_t>(from),
                 sent.frame.data.begin() + static_cast<std::ptrdiff_t>(to));
  }
  sockaddr_in client{};
  client.sin_family = AF_INET;
  client.sin_addr.s_addr = htonl(read(kStreamAddress));
  client.sin_port = htons(static_cast<std::uint16_t>(read(kStreamPort)));
  sendto(stream_, bytes.data(), bytes.size(), MSG_NOSIGNAL,
         reinterpret_cast<const sockaddr*>(&client), sizeof client);
}

void GigeWire::send(WireFrame frame) {
  const std::lock_guard<std::mutex> lock(sending_);
  constexpr std::size_t kLeast = 64;
  const std::size_t packet = read(kPacketSize) & 0xffff;
  sent_.push_back({number_, std::max(packet, kLeast + kIpAndUdp + kHeader) - kIpAndUdp - kHeader,
                   std::move(frame)});
  if (sent_.size() > kKept) sent_.pop_front();
  // Counted before it can have arrived.
  ++frames_sent_;
  for (std::uint32_t i = 0; i < packetsOf(sent_.back()); ++i) sendPacket(sent_.back(), i);
  // 0 is no number of a frame.
  number_ = number_ == 65535 ? 1 : static_cast<std::uint16_t>(number_ + 1);
}

void GigeWire::sendAgain(const Bytes& request) {
  constexpr std::size_t kWords = 12;
  if (request.size() < kHeader + kWords || (read(kCapability) & kCanSendAgain) == 0) return;
  const std::uint32_t number = get32(request, kHeader) & 0xffff;
  const std::uint32_t first = get32(request, kHeader + 4) & 0xffffff;
  const std::uint32_t last = get32(request, kHeader + 8) & 0xffffff;
  const std::lock_guard<std::mutex> lock(sending_);
  for (const Sent& sent : sent_) {
    if (sent.number != number) continue;
    for (std::uint32_t i = first; i <= std::min(last, packetsOf(sent) - 1); ++i) {
      ++packets_sent_again_;
      sendPacket(sent, i);
    }
  }
}

}  // namespace omnister::sim
