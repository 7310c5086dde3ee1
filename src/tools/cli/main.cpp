// SPDX-License-Identifier: Apache-2.0
#include <fcntl.h>

#include "tools/cli/command_line.h"

namespace {

/// In the place of a standard stream that was closed the first file opened would be taken, and what
/// is printed would go into it: there is nothing to read or write there instead.
void occupyStandardStreams() {
  for (int stream = 0; stream <= 2; ++stream) {
    if (::fcntl(stream, F_GETFD) < 0) ::open("/dev/null", stream == 0 ? O_WRONLY : O_RDONLY);
  }
}

}  // namespace

int main(int argc, char** argv) {
  occupyStandardStreams();
  return omnister::tools::runCommandLine(argc, argv);
}
