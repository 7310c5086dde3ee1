// SPDX-License-Identifier: Apache-2.0
// Files are there whole or not at all: writers that are killed at any byte and at any moment, full
// disks, folders that may not be written to, two writers at once.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <sched.h>
#include <sys/mount.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <csignal>
#include <cstring>
#include <filesystem>
#include <functional>
#include <random>
#include <set>
#include <thread>

#include "omnister/calibration/detections.h"
#include "omnister/calibration/rig_file.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/image_file.h"
#include "omnister/lens/lens_models.h"
#include "omnister/lens/lens_store.h"
#include "omnister/stereo/cloud.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;

LensFile lens(int which) {
  LensFile file;
  file.image_size = {8, 6};
  LensStructure structure;
  structure.model = "conic";
  file.lens = makeLens(structure, Eigen::Vector2d(3.5, 2.5), 4.0 + which, 1.2);
  return file;
}

Cloud cloud(int which) {
  const cv::Size size(40, 30);
  return {cv::Mat(size, CV_32FC3, cv::Scalar::all(1 + which)),
          cv::Mat(size, CV_8UC3, cv::Scalar::all(9)), cv::Mat(size, CV_32FC1, cv::Scalar::all(1)),
          cv::Mat(size, CV_32FC1, cv::Scalar::all(1))};
}

/// Something that writes one of two contents under a name.
struct Writer {
  const char* name;
  std::function<void(const fs::path&, int which)> write;
};

void PrintTo(const Writer& writer, std::ostream* out) { *out << writer.name; }

const Writer kWriters[] = {
    {"lens.yaml", [](const fs::path& path, int which) { writeLensFile(path, lens(which)); }},
    {"cloud.ply", [](const fs::path& path, int which) { writeCloud(path, cloud(which)); }},
    {"cloud.pcd", [](const fs::path& path, int which) { writeCloud(path, cloud(which)); }},
    {"range.tiff",
     [](const fs::path& path, int which) {
       writeRange(path, cv::Mat(30, 40, CV_32FC1, cv::Scalar(1 + which)));
     }},
    {"image.png", [](const fs::path& path,
                     int which) { writeImage(path, cv::Mat(30, 40, CV_8UC1, cv::Scalar(which))); }},
    {"rig.yaml",
     [](const fs::path& path, int which) {
       RigFile rig;
       rig.reference = path.parent_path() / "left.yaml";
       rig.displaced = path.parent_path() / "right.yaml";
       rig.T_ref_disp.translation().x() = 0.1 + which;
       writeRigFile(path, rig);
     }},
    {"report.html",
     [](const fs::path& path, int which) {
       writeFileAtomically(path, std::string(5000, which == 0 ? 'a' : 'b'));
     }},
};

/// Runs `work` in a process of its own. @return its status as waitpid() tells it
int inChild(const std::function<int()>& work) {
  const pid_t id = ::fork();
  if (id == 0) ::_exit(work());
  int status = -1;
  ::waitpid(id, &status, 0);
  return status;
}

/// 0 when `write` says why it cannot.
int expectIoError(const std::function<void()>& write) {
  try {
    write();
    return 1;
  } catch (const IoError&) {
    return 0;
  } catch (...) {
    return 2;
  }
}

class NothingLost : public testing::TestWithParam<Writer> {
 protected:
  void SetUp() override {
    for (int which : {0, 1}) {
      GetParam().write(path_, which);
      contents_[which] = readFile(path_);
    }
    ASSERT_NE(contents_[0], contents_[1]);
    GetParam().write(path_, 0);
    names_ = names();
  }
  std::set<std::string> names() const {
    std::set<std::string> result;
    for (const auto& entry : fs::directory_iterator(folder_.path()))
      result.insert(entry.path().filename());
    return result;
  }

  test::TemporaryFolder folder_;
  const fs::path path_ = folder_.path() / GetParam().name;
  std::string contents_[2];
  std::set<std::string> names_;
};

// The system kills a writer at the byte where its file would become too long.
TEST_P(NothingLost, KilledAtAnyByte) {
  const std::size_t size = contents_[1].size();
  int killed = 0, refused = 0;
  for (std::size_t limit = 0; limit < size; limit += 1 + size / 40) {
    for (const bool survives : {false, true}) {
      const int status = inChild([&] {
        const rlimit bytes{limit, limit};
        ::setrlimit(RLIMIT_FSIZE, &bytes);
        const rlimit none{0, 0};
        ::setrlimit(RLIMIT_CORE, &none);
        std::signal(SIGXFSZ, survives ? SIG_IGN : SIG_DFL);
        return expectIoError([&] { GetParam().write(path_, 1); });
      });
      killed += WIFSIGNALED(status) && WTERMSIG(status) == SIGXFSZ;
      refused += WIFEXITED(status) && WEXITSTATUS(status) == 0;
      ASSERT_EQ(readFile(path_), contents_[0]) << limit;
      ASSERT_EQ(names(), names_) << limit;
    }
  }
  EXPECT_GE(killed, 20);
  EXPECT_EQ(refused, killed);
}

