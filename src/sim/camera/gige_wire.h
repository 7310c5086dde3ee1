// SPDX-License-Identifier: Apache-2.0
/// @file The network side of a simulated GigE Vision camera: registers over the control protocol
/// (GVCP: discovery, reading and writing, heart beat, control by one client, packets sent again)
/// and images over the stream protocol (GVSP), as the standard (AIA, version 2.0) has them.
#pragma once

#include <arv.h>
#include <netinet/in.h>

#include <atomic>
#include <chrono>
#include <cstdint>
#include <deque>
#include <functional>
#include <mutex>
#include <optional>
#include <random>
#include <string>
#include <thread>
#include <vector>

namespace omnister::sim {

/// One image as it goes on the wire.
struct WireFrame {
  std::uint64_t timestamp = 0;  ///< of the camera's clock [ns]
  std::uint32_t pixel_format = 0;
  std::uint32_t width = 0, height = 0, x = 0, y = 0;
  std::vector<std::uint8_t> data;
  bool chunks = false;  ///< the data end with chunks
};

class GigeWire {
 public:
  /// Listens from now on.
  /// @param interface name of a network interface, or the address of one; any address of the
  /// loopback network
  /// @param camera the registers; stays the caller's
  /// @param on_write called after every write of a client, from the thread that serves them
  /// @throws device::CameraError where there is no such interface or the port is taken
  GigeWire(const std::string& interface, ArvFakeCamera* camera, bool resend,
           std::function<void()> on_write);
  /// Falls silent.
  ~GigeWire();
  GigeWire(const GigeWire&) = delete;
  GigeWire& operator=(const GigeWire&) = delete;

  /// A client controls the camera.
  bool controlled() const { return controlled_; }
  /// Sends it to whom the stream's registers name.
  void send(WireFrame frame);
  /// Share of the stream's packets that get lost from now on, those sent again included.
  void setLoss(double share) { loss_ = share; }
  std::uint64_t framesSent() const { return frames_sent_; }
  std::uint64_t packetsSentAgain() const { return packets_sent_again_; }

 private:
  struct Sent {
    std::uint16_t number;
    std::size_t packet_bytes;  // of image in each
    WireFrame frame;
  };

  void serve();
  void answer(int socket, const std::vector<std::uint8_t>& request, const sockaddr_in& client);
  void watchHeartBeat();
  void sendAgain(const std::vector<std::uint8_t>& request);
  void sendPacket(const Sent& sent, std::uint32_t packet);
  static std::uint32_t packetsOf(const Sent& sent);
  std::uint32_t read(std::uint32_t address) const;
  void write(std::uint32_t address, std::uint32_t value);
  bool mayWrite(const sockaddr_in& client) const;
  bool writeRegister(std::uint32_t address, std::uint32_t value, const sockaddr_in& client);

  ArvFakeCamera* const camera_;
  const std::function<void()> on_write_;
  int control_ = -1, broadcast_ = -1, stream_ = -1;
  std::atomic<bool> stop_{false};
  std::atomic<bool> controlled_{false};
  std::optional<sockaddr_in> controller_;  // of the serving thread
  std::chrono::steady_clock::time_point heard_;
  std::atomic<double> loss_{0.0};
  std::atomic<std::uint64_t> frames_sent_{0}, packets_sent_again_{0};
  std::mutex sending_;
  std::mt19937 random_{1};
  std::uint16_t number_;
  std::deque<Sent> sent_;  // the last ones
  std::thread thread_;
};

}  // namespace omnister::sim
