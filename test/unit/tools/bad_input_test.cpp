// SPDX-License-Identifier: Apache-2.0
// Every command given broken files in the place of each of its files, nonsense for each of its
// numbers, and places that cannot be written: one clear line, the exit code, and nothing half
// written.
#include <fcntl.h>
#include <gmock/gmock.h>
#include <sys/stat.h>

#include <cstring>
#include <filesystem>
#include <fstream>
#include <map>
#include <opencv2/imgcodecs.hpp>
#include <random>
#include <set>
#include <streambuf>

#include "command_run.h"
#include "full_tests.h"
#include "omnister/common/file_io.h"
#include "omnister/common/pose.h"
#include "omnister/lens/lens_file.h"
#include "omnister/lens/lens_models.h"
#include "omnister/stereo/cloud.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;
using testing::StartsWith;
using Arguments = std::vector<std::string>;

constexpr char kPose[] = "-0.3 0 0 0 0 0 1";

/// Boards before the camera, tilted to all sides.
constexpr const char* kBoards[] = {
    "0 0 0.2 0.3 0 0 1",     "0.05 0 0.2 -0.3 0.1 0 1",      "0 0.05 0.2 0 0.3 0 1",
    "-0.1 0 0.2 0 -0.3 0 1", "0 -0.05 0.25 0.25 0.25 0.2 1", "0.1 0 0.25 -0.2 0.3 0.5 1"};

/// A command that works, in which one argument is the file `kind`.
struct Use {
  const char* kind;  ///< name of the good file that is replaced
  Arguments arguments;
};

/// What a command may write; none of it may be there after a refusal.
const char* const kOutputs[] = {"out.yaml",  "out.png",    "out.tiff",     "out.ply",
                                "left.yaml", "right.yaml", "rig_out.yaml", "camchain.yaml"};

const std::vector<Use>& uses() {
  static const std::vector<Use> kUses = {
      {"lens.yaml", {"project", "--lens", "lens.yaml"}},
      {"lens.yaml", {"unproject", "--lens", "lens.yaml"}},
      {"lens.yaml", {"export", "lens.yaml", "--format", "kalibr", "--out", "camchain.yaml"}},
      {"lens.yaml",
       {"render", "--lens", "lens.yaml", "--scene", "scene.yaml", "--out", "out.png", "--range",
        "out.tiff", "--supersampling", "1"}},
      {"scene.yaml",
       {"render", "--lens", "lens.yaml", "--scene", "scene.yaml", "--out", "out.png",
        "--supersampling", "1"}},
      {"lens.yaml", {"dewarp", "--lens", "lens.yaml", "--size", "20x10", "image.png", "out.png"}},
      {"image.png", {"dewarp", "--lens", "lens.yaml", "--size", "20x10", "image.png", "out.png"}},
      {"lens.yaml",
       {"stereo", "--lens", "lens.yaml", "--reference", "image.png", "--displaced", "image.png",
        "--pose", kPose, "--cloud", "out.ply"}},
      {"displaced.png",
       {"stereo", "--lens", "lens.yaml", "--reference", "image.png", "--displaced", "displaced.png",
        "--pose", kPose, "--cloud", "out.ply", "--range", "out.tiff"}},
      {"mask.png",
       {"stereo", "--lens", "lens.yaml", "--reference", "image.png", "--displaced", "image.png",
        "--pose", kPose, "--cloud", "out.ply", "--mask", "mask.png"}},
      {"prior.tiff",
       {"stereo", "--lens", "lens.yaml", "--reference", "image.png", "--displaced", "image.png",
        "--pose", kPose, "--cloud", "out.ply", "--prior", "prior.tiff"}},
      {"corners.csv",
       {"calibrate", "--detections", "corners.csv", "--size", "64x48", "--model", "quadric",
        "--out", "out.yaml"}},
      {"positions.csv",
       {"calibrate", "--detections", "corners.csv", "--size", "64x48", "--model", "quadric",
        "--positions", "positions.csv", "--out", "out.yaml"}},
      {"target.yaml", {"calibrate", "--target", "target.yaml", "image.png", "--out", "out.yaml"}},
      {"image.png", {"calibrate", "--target", "target.yaml", "image.png", "--out", "out.yaml"}},
      {"corners.csv",
       {"calibrate-stereo", "--left-detections", "corners.csv", "--right-detections", "right.csv",
        "--size", "64x48", "--model", "quadric", "--out-left", "left.yaml", "--out-right",
        "right.yaml", "--out-rig", "rig_out.yaml"}},
      {"scan/replay.yaml", {"calibrate-scan", "scan", "--out", "out.yaml"}},
      {"lens.yaml", {"evaluate", "board", "--lens", "lens.yaml", "--detections", "corners.csv"}},
      {"corners.csv", {"evaluate", "board", "--lens", "lens.yaml", "--detections", "corners.csv"}},
      {"image.png",
       {"evaluate", "pair", "--lens", "lens.yaml", "--reference", "image.png", "--displaced",
        "displaced.png", "--pose", kPose}},
      {"cloud.ply", {"evaluate", "plane", "--cloud", "cloud.ply"}},
      {"camera_info.yaml", {"import", "camera_info.yaml", "--out", "out.yaml"}},
      {"kalibr.yaml", {"import", "kalibr.yaml", "--out", "out.yaml"}},
      {"ocam.txt", {"import", "ocam.txt", "--out", "out.yaml"}},
      {"camera.cameramodel", {"import", "camera.cameramodel", "--out", "out.yaml"}},
  };
  return kUses;
}

