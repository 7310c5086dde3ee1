// SPDX-License-Identifier: Apache-2.0
#include "omnister/device/replay_camera.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/stat.h>

#include <fstream>
#include <opencv2/imgcodecs.hpp>

#include "temporary_folder.h"

namespace omnister::device {
namespace {

using std::chrono::milliseconds;
using testing::HasSubstr;

class ReplayCameraTest : public testing::Test {
 protected:
  void writeImage(const std::string& name, int value, int type = CV_8UC1) const {
    ASSERT_TRUE(
        cv::imwrite((folder_.path() / name).string(), cv::Mat(4, 6, type, cv::Scalar::all(value))));
  }
  void writeList(const std::string& text) const {
    std::ofstream(folder_.path() / "replay.yaml") << text;
  }
  std::unique_ptr<Camera> open(const CameraSettings& settings = {}) const {
    return openCamera("replay:" + folder_.path().string(), settings);
  }
  std::string refusal() const {
    try {
      open();
    } catch (const Error& e) {
      return e.what();
    }
    return "";
  }

  test::TemporaryFolder folder_;
};

CameraSettings unpaced() {
  CameraSettings settings;
  settings.paced = false;
  return settings;
}

std::vector<int> values(Camera* camera, int most = 100) {
  std::vector<int> result;
  camera->start();
  for (int i = 0; i < most && !camera->finished(); ++i) {
    const std::optional<Frame> frame = camera->grab(milliseconds(50));
    if (frame) result.push_back(frame->image.at<std::uint8_t>(0, 0));
  }
  return result;
}

TEST_F(ReplayCameraTest, AFolderIsItsImagesInTheOrderOfTheirNames) {
  writeImage("b.png", 2);
  writeImage("a.png", 1);
  writeImage("c.PGM", 3);
  std::ofstream(folder_.path() / "notes.txt") << "no image";
  const auto camera = open(unpaced());
  EXPECT_THAT(values(camera.get()), testing::ElementsAre(1, 2, 3));
  EXPECT_TRUE(camera->finished());
  EXPECT_FALSE(camera->grab(milliseconds(1)));
}

TEST_F(ReplayCameraTest, TheListCarriesStampsPositionsAndSettled) {
  writeImage("x.png", 9);
  writeImage("y.png", 8, CV_16UC1);
  writeList(
      "version: 1\nlens: wide.yaml\nframes:\n"
      "  - {image: x.png, stamp: 1342626147.554042001, stage_position_m: -0.25, settled: true}\n"
      "  - {image: y.png, stamp: 1342626147.6, settled: false}\n");
  CameraSettings settings = unpaced();
  settings.recorded_stamps = true;
  const auto camera = open(settings);
  ASSERT_TRUE(camera->lensFile());
  EXPECT_EQ(camera->lensFile()->filename(), "wide.yaml");
  camera->start();
  const auto first = camera->grab(milliseconds(50));
  ASSERT_TRUE(first);
  EXPECT_EQ(first->stamp.time_since_epoch().count(), 1342626147554042001LL);
  EXPECT_EQ(first->stage_position_m, -0.25);
  EXPECT_EQ(first->settled, true);
  EXPECT_EQ(first->encoding, "mono8");
  const auto second = camera->grab(milliseconds(50));
  ASSERT_TRUE(second);
  EXPECT_EQ(second->stamp.time_since_epoch().count(), 1342626147600000000LL);
  EXPECT_FALSE(second->stage_position_m);
  EXPECT_EQ(second->settled, false);
  EXPECT_EQ(second->encoding, "mono16");
  EXPECT_EQ(second->sequence, first->sequence + 1);
}

TEST_F(ReplayCameraTest, IntervalsAreThoseOfTheRecording) {
  for (const char* name : {"a.png", "b.png", "c.png"}) writeImage(name, 1);
  writeList(
      "version: 1\nframes:\n  - {image: a.png, stamp: 10.0}\n  - {image: b.png, stamp: 10.03}\n"
      "  - {image: c.png, stamp: 10.1}\n");
  const auto camera = open();
  const Stamp before = now();
  camera->start();
  std::vector<Frame> frames;
  while (!camera->finished()) {
    // A frame is never early.
    if (auto frame = camera->grab(milliseconds(20))) {
      EXPECT_GE(now() + milliseconds(1), frame->stamp);
      frames.push_back(*frame);
    }
  }
  ASSERT_EQ(frames.size(), 3u);
  EXPECT_GE(frames[0].stamp, before);
  EXPECT_EQ(frames[1].stamp - frames[0].stamp, milliseconds(30));
  EXPECT_EQ(frames[2].stamp - frames[0].stamp, milliseconds(100));
}

TEST_F(ReplayCameraTest, GrabReturnsWithinItsTimeout) {
  writeImage("a.png", 1);
  writeImage("b.png", 2);
  writeList("version: 1\nframes:\n  - {image: a.png, stamp: 1}\n  - {image: b.png, stamp: 3601}\n");
  const auto camera = open();
  camera->start();
  EXPECT_TRUE(camera->grab(milliseconds(10)));
  EXPECT_FALSE(camera->grab(milliseconds(10)));
  EXPECT_FALSE(camera->finished());
}

TEST_F(ReplayCameraTest, GoesOnAfterAStop) {
  for (const char* name : {"1.png", "2.png", "3.png"}) writeImage(name, name[0] - '0');
  const auto camera = open(unpaced());
  EXPECT_THAT(values(camera.get(), 1), testing::ElementsAre(1));
  camera->stop();
  EXPECT_FALSE(camera->grab(milliseconds(1)));
  EXPECT_THAT(values(camera.get()), testing::ElementsAre(2, 3));
}

TEST_F(ReplayCameraTest, LoopsWithStampsThatKeepRising) {
  writeImage("1.png", 1);
  writeImage("2.png", 2);
  writeList(
      "version: 1\nframes:\n  - {image: 1.png, stamp: 5.0}\n  - {image: 2.png, stamp: 5.5}\n");
  CameraSettings settings = unpaced();
  settings.loop = true;
  settings.recorded_stamps = true;
  const auto camera = open(settings);
  camera->start();
  std::vector<double> stamps;
  for (int i = 0; i < 5; ++i) {
    const auto frame = camera->grab(milliseconds(50));
    ASSERT_TRUE(frame);
    EXPECT_EQ(frame->image.at<std::uint8_t>(0, 0), 1 + i % 2);
    stamps.push_back(static_cast<double>(frame->stamp.time_since_epoch().count()) * 1e-9);
  }
  EXPECT_THAT(stamps, testing::ElementsAre(5.0, 5.5, 6.0, 6.5, 7.0));
  EXPECT_FALSE(camera->finished());
}

TEST_F(ReplayCameraTest, ABrokenImageIsALostFrameAndARemark) {
  writeImage("1.png", 1);
  std::ofstream(folder_.path() / "2.png") << "no picture";
  writeImage("3.png", 3);
  const auto camera = open(unpaced());
  EXPECT_TRUE(camera->takeRemarks().empty());
  camera->start();
  const auto first = camera->grab(milliseconds(50));
  const auto third = camera->grab(milliseconds(50));
  ASSERT_TRUE(first && third);
  EXPECT_EQ(third->image.at<std::uint8_t>(0, 0), 3);
  EXPECT_EQ(third->sequence, first->sequence + 2);
  const auto remarks = camera->takeRemarks();
  ASSERT_EQ(remarks.size(), 1u);
  EXPECT_THAT(remarks[0], HasSubstr("2.png"));
  EXPECT_TRUE(camera->takeRemarks().empty());
}

TEST_F(ReplayCameraTest, WhatBecameOfAnImageSinceIsALostFrameAndARemark) {
  for (const char* name : {"1.png", "2.png", "3.png", "4.png"}) writeImage(name, name[0] - '0');
  const auto camera = open(unpaced());
  // A picture of 100 GB that is all header, a pipe that nobody writes to, and nothing.
  std::ofstream(folder_.path() / "1.png") << "P5\n316000 316000\n255\n";
  for (const char* name : {"2.png", "3.png"}) std::filesystem::remove(folder_.path() / name);
  ASSERT_EQ(::mkfifo((folder_.path() / "2.png").c_str(), 0600), 0);
  EXPECT_THAT(values(camera.get()), testing::ElementsAre(4));
  EXPECT_THAT(camera->takeRemarks(),
              testing::ElementsAre(HasSubstr("1.png: is 316000x316000 pixels"),
                                   HasSubstr("2.png: is not a regular file"),
                                   HasSubstr("3.png: No such file")));
}

TEST_F(ReplayCameraTest, OnlyBrokenImagesInALoopStillReturn) {
  std::ofstream(folder_.path() / "1.png") << "no picture";
  CameraSettings settings = unpaced();
  settings.loop = true;
  const auto camera = open(settings);
  camera->start();
  EXPECT_FALSE(camera->grab(milliseconds(5)));
  EXPECT_FALSE(camera->takeRemarks().empty());
}

TEST_F(ReplayCameraTest, SaysWhichSettingsARecordingCannotHave) {
  writeImage("1.png", 1);
  CameraSettings settings = unpaced();
  settings.gain = 3.0;
  const auto camera = open(settings);
  const auto remarks = camera->takeRemarks();
  ASSERT_EQ(remarks.size(), 1u);
  EXPECT_THAT(remarks[0], HasSubstr("gain"));
}

TEST_F(ReplayCameraTest, EncodingOfTheListIsHeldToTheImages) {
  writeImage("1.png", 1);
  writeImage("2.png", 2, CV_8UC3);
  writeList("version: 1\nencoding: bayer_rggb8\nframes:\n  - {image: 1.png}\n  - {image: 2.png}\n");
  const auto camera = open(unpaced());
  camera->start();
  const auto frame = camera->grab(milliseconds(50));
  ASSERT_TRUE(frame);
  EXPECT_EQ(frame->encoding, "bayer_rggb8");
  EXPECT_FALSE(camera->grab(milliseconds(50)));
  const auto remarks = camera->takeRemarks();
  ASSERT_EQ(remarks.size(), 1u);
  EXPECT_THAT(remarks[0], HasSubstr("bayer_rggb8"));
}

TEST_F(ReplayCameraTest, RefusesBrokenListsWithOneClearLine) {
  writeImage("a.png", 1);
  const std::vector<std::pair<std::string, std::string>> cases = {
      {"", "mapping"},
      {"[1, 2]", "mapping"},
      {"version: 2\nframes: [{image: a.png}]", "version"},
      {"frames: [{image: a.png}]", "version: is missing"},
      {"version: 1", "frames"},
      {"version: 1\nframes: []", "frames"},
      {"version: 1\nframes: [a.png]", "frames[0]"},
      {"version: 1\nframes: [{stamp: 1}]", "frames[0].image: is missing"},
      {"version: 1\nframes: [{image: b.png}]", "b.png"},
      {"version: 1\nframes: [{image: a.png, stamp: nan}]", "frames[0].stamp"},
      {"version: 1\nframes: [{image: a.png, stamp: -1}]", "frames[0].stamp"},
      {"version: 1\nframes: [{image: a.png, stamp: 99999999999999999999}]", "frames[0].stamp"},
      {"version: 1\nframes: [{image: a.png, stamp: 2}, {image: a.png, stamp: 2}]",
       "frames[1].stamp"},
      {"version: 1\nframes: [{image: a.png, stamp: 2}, {image: a.png}]", "frames[1].stamp"},
      {"version: 1\nframes: [{image: a.png, stage_position_m: inf}]", "stage_position_m"},
      {"version: 1\nframes: [{image: a.png, settled: 3}]", "settled"},
      {"version: 1\nframes: [{image: a.png, speed: 3}]", "frames[0].speed"},
      {"version: 1\nrate: 0\nframes: [{image: a.png}]", "rate"},
      {"version: 1\nencoding: purple\nframes: [{image: a.png}]", "encoding"},
      {"version: 1\nfps: 3\nframes: [{image: a.png}]", "fps"},
      {"version: 1\nframes: [{image: a.png", "YAML"},
      {"version: 1\nrate: 2\nframes: [{image: a.png}]\nrate: 3", "rate: stands there twice"},
      {"version: 1\nframes: [{image: a.png, stamp: 1, stamp: 2}]",
       "frames[0].stamp: stands there twice"},
      {"version: 1\nframes: [{image: a.png}]\n---\nversion: 1", "line 4: begins another"},
  };
  for (const auto& [text, expected] : cases) {
    writeList(text);
    const std::string message = refusal();
    EXPECT_THAT(message, HasSubstr(expected)) << text;
    EXPECT_THAT(message, testing::Not(HasSubstr("\n"))) << text;
  }
}

TEST_F(ReplayCameraTest, RefusesFoldersAndDevicesThatAreNone) {
  EXPECT_THAT(refusal(), HasSubstr("no image"));
  EXPECT_THROW(openCamera("replay:"), InputError);
  EXPECT_THROW(openCamera("webcam"), InputError);
  EXPECT_THROW(openCamera("replay:/does/not/exist"), Error);
}

}  // namespace
}  // namespace omnister::device
