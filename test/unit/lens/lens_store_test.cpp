// SPDX-License-Identifier: Apache-2.0
#include "omnister/lens/lens_store.h"

#include <gmock/gmock.h>

#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>
#include <thread>

#include "command_run.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/lens/lens_models.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;
using testing::ElementsAre;
using testing::HasSubstr;

class LensStoreTest : public testing::Test {
 protected:
  /// A lens that is told from others by its scale.
  static LensFile lens(double scale) {
    LensFile file;
    file.image_size = {8, 6};
    LensStructure structure;
    structure.model = "conic";
    file.lens = makeLens(structure, Eigen::Vector2d(3.5, 2.5), scale, 1.2);
    return file;
  }
  std::string formatted(double scale) const { return formatLensFile(lens(scale)); }
  std::string current() const { return readFile(store_.pathOf("wide")); }
  std::vector<int> versions() const {
    std::vector<int> numbers;
    for (const StoredLens& stored : store_.versions("wide")) numbers.push_back(stored.version);
    return numbers;
  }
  int currentVersion() const {
    for (const StoredLens& stored : store_.versions("wide"))
      if (stored.current) return stored.version;
    return -1;
  }

  test::TemporaryFolder folder_;
  const LensStore store_{folder_.path() / "store"};
};

TEST_F(LensStoreTest, NeverLeavesItsFolder) {
  for (const char* name : {"..", "../x", "a/b", "/etc/passwd", "", ".hidden", "a b", "a\nb"}) {
    EXPECT_THROW(store_.save(name, lens(4)), InputError) << name;
    EXPECT_THROW(store_.load(name), InputError) << name;
    EXPECT_THROW(store_.versions(name), InputError) << name;
    EXPECT_THROW(store_.rollBack(name, 1), InputError) << name;
  }
  EXPECT_EQ(store_.load("none"), std::nullopt);
  store_.save("a-1", lens(4));
  store_.save("a-1", lens(5));
  EXPECT_TRUE(store_.load("a-1"));
  EXPECT_TRUE(fs::exists(store_.folder() / "a-1.yaml~"));
  const fs::path outside = folder_.path() / "outside";
  fs::create_directory(outside);
  fs::create_symlink(outside / "lens.yaml", store_.folder() / "link.yaml");
  fs::create_symlink(outside, store_.folder() / "folder.versions");
  EXPECT_THROW(store_.save("link", lens(4)), InputError);
  EXPECT_THROW(store_.load("link"), InputError);
  EXPECT_THROW(store_.save("folder", lens(4)), InputError);
  EXPECT_THROW(store_.versions("folder"), InputError);
  EXPECT_TRUE(fs::is_empty(outside));
  EXPECT_EQ(LensStore::nameFrom("Basler (A/1)"), "Basler__A_1_");
  EXPECT_NO_THROW(store_.pathOf(LensStore::nameFrom("../../x")));
  EXPECT_NO_THROW(store_.pathOf(LensStore::nameFrom("")));
}

TEST_F(LensStoreTest, KeepsVersionsAndGoesBackThroughThem) {
  for (const double scale : {4, 5, 6}) store_.save("wide", lens(scale));
  EXPECT_THAT(versions(), ElementsAre(3, 2, 1));
  EXPECT_EQ(currentVersion(), 3);
  EXPECT_EQ(store_.rollBack("wide", std::nullopt).version, 2);
  EXPECT_EQ(current(), formatted(5));
  EXPECT_EQ(store_.rollBack("wide", std::nullopt).version, 1);
  EXPECT_EQ(current(), formatted(4));
  EXPECT_THROW(store_.rollBack("wide", std::nullopt), InputError);
  EXPECT_THROW(store_.rollBack("wide", 4), InputError);
  EXPECT_EQ(current(), formatted(4));
  EXPECT_EQ(store_.rollBack("wide", 3).version, 3);
  EXPECT_EQ(current(), formatted(6));
  EXPECT_THAT(versions(), ElementsAre(3, 2, 1));
  // What is saved again is no further version.
  store_.save("wide", lens(6));
  EXPECT_THAT(versions(), ElementsAre(3, 2, 1));
}

TEST_F(LensStoreTest, KeepsWhatWasPutThereByHand) {
  fs::create_directories(store_.folder());
  std::ofstream(store_.pathOf("wide")) << formatted(4);
  EXPECT_THAT(versions(), ElementsAre(0));
  store_.save("wide", lens(5));
  EXPECT_THAT(versions(), ElementsAre(2, 1));
  store_.rollBack("wide", std::nullopt);
  EXPECT_EQ(current(), formatted(4));
  // What does not belong there is passed over.
  for (const char* name :
       {"notes.txt", "01.yaml", "0.yaml", "-1.yaml", "9999999999.yaml", "x.yaml"})
    std::ofstream(store_.folder() / "wide.versions" / name) << "?";
  EXPECT_THAT(versions(), ElementsAre(2, 1));
}

