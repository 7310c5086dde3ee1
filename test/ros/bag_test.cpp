// SPDX-License-Identifier: Apache-2.0
// `omnister bag`, on recordings written here. No master.
#include <gmock/gmock.h>
#include <sys/resource.h>
#include <topic_tools/shape_shifter.h>

#include <algorithm>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "command_run.h"
#include "omnister/calibration/rig_file.h"
#include "omnister/common/file_io.h"
#include "omnister/lens/lens_file.h"
#include "omnister/stereo/cloud.h"
#include "ros/message/messages.h"
#include "ros/recorded_rig.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;
using test::kBegin;
using test::Recording;
using test::run;
using test::views;
using testing::AllOf;
using testing::HasSubstr;
using Json = nlohmann::json;

constexpr int kFrames = 6;

class Bag : public testing::Test {
 protected:
  std::string path(const std::string& name) const { return (folder_.path() / name).string(); }

  std::string recorded() const {
    test::recordRoom(path("run.bag"), kFrames);
    return path("run.bag");
  }

  Json figures(const std::vector<std::string>& arguments) const {
    const test::Outcome outcome = run(arguments);
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    return Json::parse(outcome.out, nullptr, false);
  }

  test::TemporaryFolder folder_;
};

TEST_F(Bag, MakesACloudOfEverySetAndGoesOnWhereItWasKilled) {
  const std::vector<std::string> arguments = {"bag",         recorded(), "--out", path("out"),
                                              "--max-range", "20",       "--json"};
  const Json first = figures(arguments);
  EXPECT_EQ(first["images"], kFrames);
  EXPECT_EQ(first["clouds"], kFrames - 1) << "each frame with the one before";
  EXPECT_EQ(first["clouds_before"], 0);
  EXPECT_NEAR(first["recorded_seconds"].get<double>(), kFrames - 1, 1e-6);
  // The second image is the one whose truth is known.
  const Cloud cloud = readCloud(path("out/cloud_1002.000000000.ply"));
  cv::Mat range(cloud.xyz.size(), CV_32FC1);
  for (int v = 0; v < range.rows; ++v)
    for (int u = 0; u < range.cols; ++u)
      range.at<float>(v, u) = static_cast<float>(cv::norm(cloud.xyz.at<cv::Vec3f>(v, u)));
  double share = 0.0;
  EXPECT_LT(test::medianError(range, views().right_range, &share), 0.02);
  EXPECT_GT(share, 0.6);
  const std::string table = readFile(path("out/clouds.csv"));
  EXPECT_EQ(std::count(table.begin(), table.end(), '\n'), kFrames);

  // Killed while the third was being written: its cloud may stand there, its note does not.
  fs::remove(path("out/cloud_1003.000000000.json"));
  fs::remove(path("out/clouds.csv"));
  const Json second = figures(arguments);
  EXPECT_EQ(second["clouds"], 1);
  EXPECT_EQ(second["clouds_before"], kFrames - 2);
  const std::string again = readFile(path("out/clouds.csv"));
  EXPECT_EQ(std::count(again.begin(), again.end(), '\n'), kFrames);
}

TEST_F(Bag, RefusesToMixRunsWithOtherSettings) {
  // No UTF-8, which JSON would have.
  fs::rename(recorded(), path("r\xFCn.bag"));
  const std::string bag = path("r\xFCn.bag");
  figures({"bag", bag, "--out", path("out"), "--max-range", "20", "--json"});
  const std::string note = path("out/cloud_1001.000000000.json");
  writeFileAtomically(note, "[1]");
  const test::Outcome broken = run({"bag", bag, "--out", path("out"), "--max-range", "20"});
  EXPECT_EQ(broken.code, 1);
  EXPECT_THAT(broken.err, AllOf(HasSubstr(note + ": is not the note"), HasSubstr("--restart")));
  const test::Outcome other = run({"bag", bag, "--out", path("out"), "--max-range", "10"});
  EXPECT_EQ(other.code, 1);
  EXPECT_THAT(other.err,
              AllOf(HasSubstr("run.json"), HasSubstr("max_range"), HasSubstr("--restart")));
  const Json anew =
      figures({"bag", bag, "--out", path("out"), "--max-range", "10", "--restart", "--json"});
  EXPECT_EQ(anew["clouds"], kFrames - 1);
}