class BadInput : public testing::Test {
 protected:
  void SetUp() override {
    before_ = fs::current_path();
    fs::current_path(folder_.path());
    LensFile lens;
    lens.image_size = {64, 48};
    lens.lens = makeLens(LensStructure{}, {31.2, 23.9}, 27.0, 1.2);
    writeLensFile("lens.yaml", lens);
    std::mt19937 random(1);
    cv::Mat image(48, 64, CV_8UC1);
    for (int i = 0; i < image.rows * image.cols; ++i) image.data[i] = static_cast<uchar>(random());
    for (const char* name : {"image.png", "displaced.png", "mask.png"}) cv::imwrite(name, image);
    writeRange("prior.tiff", cv::Mat(48, 64, CV_32FC1, cv::Scalar(2.0)));
    const cv::Mat ones(48, 64, CV_32FC1, cv::Scalar(1));
    Cloud plane{cv::Mat(48, 64, CV_32FC3), cv::Mat(48, 64, CV_8UC3, cv::Scalar::all(7)), ones,
                ones};
    for (int v = 0; v < 48; ++v) {
      for (int u = 0; u < 64; ++u) {
        plane.xyz.at<cv::Vec3f>(v, u) = {0.05f * static_cast<float>(u - 32),
                                         0.05f * static_cast<float>(v - 24), 2};
      }
    }
    writeCloud("cloud.ply", plane);
    const fs::path source(OMNISTER_SOURCE_DIR);
    fs::copy(source / "config/scenes/plane.yaml", "scene.yaml");
    fs::copy(source / "config/demo/target.yaml", "target.yaml");
    const fs::path foreign = source / "test/fuzz/corpus/foreign_camera";
    fs::copy(foreign / "plumb_bob.yaml", "camera_info.yaml");
    fs::copy(foreign / "kalibr_equidistant.yaml", "kalibr.yaml");
    fs::copy(foreign / "ocam.txt", "ocam.txt");
    fs::copy(foreign / "mrcal.cameramodel", "camera.cameramodel");
    std::ofstream corners("corners.csv");
    corners << "view,u_px,v_px,x_m,y_m,z_m\n";
    std::ofstream right_corners("right.csv");
    right_corners << "view,u_px,v_px,x_m,y_m,z_m\n";
    std::ofstream positions("positions.csv");
    positions << "view,position_m\n";
    for (int view = 0; view < 6; ++view) {
      positions << "v" << view << "," << 0.05 * view << "\n";
      const Pose board = parsePose(kBoards[view], "board");
      for (int i = 0; i < 35; ++i) {
        const double x = 0.05 * (i % 7 - 3), y = 0.05 * (i / 7 - 2);
        // The right camera stands 2 cm to the right of the left one.
        for (const bool right : {false, true}) {
          const Eigen::Vector3d place = board * Eigen::Vector3d(x, y, 0.0);
          const auto pixel = lens.lens->project(place - Eigen::Vector3d(right ? 0.02 : 0.0, 0, 0));
          if (!pixel || !(pixel->array() > 0).all() || pixel->x() >= 63 || pixel->y() >= 47) {
            continue;
          }
          (right ? right_corners : corners) << "v" << view << "," << pixel->x() << "," << pixel->y()
                                            << "," << x << "," << y << ",0\n";
        }
      }
    }
    fs::create_directory("scan");
    std::ofstream scan("scan/replay.yaml");
    scan << "version: 1\nrate: 10\nframes:\n";
    for (int i = 0; i < 3; ++i) {
      fs::copy("image.png", "scan/" + std::to_string(i) + ".png");
      scan << "  - {image: " << i << ".png, stage_position_m: " << 0.1 * i << "}\n";
    }
  }
  void TearDown() override { fs::current_path(before_); }

