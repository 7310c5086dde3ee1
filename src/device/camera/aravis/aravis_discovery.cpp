// SPDX-License-Identifier: Apache-2.0
#include "device/camera/aravis/aravis_discovery.h"

#include <arpa/inet.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstring>
#include <mutex>
#include <tuple>

#include "device/camera/aravis/aravis_call.h"

namespace omnister::device {
namespace {

using std::chrono::milliseconds;

std::string list(const std::vector<AravisDevice>& devices) {
  std::string text;
  for (const AravisDevice& device : devices) text += (text.empty() ? "" : ", ") + describe(device);
  return text;
}

/// Vendors have several spellings.
bool same(const CameraIdentity& a, const CameraIdentity& b) {
  return a.serial == b.serial && a.model == b.model;
}

/// A UDP socket towards the control port of a camera.
class ControlSocket {
 public:
  explicit ControlSocket(in_addr address) : file_(socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0)) {
    sockaddr_in to{};
    to.sin_family = AF_INET;
    to.sin_port = htons(3956);
    to.sin_addr = address;
    if (file_ < 0 || connect(file_, reinterpret_cast<sockaddr*>(&to), sizeof to) != 0) {
      const int reason = errno;
      close();
      throw CameraError("no way to " + string(inet_ntoa(address)) + ": " + std::strerror(reason));
    }
  }
  ~ControlSocket() { close(); }
  ControlSocket(const ControlSocket&) = delete;
  ControlSocket& operator=(const ControlSocket&) = delete;

  /// Our own address on the way there.
  std::string interface() const {
    sockaddr_in own{};
    socklen_t size = sizeof own;
    if (getsockname(file_, reinterpret_cast<sockaddr*>(&own), &size) != 0) return "";
    std::array<char, INET_ADDRSTRLEN> text{};
    return string(inet_ntop(AF_INET, &own.sin_addr, text.data(), text.size()));
  }

  /// @return what came back within the time; 0: nothing
  std::size_t exchange(const std::uint8_t* request, std::size_t size, std::uint8_t* reply,
                       std::size_t capacity, milliseconds timeout) {
    if (send(file_, request, size, MSG_NOSIGNAL) < 0) return 0;
    pollfd waiting{file_, POLLIN, 0};
    if (poll(&waiting, 1, static_cast<int>(timeout.count())) <= 0) return 0;
    const ssize_t got = recv(file_, reply, capacity, 0);
    return got > 0 ? static_cast<std::size_t>(got) : 0;
  }

 private:
  void close() {
    if (file_ >= 0) ::close(file_);
    file_ = -1;
  }
  int file_;
};

/// Asks one address which camera stands there, by a GigE Vision discovery command.
std::optional<AravisDevice> probe(const std::string& text) {
  const std::optional<in_addr> address = parseAddress(text);
  if (!address) return std::nullopt;
  ControlSocket control(*address);
  // Key, flags (acknowledge), command DISCOVERY_CMD, length, id.
  constexpr std::array<std::uint8_t, 8> kDiscover = {0x42, 0x01, 0x00, 0x02, 0, 0, 0xff, 0xff};
  constexpr std::size_t kHeader = 8, kData = 248;
  std::array<std::uint8_t, 1024> reply{};
  for (int attempt = 0; attempt < 3; ++attempt) {
    const std::size_t size = control.exchange(kDiscover.data(), kDiscover.size(), reply.data(),
                                              reply.size(), milliseconds(300));
    if (size < kHeader + kData || reply[2] != 0x00 || reply[3] != 0x03) continue;
    const auto field = [&](std::size_t offset, std::size_t length) {
      const char* begin = reinterpret_cast<const char*>(reply.data()) + kHeader + offset;
      return std::string(begin, strnlen(begin, length));
    };
    AravisDevice device;
    device.address = text;
    device.protocol = "GigEVision";
    device.identity = {field(0x48, 32), field(0x68, 32), field(0xd8, 16)};
    device.id = device.identity.vendor + "-" + device.identity.model + "-" + device.identity.serial;
    return device;
  }
  return std::nullopt;
}

}  // namespace

std::string describe(const AravisDevice& device) {
  const CameraIdentity& who = device.identity;
  return printable(who.vendor + " " + who.model + " " + who.serial +
                   (device.address.empty() ? "" : " at " + device.address));
}

std::optional<in_addr> parseAddress(const std::string& text) {
  in_addr address{};
  if (inet_pton(AF_INET, text.c_str(), &address) != 1) return std::nullopt;
  return address;
}

