// SPDX-License-Identifier: Apache-2.0
#pragma once

namespace omnister::tools {

/// Runs `omnister ARGUMENTS…`. @return exit code: 0 done, 1 failed with one message on standard
/// error, 2 wrong usage
int runCommandLine(int argc, const char* const* argv);

}  // namespace omnister::tools