  static void put(const fs::path& path, const std::string& bytes) {
    std::ofstream(path, std::ios::binary) << bytes;
  }

  /// Whether taken or refused, it is done properly. @return whether it was taken
  static bool decent(const Arguments& arguments, const std::string& what) {
    SCOPED_TRACE(testing::PrintToString(arguments) + " with " + what);
    const test::Outcome outcome = test::run(arguments);
    EXPECT_TRUE(outcome.code >= 0 && outcome.code <= 2) << outcome.code;
    if (outcome.code == 0) return true;
    // The last line is the message; remarks and progress may come before it.
    const std::string err = outcome.err.substr(0, outcome.err.find_last_not_of('\n') + 1);
    const std::string message = err.substr(err.find_last_of('\n') + 1);
    if (outcome.code == 1) {
      EXPECT_THAT(message, StartsWith("omnister: "));
    }
    EXPECT_NE(err, "");
    EXPECT_EQ(outcome.out, "");
    EXPECT_LE(message.size(), 1100u);
    for (const char c : err) EXPECT_FALSE(c != '\n' && static_cast<unsigned char>(c) < 0x20) << err;
    for (const char* output : kOutputs) {
      EXPECT_FALSE(fs::exists(output)) << output << " after " << err;
      fs::remove(output);
    }
    for (const auto& entry : fs::directory_iterator("."))
      EXPECT_NE(entry.path().filename().string()[0], '.') << entry.path();
    return false;
  }

  static void removeOutputs() {
    for (const char* output : kOutputs) {
      fs::remove(output);
      fs::remove(std::string(output) + "~");
    }
  }

  test::TemporaryFolder folder_;
  fs::path before_;
};

std::string repeated(const std::string& text, int count) {
  std::string all;
  for (int i = 0; i < count; ++i) all += text;
  return all;
}

std::string noise(std::size_t bytes) {
  std::mt19937 random(7);
  std::string text(bytes, '\0');
  for (char& c : text) c = static_cast<char>(random());
  return text;
}

/// Contents that are no file of any kind.
std::map<std::string, std::string> nonsense() {
  std::string aliases = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n";
  for (int i = 1; i < 12; ++i) {
    const std::string before = "*a" + std::to_string(i - 1);
    aliases += "a" + std::to_string(i) + ": &a" + std::to_string(i) + " [" +
               repeated(before + ", ", 9) + before + "]\n";
  }
  return {{"nothing", ""},
          {"a line feed", "\n"},
          {"a zero byte", std::string(1, '\0')},
          {"zeros", std::string(5000, '\0')},
          {"noise", noise(5000)},
          {"a byte order mark", "\xEF\xBB\xBF"},
          {"UTF-16", std::string("\xFF\xFEl\0e\0n\0s\0:\0 \0"
                                 "1\0",
                                 16)},
          {"broken UTF-8", "lens: \xC3\x28\xFF\n"},
          {"control characters", "lens: \x1b[31mred\x07\n"},
          {"words", "this is not the file you are looking for\n"},
          {"one endless line", std::string(1 << 20, 'a')},
          {"a million lines", repeated("\n", 1000000)},
          {"deep lists", std::string(100000, '[')},
          {"deep maps", repeated("{a: ", 20000)},
          {"deep blocks", repeated("- ", 20000)},
          {"deep JSON", repeated("{\"a\":", 20000)},
          {"aliases of aliases", aliases},
          {"an alias of itself", "a: &a [*a]\n"},
          {"an unknown alias", "a: *b\n"},
          {"a tag", "!!python/object:os.system [ls]\n"},
          {"many documents", repeated("---\na: 1\n", 1000)},
          {"a list", "[1, 2, 3]\n"},
          {"a comma", ","},
          {"a number", "1e999\n"},
          {"null", "~\n"},
          {"tabs", "a:\n\t- b\n"},
          {"markup", "<?xml version=\"1.0\"?><lens/>\n"},
          {"a PNG's beginning", std::string("\x89PNG\r\n\x1a\n\0\0\0\rIHDR", 16)},
          {"a JPEG's beginning", std::string("\xFF\xD8\xFF\xE0\0\x10JFIF", 10)},
          {"a TIFF's beginning", std::string("II*\0\x08\0\0\0\xFF\xFF", 10)},
          {"a TIFF that points at itself", std::string("II*\0\x08\0\0\0\0\0\x08\0\0\0", 14)},
          {"a bitmap of negative size", std::string("BM", 2) + std::string(12, '\0') +
                                            std::string("\x28\0\0\0\xFF\xFF\xFF\xFF"
                                                        "\0\0\0\x80\1\0\x18\0",
                                                        16) +
                                            std::string(24, '\0')},
          {"a greymap of 20000 x 20000", "P5\n20000 20000\n255\n"},
          {"a greymap of too many", "P5\n99999999999 99999999999\n255\n"},
          {"a greymap of none", "P5\n0 0\n255\n"},
          {"a cloud of too many",
           "ply\nformat binary_little_endian 1.0\ncomment width 4294967295\ncomment height "
           "4294967295\nelement vertex 18446744065119617025\n"}};
}

