// SPDX-License-Identifier: Apache-2.0
// `omnister bag`, on recordings written here. No master.
#include <gmock/gmock.h>

#include <filesystem>
#include <nlohmann/json.hpp>

#include "command_run.h"
#include "omnister/common/file_io.h"
#include "omnister/stereo/cloud.h"
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
