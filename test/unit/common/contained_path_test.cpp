// SPDX-License-Identifier: Apache-2.0
#include "omnister/common/contained_path.h"

#include <gmock/gmock.h>

#include "omnister/common/error.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;
using testing::ThrowsMessage;

TEST(PlainName, IsOfFewCharactersAndNotHidden) {
  for (const char* name : {"a", "scan_1", "Cam-2.yaml", "7"})
    EXPECT_TRUE(isPlainName(name)) << name;
  for (const std::string& name :
       {std::string(), std::string("."), std::string(".."), std::string(".ssh"), std::string("a/b"),
        std::string("a b"), std::string("a\0b", 3), std::string("$(id)"), std::string("ü"),
        std::string(101, 'a')})
    EXPECT_FALSE(isPlainName(name)) << name;
}

TEST(PathInside, StaysInItsFolder) {
  const test::TemporaryFolder folder;
  const fs::path root = folder.path() / "root";
  EXPECT_EQ(pathInside(root, "scan_1", "goal", "folder"), root / "scan_1");
  EXPECT_TRUE(fs::is_directory(root)) << "it is made";
  EXPECT_EQ(pathInside(root, "a/b/", "goal", "folder"), root / "a" / "b");
  EXPECT_EQ(pathInside(root, root / "a", "goal", "folder"), root / "a");
  EXPECT_FALSE(fs::exists(root / "a"));
  int refused = 0;
  for (const fs::path& wanted :
       {fs::path(""), fs::path("."), fs::path(".."), fs::path("../root2"), fs::path("a/../../b"),
        fs::path("/etc"), root, root.parent_path(), root / ".." / "b",
        fs::path(root.string() + "2/a"), fs::path("a/./b"), fs::path(".hidden"), fs::path("a b"),
        fs::path("a;b")}) {
    EXPECT_THAT([&] { pathInside(root, wanted, "goal", "folder"); },
                ThrowsMessage<InputError>(HasSubstr("folder")))
        << wanted;
    ++refused;
  }
  EXPECT_EQ(refused, 14);
}

TEST(PathInside, FollowsNoLinks) {
  const test::TemporaryFolder folder;
  const fs::path root = folder.path() / "root", outside = folder.path() / "outside";
  fs::create_directories(root);
  fs::create_directories(outside);
  fs::create_directory_symlink(outside, root / "way_out");
  fs::create_symlink(folder.path() / "nowhere", root / "dangling");
  for (const char* wanted : {"way_out", "way_out/a", "dangling"}) {
    EXPECT_THAT([&] { pathInside(root, wanted, "goal", "folder"); },
                ThrowsMessage<InputError>(HasSubstr("link")))
        << wanted;
  }
}

TEST(PathInside, AFolderThatCannotBeMadeIsAnErrorOfTheFileSystem) {
  EXPECT_THROW(pathInside("/proc/omnister", "a", "goal", "folder"), IoError);
}

}  // namespace
}  // namespace omnister