TEST_F(BadInput, TheGoodFilesAreGood) {
  // Else the rest would be refused for another reason.
  for (const Use& use : uses()) {
    const std::string& command = use.arguments[0];
    const test::Outcome outcome = test::run(use.arguments);
    removeOutputs();
    // Noise is no board and no scene: only what is in these files is wrong with them.
    if (command == "calibrate-scan" || use.arguments[1] == "--target" ||
        use.arguments[1] == "pair" || use.kind == std::string("positions.csv"))
      continue;
    EXPECT_EQ(outcome.code, 0) << testing::PrintToString(use.arguments) << outcome.err;
  }
}

TEST_F(BadInput, NonsenseInThePlaceOfEveryFile) {
  for (const Use& use : uses()) {
    const std::string good = readFile(use.kind);
    for (const auto& [what, bytes] : nonsense()) {
      put(use.kind, bytes);
      EXPECT_FALSE(decent(use.arguments, what)) << use.arguments[0] << " took " << what;
      removeOutputs();
    }
    put(use.kind, good);
  }
}

TEST_F(BadInput, NoFileInThePlaceOfEveryFile) {
  fs::create_symlink("loop", "loop");
  for (const Use& use : uses()) {
    fs::rename(use.kind, "good");
    EXPECT_FALSE(decent(use.arguments, "no file"));
    fs::create_directory(use.kind);
    EXPECT_FALSE(decent(use.arguments, "a folder"));
    fs::remove(use.kind);
    ASSERT_EQ(::mkfifo(use.kind, 0600), 0);
    EXPECT_FALSE(decent(use.arguments, "a pipe that nobody writes to"));
    fs::remove(use.kind);
    for (const char* link : {"loop", "/dev/zero", "/dev/full", "/proc/self/mem", "/nowhere"}) {
      fs::create_symlink(fs::path(link).is_absolute() ? link : folder_.path() / link, use.kind);
      EXPECT_FALSE(decent(use.arguments, std::string("a link to ") + link));
      fs::remove(use.kind);
    }
    fs::rename("good", use.kind);
  }
}

TEST_F(BadInput, FilesThatWereCutOffOrChanged) {
  std::mt19937 random(11);
  for (const Use& use : uses()) {
    const std::string good = readFile(use.kind);
    for (int cut = 0; cut < 6; ++cut) {
      put(use.kind, good.substr(0, good.size() * cut / 6));
      decent(use.arguments, "what was cut off");
      removeOutputs();
    }
    for (int change = 0; change < 20; ++change) {
      std::string bytes = good;
      for (int i = 0; i < 3; ++i) bytes[random() % bytes.size()] = static_cast<char>(random());
      put(use.kind, bytes);
      decent(use.arguments, "what was changed by chance");
      removeOutputs();
    }
    put(use.kind, good);
  }
}

