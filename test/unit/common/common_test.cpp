// SPDX-License-Identifier: Apache-2.0
#include <fcntl.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <limits>

#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"
#include "omnister/common/parallel.h"
#include "omnister/common/pose.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;

class FileIo : public ::testing::Test {
 protected:
  std::size_t entries() const {
    return std::distance(fs::directory_iterator(folder_), fs::directory_iterator());
  }
  const test::TemporaryFolder temporary_;
  const fs::path folder_ = temporary_.path();
};

TEST(Printable, EscapesControlCharactersAndBrokenUtf8) {
  EXPECT_EQ(printable("plain \xC3\xA4"), "plain \xC3\xA4");
  EXPECT_EQ(printable("a\nb\x1b[0m\x7f"), "a\\x0ab\\x1b[0m\\x7f");
  EXPECT_EQ(printable("\xFF\xC3"), "\\xff\\xc3");
  EXPECT_EQ(printable("\xC2\x85"), "\\xc2\\x85");
  EXPECT_EQ(printable(std::string(300, 'x'), 10), "xxxxxxxxxx...");
}

TEST(Numbers, TakesWholeNumbersOnly) {
  EXPECT_EQ(parseNumber("1e-3"), 1e-3);
  EXPECT_EQ(parseNumber("+2"), 2.0);
  EXPECT_FALSE(parseNumber("1,5"));
  EXPECT_FALSE(parseNumber("1x"));
  EXPECT_FALSE(parseNumber(""));
  EXPECT_FALSE(parseNumber("++1"));
  EXPECT_TRUE(std::isnan(*parseNumber("nan")));
  EXPECT_THAT(*parseNumbers(" 1 2,3\n"), ::testing::ElementsAre(1, 2, 3));
  EXPECT_FALSE(parseNumbers("1 two"));
  EXPECT_EQ(parseNumber(formatNumber(0.1)), 0.1);
}

TEST(Pose, RoundTripAndRefusals) {
  const Pose pose = parsePose("0.1 -2 3e-3 0 0 2 2", "--pose");
  EXPECT_NEAR(pose.linear().determinant(), 1.0, 1e-12);
  const Pose again = parsePose(formatPose(pose), "--pose");
  EXPECT_TRUE(again.isApprox(pose, 1e-12));
  EXPECT_THROW(parsePose("0 0 0 0 0 0 0", "--pose"), InputError);
  EXPECT_THROW(parsePose("0 0 0 0 0 1", "--pose"), InputError);
  EXPECT_THROW(parsePose("nan 0 0 0 0 0 1", "--pose"), InputError);
}

TEST_F(FileIo, WritesWholeFilesAndKeepsThePreviousOne) {
  const fs::path path = folder_ / "lens.yaml";
  writeFileAtomically(path, "one", Previous::kKeep);
  EXPECT_EQ(entries(), 1u);
  writeFileAtomically(path, "two", Previous::kKeep);
  EXPECT_EQ(readFile(path), "two");
  EXPECT_EQ(readFile(path.string() + "~"), "one");
  writeFileAtomically(path, "three", Previous::kKeep);
  EXPECT_EQ(readFile(path.string() + "~"), "two");
  EXPECT_EQ(entries(), 2u);
}

TEST_F(FileIo, AFailedWriteLeavesNothingAndHarmsNothing) {
  EXPECT_THROW(writeFileAtomically(folder_ / "absent" / "file", "x"), IoError);
  fs::create_directory(folder_ / "sub");
  EXPECT_THROW(writeFileAtomically(folder_ / "sub", "x"), IoError);
  EXPECT_EQ(entries(), 1u);
  EXPECT_THROW(readFile(folder_ / "sub"), Error);
  EXPECT_THROW(readFile(folder_ / "absent"), IoError);
}

TEST_F(FileIo, FollowsALinkAndKeepsTheMode) {
  writeFileAtomically(folder_ / "real", "1");
  ::chmod((folder_ / "real").c_str(), 0600);
  fs::create_symlink("real", folder_ / "link");
  writeFileAtomically(folder_ / "link", "2");
  EXPECT_TRUE(fs::is_symlink(folder_ / "link"));
  EXPECT_EQ(readFile(folder_ / "real"), "2");
  EXPECT_EQ(fs::status(folder_ / "real").permissions(), fs::perms(0600));
}

TEST_F(FileIo, AnAtomicFileThatIsNotCommittedVanishes) {
  {
    AtomicFile file(folder_ / "image.tiff");
    file.write("half");
  }
  EXPECT_EQ(entries(), 0u);
}

TEST_F(FileIo, DevicesAndPipesAreWrittenToAndNotReplaced) {
  writeFileAtomically("/dev/null", "gone");
  EXPECT_THROW(writeFileAtomically("/dev/full", "no room"), IoError);
  for (const char* device : {"/dev/null", "/dev/full"})
    EXPECT_EQ(fs::status(device).type(), fs::file_type::character) << device;
  const fs::path pipe = folder_ / "pipe";
  ASSERT_EQ(::mkfifo(pipe.c_str(), 0600), 0);
  EXPECT_THROW(writeFileAtomically(pipe, "nobody reads"), IoError);
  EXPECT_THROW(readFile(pipe), InputError);
  const int reader = ::open(pipe.c_str(), O_RDONLY | O_NONBLOCK);
  writeFileAtomically(pipe, "read");
  char buffer[8] = {};
  EXPECT_EQ(::read(reader, buffer, sizeof buffer), 4);
  ::close(reader);
  EXPECT_STREQ(buffer, "read");
  EXPECT_EQ(fs::status(pipe).type(), fs::file_type::fifo);
  EXPECT_EQ(entries(), 1u);
}

TEST_F(FileIo, ANewFileReplacesNone) {
  AtomicFile first(folder_ / "file"), second(folder_ / "file");
  first.write("first");
  second.write("second");
  EXPECT_TRUE(first.commitNew());
  EXPECT_FALSE(second.commitNew());
  EXPECT_EQ(readFile(folder_ / "file"), "first");
  second.commit();
  EXPECT_EQ(readFile(folder_ / "file"), "second");
  EXPECT_EQ(entries(), 1u);
}

TEST(ParallelFor, VisitsEveryIndexOnce) {
  for (int threads : {0, 1, 3}) {
    std::vector<int> visits(1000, 0);
    parallelFor(0, visits.size(), threads, [&](std::size_t i) { ++visits[i]; });
    EXPECT_THAT(visits, ::testing::Each(1));
  }
}

}  // namespace
}  // namespace omnister
