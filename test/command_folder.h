// SPDX-License-Identifier: Apache-2.0
/// @file Commands called within a folder of their own.
#pragma once

#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <iterator>
#include <string>
#include <vector>

#include "command_run.h"
#include "omnister/common/file_io.h"
#include "temporary_folder.h"

namespace omnister::test {

class CommandFolder : public ::testing::Test {
 protected:
  std::string path(const std::string& name) const { return (folder_.path() / name).string(); }
  std::size_t entries() const {
    return std::distance(std::filesystem::directory_iterator(folder_.path()),
                         std::filesystem::directory_iterator());
  }

  /// A failure: this exit code, nothing on standard output, no file made, those in `kept` not
  /// touched. @return what was said: a single line where work began
  std::string refused(const std::vector<std::string>& arguments, int code,
                      const std::vector<std::string>& kept) const {
    for (const std::string& name : kept) writeFileAtomically(path(name), "old " + name);
    const std::size_t before = entries();
    const Outcome outcome = run(arguments);
    EXPECT_EQ(outcome.code, code) << outcome.err;
    EXPECT_EQ(outcome.out, "");
    if (code == 1) {
      EXPECT_EQ(std::count(outcome.err.begin(), outcome.err.end(), '\n'), 1) << outcome.err;
      EXPECT_EQ(outcome.err.rfind("omnister: ", 0), 0u) << outcome.err;
    }
    EXPECT_EQ(entries(), before);
    for (const std::string& name : kept) EXPECT_EQ(readFile(path(name)), "old " + name);
    return outcome.err;
  }

  TemporaryFolder folder_;
};

}  // namespace omnister::test