TEST_F(BadInput, NonsenseInThePlaceOfEveryNumberInAFile) {
  static const char* const kNumbers[] = {
      "nan",        ".inf", "-1", "0",  "1e308", "-1e308", "1e-320", "99999999999999999999",
      "0x7fffffff", "~",    "[]", "{}", "\"\"",  "one"};
  std::set<std::string> done;
  for (const Use& use : uses()) {
    const std::string kind = use.kind;
    if (fs::path(kind).extension() == ".png" || fs::path(kind).extension() == ".tiff" ||
        fs::path(kind).extension() == ".ply" || !done.insert(kind).second)
      continue;
    const std::string good = readFile(kind);
    // At most so many of them, spread over the file: each is a whole run where it is taken.
    std::vector<std::pair<std::size_t, std::size_t>> places;
    const auto numeric = [](char c) { return std::strchr("+-.0123456789", c) != nullptr; };
    for (std::size_t at = 0; at < good.size(); ++at) {
      const std::size_t start = at;
      while (at < good.size() && numeric(good[at])) ++at;
      if (at > start) places.emplace_back(start, at - start);
    }
    const std::size_t most = test::fullTests() ? 25 : 4;
    const std::size_t step = 1 + places.size() / most;
    for (std::size_t i = 0; i < places.size(); i += step) {
      for (const char* number : kNumbers) {
        std::string bytes = good;
        put(kind, bytes.replace(places[i].first, places[i].second, number));
        decent(use.arguments, std::string(number) + " as number " + std::to_string(i));
        removeOutputs();
      }
    }
    put(kind, good);
  }
}

TEST_F(BadInput, WhatIsSoundAsAFileButUselessIsNamed) {
  const auto changed = [](std::string text, const std::string& from, const std::string& to) {
    const std::size_t at = text.find(from);
    EXPECT_NE(at, std::string::npos) << from;
    return text.replace(at, from.size(), to);
  };
  put("far.yaml", changed(readFile("lens.yaml"), "center: [31.2", "center: [99999"));
  put("folded.yaml", changed(readFile("camera_info.yaml"), "[-0.2,", "[1e308,"));
  writeFileAtomically("counts.tiff", [] {
    std::vector<uchar> bytes;
    cv::imencode(".tiff", cv::Mat(48, 64, CV_32SC1, cv::Scalar(7)), bytes);
    return std::string(bytes.begin(), bytes.end());
  }());
  for (const auto& [file, arguments] : std::map<std::string, Arguments>{
           {"far.yaml", {"export", "far.yaml", "--format", "kalibr", "--out", "camchain.yaml"}},
           {"folded.yaml", {"import", "folded.yaml", "--out", "out.yaml"}},
           {"counts.tiff",
            {"dewarp", "--lens", "lens.yaml", "--size", "20x10", "counts.tiff", "out.png"}}}) {
    EXPECT_FALSE(decent(arguments, file));
    EXPECT_THAT(test::run(arguments).err, StartsWith("omnister: " + file + ": "));
  }
}

TEST_F(BadInput, ADamagedImageIsOneLine) {
  std::string damaged = readFile("image.png");
  damaged[damaged.size() / 2] ^= 0x55;
  // Libraries that decode have much to say about these.
  for (const std::string& image :
       {damaged, std::string("P2 64 48 255\n-1"), std::string("P5 64 48 99999\n")}) {
    put("image.png", image);
    const test::Outcome outcome =
        test::run({"dewarp", "--lens", "lens.yaml", "--size", "20x10", "image.png", "out.png"});
    EXPECT_EQ(outcome.code, 1);
    EXPECT_THAT(outcome.err, StartsWith("omnister: image.png: cannot be decoded"));
    EXPECT_EQ(std::count(outcome.err.begin(), outcome.err.end(), '\n'), 1) << outcome.err;
  }
  // A JPEG that lost its second half, but has an end.
  std::vector<uchar> jpeg;
  cv::imencode(".jpg", cv::imread("displaced.png"), jpeg);
  jpeg.erase(jpeg.begin() + static_cast<std::ptrdiff_t>(jpeg.size() / 2), jpeg.end() - 2);
  put("half.jpg", std::string(jpeg.begin(), jpeg.end()));
  const test::Outcome half =
      test::run({"dewarp", "--lens", "lens.yaml", "--size", "20x10", "half.jpg", "out.png"});
  EXPECT_EQ(half.err, "omnister: half.jpg: cannot be decoded: the image data is damaged\n");
  EXPECT_FALSE(fs::exists("out.png"));
  // And standard error is what it was.
  EXPECT_NE(test::run({"dewarp", "--lens", "no.yaml", "image.png", "out.png"}).err, "");
}