TEST_P(NothingLost, KilledAtAnyMoment) {
  std::mt19937 random(3);
  for (int round = 0; round < 40; ++round) {
    const pid_t id = ::fork();
    if (id == 0) {
      for (int i = 1;; ++i) GetParam().write(path_, i % 2);
    }
    std::this_thread::sleep_for(std::chrono::microseconds(random() % 5000));
    ::kill(id, SIGKILL);
    ::waitpid(id, nullptr, 0);
    const std::string content = readFile(path_);
    ASSERT_TRUE(content == contents_[0] || content == contents_[1]) << round;
  }
  // What may stay behind by a kill between two names is whole, too.
  for (const std::string& name : names()) {
    const std::string content = readFile(folder_.path() / name);
    EXPECT_TRUE(content == contents_[0] || content == contents_[1]) << name;
  }
}

TEST_P(NothingLost, TwoWritersAtOnce) {
  const auto write = [&](int which) {
    for (int i = 0; i < 30; ++i) GetParam().write(path_, which);
  };
  std::thread one(write, 0), other(write, 1);
  for (int i = 0; i < 200; ++i) {
    const std::string content = readFile(path_);
    EXPECT_TRUE(content == contents_[0] || content == contents_[1]);
  }
  one.join();
  other.join();
  EXPECT_EQ(names(), names_);
}

// Left out where a process may have no file systems of its own.
TEST_P(NothingLost, FullDisksAndFoldersThatMayNotBeWrittenTo) {
  constexpr int kNoMounts = 77;
  const fs::path disk = folder_.path() / "disk";
  fs::create_directory(disk);
  const int status = inChild([&]() -> int {
    if ((::geteuid() != 0 && ::unshare(CLONE_NEWUSER) != 0) || ::unshare(CLONE_NEWNS) != 0 ||
        ::mount("none", "/", nullptr, MS_REC | MS_PRIVATE, nullptr) != 0 ||
        ::mount("none", disk.c_str(), "tmpfs", 0, "size=64k") != 0) {
      return kNoMounts;
    }
    const fs::path path = disk / GetParam().name;
    GetParam().write(path, 0);
    const auto unharmed = [&](std::size_t entries) {
      return readFile(path) == contents_[0] &&
             entries == static_cast<std::size_t>(
                            std::distance(fs::directory_iterator(disk), fs::directory_iterator()));
    };
    // Fill the disk page by page.
    int full = ::open((disk / "filler").c_str(), O_WRONLY | O_CREAT, 0600);
    const std::string page(4096, 'x');
    while (::write(full, page.data(), page.size()) > 0) continue;
    ::close(full);
    if (expectIoError([&] { GetParam().write(path, 1); }) != 0) return 10;
    if (!unharmed(2)) return 11;
    fs::remove(disk / "filler");
    if (::mount("none", disk.c_str(), nullptr, MS_REMOUNT | MS_RDONLY, nullptr) != 0) return 12;
    if (expectIoError([&] { GetParam().write(path, 1); }) != 0) return 13;
    if (!unharmed(1)) return 14;
    return 0;
  });
  ASSERT_TRUE(WIFEXITED(status));
  if (WEXITSTATUS(status) == kNoMounts) GTEST_SKIP() << "no mounts of its own for this user";
  EXPECT_EQ(WEXITSTATUS(status), 0);
}

INSTANTIATE_TEST_SUITE_P(Files, NothingLost, testing::ValuesIn(kWriters), [](const auto& info) {
  std::string name = info.param.name;
  for (char& c : name)
    if (c == '.') c = '_';
  return name;
});

// A store is several files: at any moment its current lens is whole, and none that was there is
// lost.
TEST(NothingLostOfAStore, KilledAtAnyMoment) {
  const test::TemporaryFolder folder;
  const LensStore store(folder.path());
  store.save("wide", lens(0));
  std::mt19937 random(3);
  for (int round = 0; round < 40; ++round) {
    const pid_t id = ::fork();
    if (id == 0) {
      for (int i = 1;; ++i) store.save("wide", lens(20 * round + i % 15));
    }
    std::this_thread::sleep_for(std::chrono::microseconds(random() % 10000));
    ::kill(id, SIGKILL);
    ::waitpid(id, nullptr, 0);
    int current = 0;
    for (const StoredLens& stored : store.versions("wide")) {
      EXPECT_TRUE(stored.file) << stored.problem;
      current += stored.current;
    }
    ASSERT_EQ(current, 1) << round;
  }
  EXPECT_NO_THROW(store.save("wide", lens(999)));
}

}  // namespace
}  // namespace omnister
