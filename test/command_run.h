// SPDX-License-Identifier: Apache-2.0
/// @file The command line as a person calls it, within the test's process.
#pragma once

#include <gtest/gtest.h>

#include <iostream>
#include <sstream>
#include <streambuf>
#include <string>
#include <utility>
#include <vector>

#include "tools/cli/command_line.h"

namespace omnister::test {

struct Outcome {
  int code = -1;
  std::string out, err;

  std::vector<std::string> lines() const {
    std::vector<std::string> result;
    std::istringstream text(out);
    for (std::string line; std::getline(text, line);) result.push_back(line);
    return result;
  }
};

/// `omnister ARGUMENTS…` with this on standard input.
inline Outcome run(std::vector<std::string> arguments, std::streambuf& input) {
  // Before the first call, as it gives std::cin another buffer.
  std::ios::sync_with_stdio(false);
  std::streambuf* before = std::cin.rdbuf(&input);
  std::cin.clear();
  arguments.insert(arguments.begin(), "omnister");
  std::vector<const char*> argv;
  for (const std::string& argument : arguments) argv.push_back(argument.c_str());
  ::testing::internal::CaptureStdout();
  ::testing::internal::CaptureStderr();
  Outcome outcome;
  outcome.code = tools::runCommandLine(static_cast<int>(argv.size()), argv.data());
  std::cout.flush();
  outcome.out = ::testing::internal::GetCapturedStdout();
  outcome.err = ::testing::internal::GetCapturedStderr();
  std::cin.rdbuf(before);
  std::cin.clear();
  return outcome;
}

/// `omnister ARGUMENTS…` with this text on standard input.
inline Outcome run(std::vector<std::string> arguments, const std::string& input = "") {
  std::istringstream text(input);
  return run(std::move(arguments), *text.rdbuf());
}

}  // namespace omnister::test
