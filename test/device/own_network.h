// SPDX-License-Identifier: Apache-2.0
/// A network of this test program's own: nothing outside is heard, nobody outside is disturbed, and
/// programs that tests start live in it, too.
#pragma once

#include <arpa/inet.h>
#include <net/if.h>
#include <sched.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cstring>

namespace omnister::test {

inline bool setLoopback(const char* name, const char* address) {
  const int file = socket(AF_INET, SOCK_DGRAM, 0);
  if (file < 0) return false;
  ifreq request{};
  std::strncpy(request.ifr_name, name, IFNAMSIZ - 1);
  bool done = true;
  const auto set = [&](unsigned long what, const char* text) {
    auto* to = reinterpret_cast<sockaddr_in*>(&request.ifr_addr);
    *to = sockaddr_in{};
    to->sin_family = AF_INET;
    inet_pton(AF_INET, text, &to->sin_addr);
    done = done && ioctl(file, what, &request) == 0;
  };
  set(SIOCSIFADDR, address);
  set(SIOCSIFNETMASK, "255.0.0.0");
  request.ifr_flags = IFF_UP | IFF_RUNNING | IFF_LOOPBACK;
  done = done && ioctl(file, SIOCSIFFLAGS, &request) == 0;
  close(file);
  return done;
}

/// With 127.0.0.1 and 127.0.0.2. Must be called before the first thread starts.
/// @return false where that is not allowed: then this is the network of the host
inline bool enterOwnNetwork() {
  if (unshare(CLONE_NEWNET) != 0 && unshare(CLONE_NEWUSER | CLONE_NEWNET) != 0) return false;
  return setLoopback("lo", "127.0.0.1") && setLoopback("lo:1", "127.0.0.2");
}

inline const bool kOwnNetwork = enterOwnNetwork();

}  // namespace omnister::test
