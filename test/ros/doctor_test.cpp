// SPDX-License-Identifier: Apache-2.0
// The doctor before living nodes, each with one thing broken.
#include <gmock/gmock.h>
#include <tf2_ros/transform_broadcaster.h>

#include <atomic>
#include <filesystem>
#include <functional>
#include <future>
#include <opencv2/core.hpp>
#include <thread>

#include "child_process.h"
#include "omnister/common/file_io.h"
#include "omnister/lens/lens_models.h"
#include "ros/doctor/doctor_facts.h"
#include "ros/message/conversions.h"
#include "ros/ros_test.h"
#include "ros/stereo/stereo_pipeline.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

using test::eventually;
using test::TemporaryFolder;

LensFile lensFile(cv::Size size) {
  LensFile file;
  file.image_size = size;
  LensStructure structure;
  structure.model = "conic";
  file.lens = makeLens(structure, {0.5 * size.width, 0.5 * size.height}, size.width / 3.1, 1.5);
  return file;
}

/// A camera that slides to and fro between two places, of a textured scene at infinity, and the
/// stereo node that makes clouds of it, in a namespace of its own.
class Rig {
 public:
  explicit Rig(const std::string& name)
      : node_("/" + name),
        stereo_parameters_("/" + name + "/stereo"),
        lens_(folder_.path() / "lens.yaml") {
    setLens({80, 60});
    setParameter("lens", lens_.string());
    setParameter("fixed_frame", base());
    setParameter("min_baseline", 0.1);
    texture.create(60, 80, CV_8UC1);
    cv::RNG(1).fill(texture, cv::RNG::UNIFORM, 20, 230);
  }
  ~Rig() {
    stop_ = true;
    if (hand_.joinable()) hand_.join();
  }

  void setLens(cv::Size size) { writeLensFile(lens_, lensFile(size)); }
  template <typename Value>
  void setParameter(const std::string& name, const Value& value) {
    stereo_parameters_.setParam(name, value);
  }
  void deleteParameter(const std::string& name) { stereo_parameters_.deleteParam(name); }

  void startStereo() { stereo_ = std::make_unique<StereoPipeline>(node_, stereo_parameters_); }
  void advertise() { images_ = node_.advertise<sensor_msgs::Image>("image_raw", 4); }
  void start() {
    startStereo();
    advertise();
    hand_ = std::thread([this] {
      for (int lap = 0; !stop_; ++lap) {
        const double x = (lap / 8 % 2) * step;
        const ros::Time now = ros::Time::now();
        if (tf) {
          transforms_.sendTransform(
              toTransformStamped(Pose(Eigen::Translation3d(x, 0, 0)), now, base(), optical()));
        }
        const sensor_msgs::ImagePtr image = toImage(texture, "mono8");
        image->header.frame_id = optical();
        // Between two poses of the same place.
        image->header.stamp = now - ros::Duration(0.1);
        images_.publish(image);
        ros::WallDuration(0.05).sleep();
      }
    });
  }

  /// Looks until the verdict begins like this: on a loaded machine the first look may be too
  /// short. @return the last verdict
  std::string verdict(const std::string& wanted) const {
    DoctorOptions options;
    options.camera = node_.getNamespace();
    options.seconds = 1.2;
    std::string seen;
    eventually(
        [&] {
          const std::vector<Finding> findings = diagnose(gatherFacts(options));
          seen = findings.empty() ? "nothing" : findings.front().code;
          return seen.find(wanted) == 0;
        },
        90.0);
    return seen;
  }

  // What the hand does; changed before start() only.
  cv::Mat texture;
  bool tf = true;
  double step = 0.2;  ///< [m]

 private:
  std::string base() const { return node_.getNamespace().substr(1) + "_base"; }
  std::string optical() const { return node_.getNamespace().substr(1) + "_optical"; }

  TemporaryFolder folder_;
  ros::NodeHandle node_, stereo_parameters_;
  std::filesystem::path lens_;
  std::atomic<bool> stop_{false};
  ros::Publisher images_;
  tf2_ros::TransformBroadcaster transforms_;
  std::unique_ptr<StereoPipeline> stereo_;
  std::thread hand_;
};

struct Fault {
  const char* name;
  std::function<void(Rig&)> seed;  ///< breaks one thing and starts what is left
  const char* verdict;             ///< what it begins with
};

/// A way to break what is set before all starts.
std::function<void(Rig&)> with(const std::function<void(Rig&)>& change) {
  return [change](Rig& rig) {
    change(rig);
    rig.start();
  };
}

TEST(Doctor, NamesWhatIsBrokenInLivingRigs) {
  const std::vector<Fault> faults = {
      {"NoStereoNode", [](Rig&) {}, "no_stereo_node"},
      {"NobodyPublishesImages", [](Rig& rig) { rig.startStereo(); }, "no_camera"},
      {"NoImages",
       [](Rig& rig) {
         rig.startStereo();
         rig.advertise();
       },
       "no_images"},
      {"NoLens", with([](Rig& rig) { rig.deleteParameter("lens"); }), "no_lens"},
      {"LensOfAnotherSize", with([](Rig& rig) {
         rig.setLens({160, 120});
       }),
       "size_mismatch"},
      {"NoTf", with([](Rig& rig) { rig.tf = false; }), "no_stage"},
      {"StandsStill", with([](Rig& rig) { rig.step = 0.0; }), "stage_not_moving"},
      {"MovesTooLittle", with([](Rig& rig) { rig.step = 0.03; }), "baseline_too_short"},
      {"BlackImages", with([](Rig& rig) { rig.texture = cv::Scalar(1); }), "dark_images"},
      // The same image from both places is at infinity: out of the search limits.
      {"AllRejected", with([](Rig& rig) { rig.setParameter("max_range", 1.0); }), "all_"},
  };
  // All at once, since nearly all of the time is spent listening.
  std::vector<std::future<std::string>> verdicts;
  for (const Fault& fault : faults) {
    verdicts.push_back(std::async(std::launch::async, [&fault] {
      Rig rig(fault.name);
      fault.seed(rig);
      return rig.verdict(fault.verdict);
    }));
  }
  for (std::size_t i = 0; i < faults.size(); ++i) {
    EXPECT_THAT(verdicts[i].get(), testing::StartsWith(faults[i].verdict)) << faults[i].name;
  }
}

TEST(DoctorAnswers, WithinItsTimeWhateverTheAddress) {
  EXPECT_TRUE(answers(ros::master::getURI()));
  EXPECT_FALSE(answers("http://localhost:1/"));
  EXPECT_FALSE(answers("http://no-such-host.invalid:11311/"));
  EXPECT_FALSE(answers(""));
  EXPECT_FALSE(answers("http://nothing"));
}

TEST(DoctorNode, FailsWhereItsFindingsCannotBeWritten) {
  const TemporaryFolder folder;
  const std::string said = (folder.path() / "said").string();
  for (const char* output : {"", " --json"}) {
    std::filesystem::remove(said);
    test::ChildProcess doctor(
        {"/bin/sh", "-c",
         "ROS_MASTER_URI=http://localhost:1/ exec \"$0\"" + std::string(output) + " >/dev/full",
         OMNISTER_DOCTOR_NODE},
        said);
    EXPECT_EQ(doctor.wait(), 1) << output;
    EXPECT_EQ(readFile(said), "omnister: cannot write to standard output\n") << output;
  }
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "doctor_test"); }