std::string interfaceTowards(in_addr address) { return ControlSocket(address).interface(); }

std::vector<AravisDevice> listAravisDevices() {
  // Aravis keeps one list for the whole program.
  static std::mutex mutex;
  const std::lock_guard<std::mutex> lock(mutex);
  arv_update_device_list();
  std::vector<AravisDevice> devices;
  for (unsigned i = 0; i < arv_get_n_devices(); ++i) {
    AravisDevice device;
    device.id = string(arv_get_device_id(i));
    device.physical = string(arv_get_device_physical_id(i));
    device.protocol = string(arv_get_device_protocol(i));
    if (device.protocol == "GigEVision") device.address = string(arv_get_device_address(i));
    device.identity = {string(arv_get_device_vendor(i)), string(arv_get_device_model(i)),
                       string(arv_get_device_serial_nbr(i))};
    const bool seen = std::any_of(devices.begin(), devices.end(), [&](const AravisDevice& other) {
      return other.protocol == device.protocol && other.address == device.address &&
             same(other.identity, device.identity);
    });
    if (!seen) devices.push_back(std::move(device));
  }
  return devices;
}

std::vector<AravisDevice> matchAravisDevices(const std::vector<AravisDevice>& devices,
                                             const std::string& which) {
  const std::string wanted = lower(which);
  using Name = std::string (*)(const AravisDevice&);
  static constexpr Name kNames[] = {
      [](const AravisDevice& d) { return d.identity.serial; },
      [](const AravisDevice& d) { return d.address; },
      [](const AravisDevice& d) { return d.physical; },
      [](const AravisDevice& d) { return d.id; },
      [](const AravisDevice& d) {
        return d.identity.vendor + "-" + d.identity.model + "-" + d.identity.serial;
      },
      [](const AravisDevice& d) { return d.identity.vendor + "-" + d.identity.serial; },
      [](const AravisDevice& d) { return d.identity.vendor + "-" + d.identity.model; },
      [](const AravisDevice& d) { return d.identity.model; },
  };
  std::vector<AravisDevice> found;
  for (const Name name : kNames) {
    std::copy_if(devices.begin(), devices.end(), std::back_inserter(found),
                 [&](const AravisDevice& device) {
                   return wanted.empty() || lower(name(device)) == wanted;
                 });
    if (!found.empty()) break;
  }
  std::sort(found.begin(), found.end(), [](const AravisDevice& a, const AravisDevice& b) {
    return std::tie(a.identity.serial, a.address) < std::tie(b.identity.serial, b.address);
  });
  return found;
}

AravisDevice findAravisDevice(const std::string& which, const CameraSettings& settings,
                              std::vector<std::string>* remarks) {
  std::optional<AravisDevice> device = probe(which);
  if (device && settings.identity && !same(device->identity, *settings.identity)) device.reset();
  if (!device) {
    const std::vector<AravisDevice> all = listAravisDevices();
    std::vector<AravisDevice> found;
    if (settings.identity) {
      std::copy_if(all.begin(), all.end(), std::back_inserter(found),
                   [&](const AravisDevice& d) { return same(d.identity, *settings.identity); });
    } else {
      found = matchAravisDevices(all, which);
    }
    if (found.empty()) {
      const std::string wanted = settings.identity
                                     ? settings.identity->vendor + " " + settings.identity->model +
                                           " " + settings.identity->serial
                                 : which.empty() ? "no camera"
                                                 : "no camera \"" + which + "\"";
      throw CameraError(
          printable(settings.identity ? wanted + " does not answer" : wanted + " is there") +
          (all.empty() ? "; none is found" : "; there are: " + list(all)));
    }
    device = found.front();
    if (!device->address.empty()) {
      // Aravis remembers cameras that are gone, and another may stand there now.
      const std::optional<AravisDevice> there = probe(device->address);
      if (!there || !same(there->identity, device->identity)) {
        throw CameraError(describe(*device) + " does not answer" +
                          (there ? "; there stands " + describe(*there) : ""));
      }
    }
    if (which.empty()) {
      remarks->push_back("the device names no camera, taking " + describe(*device) + " of " +
                         std::to_string(found.size()) +
                         "; aravis:" + printable(device->identity.serial) + " would be sure");
    }
    const bool several = std::any_of(found.begin(), found.end(), [&](const AravisDevice& d) {
      return !same(d.identity, device->identity);
    });
    if (several) {
      remarks->push_back("\"" + printable(which) + "\" fits several cameras, taking " +
                         describe(*device) + "; there are: " + list(found));
    }
  }
  return *device;
}

}  // namespace omnister::device