TEST_F(BadInput, ImagesThatAreOthersThanTheLens) {
  const std::string good = readFile("image.png");
  const std::map<std::string, cv::Mat> images = {
      {"one pixel", cv::Mat(1, 1, CV_8UC1, cv::Scalar(3))},
      {"one row", cv::Mat(1, 64, CV_8UC1, cv::Scalar(3))},
      {"one column", cv::Mat(48, 1, CV_8UC3, cv::Scalar::all(3))},
      {"a larger one", cv::Mat(480, 640, CV_8UC1, cv::Scalar(3))}};
  for (const Use& use : uses()) {
    if (fs::path(use.kind).extension() != ".png" || use.arguments[0] == "calibrate") continue;
    const std::string before = readFile(use.kind);
    for (const auto& [what, image] : images) {
      cv::imwrite(use.kind, image);
      EXPECT_FALSE(decent(use.arguments, what)) << use.arguments[0] << " took " << what;
      removeOutputs();
    }
    // What has the size is taken: 16 bit, transparent.
    for (const int type : {CV_16UC1, CV_8UC4, CV_16UC3}) {
      cv::imwrite(use.kind, cv::Mat(48, 64, type, cv::Scalar(3, 9, 27, 255)));
      decent(use.arguments, "type " + std::to_string(type));
      removeOutputs();
    }
    put(use.kind, before);
  }
}

TEST_F(BadInput, NonsenseForEveryNumberOfACommand) {
  const Arguments stereo = {"stereo",    "--lens",      "lens.yaml", "--reference",
                            "image.png", "--displaced", "image.png", "--pose",
                            kPose,       "--cloud",     "out.ply"};
  const Arguments render = {"render",     "--lens", "lens.yaml", "--scene",
                            "scene.yaml", "--out",  "out.png"};
  const Arguments dewarp = {"dewarp", "--lens", "lens.yaml", "image.png", "out.png"};
  const Arguments import = {"import", "camera_info.yaml", "--out", "out.yaml"};
  const Arguments calibrate = {"calibrate", "--detections", "corners.csv", "--size",  "64x48",
                               "--model",   "quadric",      "--out",       "out.yaml"};
  const Arguments target = {"target",  "--type", "checkerboard", "--cols", "8",
                            "--rows",  "6",      "--square-mm",  "20",     "--out",
                            "out.svg", "--yaml", "out.yaml"};
  const Arguments plane = {"evaluate", "plane", "--cloud", "cloud.ply"};
  const std::vector<std::pair<Arguments, Arguments>> numbers = {
      {stereo,
       {"--pose", "--min-range", "--max-range", "--hypotheses", "--threads", "--repeat", "--roi",
        "--reduce", "--thesis-window"}},
      {render, {"--pose", "--supersampling", "--noise", "--vignetting", "--seed", "--threads"}},
      {dewarp, {"--view", "--hfov", "--size"}},
      {import, {"--max-residual", "--knots", "--terms"}},
      {calibrate, {"--size", "--folds", "--threads", "--center", "--sweep", "--roi"}},
      {target, {"--cols", "--rows", "--square-mm", "--page", "--spacing", "--dot-mm"}},
      {plane, {"--roi", "--truth-height", "--tolerance", "--seed"}}};
  for (const auto& [arguments, options] : numbers) {
    for (const std::string& option : options) {
      for (const char* value : {"",
                                " ",
                                "x",
                                "nan",
                                "inf",
                                "-inf",
                                "-1",
                                "1e308",
                                "-1e308",
                                "1e-320",
                                "0x",
                                "1x1",
                                "99999999999999999999",
                                "1,1,1,1",
                                "-1,-1,-1,-1",
                                "99999,99999,99999,99999",
                                "99999x99999",
                                "65535x65535",
                                "0x0",
                                "nanxnan",
                                "nan nan nan nan nan nan nan",
                                "1e308 0 0 0 0 0 1",
                                "1 2 3 0 0 0 0",
                                "\xD9\xA1\xD9\xA2",
                                "1\n2"}) {
        Arguments changed = arguments;
        const auto given = std::find(changed.begin(), changed.end(), option);
        if (given == changed.end()) {
          changed.push_back(option + "=" + value);
        } else {
          *given = option + "=" + value;
          changed.erase(given + 1);
        }
        // Enough for what is merely large.
        if (option == "--repeat" && std::strcmp(value, "1e308") == 0) continue;
        decent(changed, value);
        removeOutputs();
        fs::remove("out.svg");
      }
    }
  }
}