TEST_F(LensStoreTest, GoesBackOverBrokenVersions) {
  for (const double scale : {4, 5, 6}) store_.save("wide", lens(scale));
  std::ofstream(store_.folder() / "wide.versions" / "2.yaml") << "lens_surface: {";
  std::ofstream(store_.pathOf("wide")) << std::string(1000, '\0');
  EXPECT_THROW(store_.load("wide"), InputError);
  const std::vector<StoredLens> all = store_.versions("wide");
  ASSERT_EQ(all.size(), 4u);
  EXPECT_TRUE(all[0].current);
  EXPECT_FALSE(all[0].file);
  EXPECT_THAT(describe(all[2]), HasSubstr("cannot be read"));
  EXPECT_THROW(store_.rollBack("wide", 2), InputError);
  EXPECT_EQ(store_.rollBack("wide", std::nullopt).version, 3);
  EXPECT_EQ(current(), formatted(6));
  EXPECT_EQ(store_.rollBack("wide", std::nullopt).version, 1);
  // The broken one that stood there is kept, too.
  EXPECT_THAT(versions(), ElementsAre(4, 3, 2, 1));
  fs::remove(store_.pathOf("wide"));
  EXPECT_EQ(store_.rollBack("wide", std::nullopt).version, 3);
}

TEST_F(LensStoreTest, DropsTheOldestButNotTheCurrentOne) {
  for (int i = 0; i < 25; ++i) store_.save("wide", lens(4.0 + i));
  EXPECT_EQ(versions().size(), LensStore::kMaxVersions);
  EXPECT_EQ(versions().front(), 25);
  EXPECT_EQ(versions().back(), 6);
}

TEST_F(LensStoreTest, GoesOnWhereTheNumbersEnd) {
  store_.save("wide", lens(10));
  const fs::path folder = store_.folder() / "wide.versions";
  for (const char* name : {"999999999.yaml", "999999998.yaml", "1000000000.yaml", "-1.yaml"})
    writeFileAtomically(folder / name, "no lens");
  for (const double scale : {11, 12}) {
    store_.save("wide", lens(scale));
    EXPECT_EQ(current(), formatted(scale));
  }
  EXPECT_THAT(versions(), ElementsAre(999999999, 999999998, 999999997, 999999996, 1));
  store_.rollBack("wide", 999999997);
  EXPECT_EQ(current(), formatted(11));
}

TEST_F(LensStoreTest, TwoWritersAtOnceLoseNothing) {
  std::vector<std::thread> writers;
  for (int writer = 0; writer < 2; ++writer)
    writers.emplace_back([&, writer] {
      for (int i = 0; i < 8; ++i) store_.save("wide", lens(4.0 + i + 100.0 * writer));
    });
  for (std::thread& writer : writers) writer.join();
  std::size_t good = 0;
  for (const StoredLens& stored : store_.versions("wide")) good += stored.file.has_value();
  EXPECT_EQ(good, 16u);
  EXPECT_GT(currentVersion(), 0);
  // Nothing else lies about.
  EXPECT_EQ(std::distance(fs::directory_iterator(store_.folder()), fs::directory_iterator()), 3);
}

TEST_F(LensStoreTest, TheCommandListsAndRollsBack) {
  const std::string folder = store_.folder().string();
  EXPECT_EQ(test::run({"store", "list", "--store", folder}).code, 0);
  EXPECT_EQ(test::run({"store", "list", "wide", "--store", folder}).code, 1);
  for (const double scale : {4, 5}) store_.save("wide", lens(scale));
  const test::Outcome list = test::run({"store", "list", "--store", folder, "--json"});
  ASSERT_EQ(list.code, 0) << list.err;
  const auto json = nlohmann::json::parse(list.out);
  ASSERT_EQ(json.at("wide").size(), 2u);
  EXPECT_EQ(json.at("wide")[0].at("version"), 2);
  EXPECT_EQ(json.at("wide")[0].at("current"), true);
  EXPECT_EQ(test::run({"store", "list", "--store", folder}).lines().size(), 2u);
  const test::Outcome back = test::run({"store", "rollback", "wide", "--store", folder, "--json"});
  ASSERT_EQ(back.code, 0) << back.err;
  EXPECT_EQ(nlohmann::json::parse(back.out).at("version"), 1);
  EXPECT_EQ(current(), formatted(4));
  EXPECT_EQ(test::run({"store", "rollback", "wide", "--store", folder}).code, 1);
  EXPECT_EQ(test::run({"store", "rollback", "../wide", "--store", folder}).code, 1);
  EXPECT_EQ(test::run({"store", "rollback"}).code, 2);
}

}  // namespace
}  // namespace omnister