TEST_F(Bag, SaysWhatIsWrongWithARecording) {
  const std::string bag = recorded();
  struct Case {
    std::vector<std::string> arguments;
    std::vector<std::string> words;
  };
  {
    Recording two(path("two.bag"));
    two.lens(views().lens);
    two.frame(0, 0.0, views().left);
    const sensor_msgs::ImagePtr image = toImage(views().left, "bgr8");
    two.bag().write("/other/image_raw", kBegin, image);
  }
  {
    Recording bare(path("bare.bag"));
    bare.frame(0, 0.0, views().left);
  }
  rosbag::Bag(path("empty.bag"), rosbag::bagmode::Write).close();
  const std::string bytes = readFile(bag);
  writeFileAtomically(path("cut.bag"), bytes.substr(0, bytes.size() / 2));
  writeFileAtomically(path("text.bag"), "#ROSBAG V9.9\n");
  for (const Case& c : {
           Case{{path("none.bag")}, {"none.bag", "No such file"}},
           Case{{path("cut.bag")}, {"cut.bag", "reindex"}},
           Case{{path("text.bag")}, {"text.bag", "not a whole bag"}},
           Case{{path("empty.bag")}, {"image topics: none"}},
           Case{{path("two.bag")}, {"/camera/image_raw", "/other/image_raw"}},
           Case{{path("bare.bag")}, {"/camera/lens_model", "--lens"}},
           Case{{bag, "--image", "/nose"}, {"/nose", "/camera/image_raw"}},
           Case{{bag, "--mode", "rig"}, {"image topics"}},
           Case{{bag, "--lens", path("none.yaml")}, {"none.yaml"}},
       }) {
    std::vector<std::string> arguments = {"bag"};
    arguments.insert(arguments.end(), c.arguments.begin(), c.arguments.end());
    arguments.insert(arguments.end(), {"--out", path("refused")});
    const test::Outcome outcome = run(arguments);
    EXPECT_EQ(outcome.code, 1) << outcome.err;
    for (const std::string& word : c.words) EXPECT_THAT(outcome.err, HasSubstr(word));
    EXPECT_FALSE(fs::exists(path("refused"))) << outcome.err;
  }
  EXPECT_EQ(run({"bag", bag, "--out", path("x"), "--positions", "0"}).code, 2);
}

/// A message's bytes as they were recorded, whatever they say.
template <typename Message>
topic_tools::ShapeShifter recordedAs(std::vector<std::uint8_t> bytes) {
  namespace traits = ros::message_traits;
  topic_tools::ShapeShifter message;
  message.morph(traits::MD5Sum<Message>::value(), traits::DataType<Message>::value(),
                traits::Definition<Message>::value(), "0");
  ros::serialization::IStream stream(bytes.data(), static_cast<std::uint32_t>(bytes.size()));
  message.read(stream);
  return message;
}

template <typename Message>
std::vector<std::uint8_t> serialized(const Message& message) {
  std::vector<std::uint8_t> bytes(ros::serialization::serializationLength(message));
  ros::serialization::OStream stream(bytes.data(), static_cast<std::uint32_t>(bytes.size()));
  ros::serialization::serialize(stream, message);
  return bytes;
}

// Room for what a length claims would be four gigabytes, or none.
TEST_F(Bag, LengthsInMessagesThatLie) {
  Recording recording(path("lies.bag"));
  recording.lens(views().lens);
  recording.frame(0, 0.0, views().left);
  sensor_msgs::Image image;
  image.header.stamp = kBegin + ros::Duration(1.5);
  image.data = {1, 2, 3};
  std::vector<std::uint8_t> bytes = serialized(image);
  std::fill(bytes.end() - 7, bytes.end() - 3, 0xff);
  recording.bag().write("/camera/image_raw", kBegin, recordedAs<sensor_msgs::Image>(bytes));
  recording.bag().write("/tf", kBegin, recordedAs<tf2_msgs::TFMessage>({255, 255, 255, 0}));
  bytes = serialized(toLensModelMessage(views().lens, {}));
  std::fill(bytes.end() - 4, bytes.end(), 0xff);
  for (std::size_t size = 1; size < bytes.size(); size += 1 + bytes.size() / 50)
    recording.bag().write("/camera/lens_model", kBegin,
                          recordedAs<LensModelMessage>({bytes.begin(), bytes.begin() + size}));
  recording.frame(1, test::kBaseline, views().right);
  recording.bag().close();
  const Json result = figures({"bag", path("lies.bag"), "--out", path("out"), "--json"});
  EXPECT_EQ(result["clouds"], 1);
  EXPECT_EQ(result["dropped"]["broken message on /camera/image_raw"], 1);
  EXPECT_EQ(result["dropped"]["broken message on /tf"], 1);
  EXPECT_GE(result["dropped"]["broken message on /camera/lens_model"], 45);
  rusage used{};
  ::getrusage(RUSAGE_SELF, &used);
  EXPECT_LT(used.ru_maxrss, 1500000) << "KiB";
}

TEST_F(Bag, StampsFromTheEndsOfTimeEndNoRun) {
  Recording recording(path("far.bag"));
  recording.lens(views().lens);
  recording.frame(0, 0.0, views().left);
  const sensor_msgs::ImagePtr image = toImage(views().left, "bgr8");
  image->header.frame_id = "camera_optical";
  for (const ros::Time& stamp : {ros::TIME_MAX, ros::Time(0), ros::Time(0x7fffffff, 0)}) {
    image->header.stamp = stamp;
    recording.bag().write("/camera/image_raw", kBegin, image);
    tf2_msgs::TFMessage transforms;
    transforms.transforms = {
        toTransformStamped(Pose::Identity(), stamp, "stage_base", "camera_optical")};
    recording.bag().write("/tf", kBegin, transforms);
  }
  recording.frame(1, test::kBaseline, views().right);
  recording.bag().close();
  const Json result = figures({"bag", path("far.bag"), "--out", path("out"), "--json"});
  EXPECT_EQ(result["clouds"], 1) << result;
  EXPECT_EQ(result["dropped"]["transform that tf refuses"], 2) << result;
}