TEST_F(BadInput, NonsenseOnStandardInput) {
  for (const char* command : {"project", "unproject"}) {
    const Arguments arguments = {command, "--lens", "lens.yaml"};
    for (const auto& [what, text] : nonsense()) {
      if (text.empty()) continue;
      const test::Outcome outcome = test::run(arguments, text);
      EXPECT_EQ(outcome.code, 1) << command << " took " << what;
      EXPECT_THAT(outcome.err, StartsWith("omnister: standard input: line 1: is "));
      EXPECT_EQ(outcome.out, "");
      EXPECT_LE(outcome.err.size(), 400u) << what;
    }
    for (const char* numbers : {"nan nan", "inf -inf", "1e308 -1e308", "1e-320 0", "0 0"}) {
      std::string line = numbers;
      if (command == std::string("project")) line += " 0";
      EXPECT_EQ(test::run(arguments, line + "\r\n" + line).code, 0) << line;
    }
  }
}

/// The letter that never ends, as of a device.
class Endless : public std::streambuf {
 public:
  std::size_t taken() const { return taken_; }

 private:
  int_type underflow() override {
    // Whoever takes all this would take everything.
    if (taken_ > (std::size_t{1} << 24)) return traits_type::eof();
    setg(block_.data(), block_.data(), block_.data() + block_.size());
    taken_ += block_.size();
    return '1';
  }

  std::string block_ = std::string(1000, '1');
  std::size_t taken_ = 0;
};

TEST_F(BadInput, ALineWithoutEndIsNotReadToItsEnd) {
  Endless endless;
  const test::Outcome outcome = test::run({"project", "--lens", "lens.yaml"}, endless);
  EXPECT_EQ(outcome.code, 1);
  EXPECT_THAT(outcome.err, HasSubstr("line 1"));
  EXPECT_LE(endless.taken(), 10000u);
}

TEST_F(BadInput, PlacesThatCannotBeWritten) {
  put("file", "x");
  fs::create_directory("folder");
  const std::string long_name(300, 'n');
  const std::vector<Arguments> commands = {
      {"render", "--lens", "lens.yaml", "--scene", "scene.yaml", "--supersampling", "1", "--out",
       ".png"},
      {"stereo", "--lens", "lens.yaml", "--reference", "image.png", "--displaced", "image.png",
       "--pose", kPose, "--cloud", ".ply"},
      {"stereo", "--lens", "lens.yaml", "--reference", "image.png", "--displaced", "image.png",
       "--pose", kPose, "--range", ".tiff"},
      {"import", "camera_info.yaml", "--out", ".yaml"},
      {"export", "lens.yaml", "--format", "kalibr", "--out", ".yaml"},
      {"calibrate", "--detections", "corners.csv", "--size", "64x48", "--model", "quadric", "--out",
       ".yaml"},
      {"target", "--type", "checkerboard", "--cols", "8", "--rows", "6", "--square-mm", "20",
       "--out", ".svg"},
      {"dewarp", "--lens", "lens.yaml", "--size", "20x10", "image.png", ".png"}};
  for (Arguments arguments : commands) {
    const std::string extension = arguments.back();
    fs::create_directories("folder/inside" + extension);
    for (const std::string& place :
         {std::string("nowhere/out") + extension, "file/out" + extension,
          "folder/inside" + extension, long_name + extension, std::string("/proc/out") + extension,
          repeated("folder/../", 600) + "out" + extension}) {
      arguments.back() = place;
      EXPECT_FALSE(decent(arguments, place)) << place;
    }
    fs::create_symlink("/dev/full", "full" + extension);
    arguments.back() = "full" + extension;
    EXPECT_FALSE(decent(arguments, "a full disk"));
    fs::remove("full" + extension);
    EXPECT_EQ(fs::status("/dev/full").type(), fs::file_type::character);
  }
}

}  // namespace
}  // namespace omnister
