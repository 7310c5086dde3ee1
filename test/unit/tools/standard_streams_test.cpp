// SPDX-License-Identifier: Apache-2.0
// The program as a shell starts it, with standard streams that are full or closed: it says so once,
// and nothing of what it prints gets into a file.
#include <gmock/gmock.h>

#include <filesystem>
#include <string>
#include <utility>

#include "child_process.h"
#include "omnister/common/file_io.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

constexpr char kFull[] = "omnister: cannot write to standard output\n";

class StandardStreams : public testing::Test {
 protected:
  std::string path(const std::string& name) const { return (folder_.path() / name).string(); }

  /// `omnister WORDS`, words of a shell. @return its exit status and what came from standard error
  std::pair<int, std::string> shell(const std::string& words) const {
    std::filesystem::remove(path("said"));
    test::ChildProcess process({"/bin/sh", "-c", "\"$0\" " + words, OMNISTER_PROGRAM},
                               path("said"));
    const int status = process.wait();
    return {status, readFile(path("said"))};
  }

  const test::TemporaryFolder folder_;
  const std::string source_ = OMNISTER_SOURCE_DIR;
  const std::string lens_ = source_ + "/test/rig/lens.yaml";
  const std::string render_ = "render --lens " + lens_ + " --scene " + source_ +
                              "/config/scenes/plane.yaml --supersampling 1 --out " +
                              path("view.png");
};

TEST_F(StandardStreams, OutputThatCannotBeWrittenIsAFailure) {
  const std::string commands[] = {"--help",
                                  "--version",
                                  "stereo --help",
                                  "store list --store " + folder_.path().string() + " --json",
                                  render_,
                                  render_ + " --json",
                                  "project --lens " + lens_ + " --json"};
  for (const std::string& command : commands) {
    for (const char* stream : {" >/dev/full", " >&-"})
      EXPECT_EQ(shell(command + stream), std::pair(1, std::string(kFull))) << command << stream;
  }
}

TEST_F(StandardStreams, WhatIsPrintedGetsIntoNoFile) {
  ASSERT_EQ(shell(render_ + " >/dev/null").first, 0);
  const std::string good = readFile(path("view.png"));
  for (const char* streams : {" >&-", " >&- 2>&-", " <&- >&- 2>&-"}) {
    EXPECT_EQ(shell(render_ + streams).first, 1) << streams;
    EXPECT_EQ(readFile(path("view.png")), good) << streams;
  }
  EXPECT_EQ(shell(render_ + " >/dev/null 2>&-").first, 0);
}

TEST_F(StandardStreams, InputThatCannotBeReadIsAFailure) {
  for (const std::string& stream : {std::string("<&-"), "<" + folder_.path().string()}) {
    EXPECT_EQ(shell("project --lens " + lens_ + " " + stream),
              std::pair(1, std::string("omnister: cannot read standard input\n")))
        << stream;
  }
}

TEST_F(StandardStreams, NamesNeedNotBeUtf8) {
  const std::string name = path("v\xFC.png");
  const auto [status, said] =
      shell("render --lens " + lens_ + " --scene " + source_ +
            "/config/scenes/plane.yaml --supersampling 1 --json --out " + name);
  EXPECT_EQ(status, 0) << said;
  EXPECT_THAT(said, testing::HasSubstr("v\xEF\xBF\xBD.png"));
  EXPECT_TRUE(std::filesystem::exists(name));
}

}  // namespace
}  // namespace omnister