// A rig's pairs, the last one too, which nothing comes after.
TEST_F(Bag, EveryPairOfARigAndEveryImageWithoutOne) {
  RigFile rig;
  rig.reference = rig.displaced = path("lens.yaml");
  rig.T_ref_disp.translation().x() = test::kBaseline;
  writeLensFile(rig.reference, views().lens);
  writeRigFile(path("rig.yaml"), rig);
  {
    Recording recording(path("rig.bag"));
    const auto write = [&](const char* topic, const cv::Mat& picture, const ros::Time& stamp) {
      const sensor_msgs::ImagePtr image = toImage(picture, "bgr8");
      image->header.stamp = stamp;
      image->header.frame_id = "eye";
      recording.bag().write(topic, kBegin, image);
    };
    for (int i = 0; i < 3; ++i) {
      const ros::Time stamp = kBegin + ros::Duration(i);
      write("/left/image_raw", views().left, stamp);
      // One that no difference of stamps reaches.
      if (i == 1) write("/left/image_raw", views().left, ros::Time(0x7fffffff, 0));
      if (i == 1) write("/right/image_raw", views().right, ros::Time(1, 0));
      write("/right/image_raw", views().right, stamp + ros::Duration(0.003));
    }
  }
  const Json result = figures({"bag", path("rig.bag"), "--mode", "rig", "--image",
                               "/left/image_raw", "--right-image", "/right/image_raw", "--rig",
                               path("rig.yaml"), "--out", path("out"), "--json"});
  EXPECT_EQ(result["images"], 8);
  EXPECT_EQ(result["sets"], 3) << result;
  EXPECT_EQ(result["clouds"], 3) << result;
  EXPECT_TRUE(fs::exists(path("out/cloud_1002.000000000.ply")));
  EXPECT_EQ(result["dropped"]["image without one of the other camera"], 1) << result;
  EXPECT_EQ(result["dropped"].size(), 2U) << result;
}

TEST_F(Bag, WithoutAnImageItLeavesNothing) {
  {
    Recording recording(path("broken.bag"));
    recording.lens(views().lens);
    recording.bag().write("/camera/image_raw", kBegin, recordedAs<sensor_msgs::Image>({1, 2, 3}));
  }
  const test::Outcome outcome = run({"bag", path("broken.bag"), "--out", path("out"), "--json"});
  EXPECT_EQ(outcome.code, 1);
  EXPECT_EQ(outcome.out, "");
  EXPECT_THAT(outcome.err, AllOf(HasSubstr("holds no image that can be used"),
                                 HasSubstr("1 times: broken message on /camera/image_raw")));
  EXPECT_FALSE(fs::exists(path("out")));
}

// What leads rosbag out of its memory: an index that points anywhere, or says more than it holds.
TEST_F(Bag, AnIndexThatLiesIsRefused) {
  const std::string good = readFile(recorded());
  const std::string entries = "count=";
  const std::size_t index = good.rfind(entries, good.find("chunk_pos="));
  ASSERT_NE(index, std::string::npos);
  // The count, the length of the data, and an entry's place behind its time.
  for (const std::size_t place : {entries.size(), entries.size() + 4, entries.size() + 16}) {
    for (const char byte : {'\x01', '\x40', '\xff'}) {
      std::string bytes = good;
      bytes[index + place + 1] ^= byte;
      writeFileAtomically(path("lies.bag"), bytes);
      const test::Outcome outcome = run({"bag", path("lies.bag"), "--out", path("out")});
      EXPECT_EQ(outcome.code, 1) << place;
      EXPECT_THAT(outcome.err, AllOf(HasSubstr("lies.bag: is not a whole bag"), HasSubstr("byte")));
      EXPECT_FALSE(fs::exists(path("out")));
    }
  }
}

TEST_F(Bag, GoesOnAfterBrokenMessages) {
  Recording recording(path("bad.bag"));
  recording.lens(views().lens);
  recording.frame(0, 0.0, views().left);
  sensor_msgs::ImagePtr broken = toImage(views().left, "bgr8");
  broken->header.stamp = kBegin + ros::Duration(1.5);
  broken->header.frame_id = "camera_optical";
  broken->data.resize(100);
  recording.bag().write("/camera/image_raw", broken->header.stamp, broken);
  recording.bag().write("/tf_static", kBegin, *toImage(views().left, "bgr8"));
  recording.frame(1, test::kBaseline, views().right);
  recording.bag().close();
  const Json result = figures(
      {"bag", path("bad.bag"), "--image", "/camera/image_raw", "--out", path("out"), "--json"});
  EXPECT_EQ(result["clouds"], 1);
  EXPECT_EQ(result["dropped"].size(), 2U) << result["dropped"];
}

}  // namespace
}  // namespace omnister
