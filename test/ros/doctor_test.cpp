// SPDX-License-Identifier: Apache-2.0
// The doctor before living nodes, each with one thing broken.
#include <gmock/gmock.h>
#include <tf2_ros/transform_broadcaster.h>
#include <unistd.h>

#include <atomic>
#include <filesystem>
#include <opencv2/core.hpp>
#include <thread>

#include "omnister/lens/lens_models.h"
#include "omnister/ros/conversions.h"
#include "omnister/ros/doctor_facts.h"
#include "omnister/ros/stereo_pipeline.h"
#include "ros/ros_test.h"

namespace omnister {
namespace {

using test::eventually;

LensFile lensFile(cv::Size size) {
  LensFile file;
  file.image_size = size;
  LensStructure structure;
  structure.model = "conic";
  file.lens = makeLens(structure, {0.5 * size.width, 0.5 * size.height}, size.width / 3.1, 1.5);
  return file;
}

/// A camera that slides to and fro between two places, of a textured scene at infinity, and the
/// stereo node that makes clouds of it. Every test has a namespace of its own.
class Doctor : public testing::Test {
 protected:
  Doctor() {
    const std::string name = testing::UnitTest::GetInstance()->current_test_info()->name();
    node_ = ros::NodeHandle("/" + name);
    folder_ = std::filesystem::temp_directory_path() /
              ("omnister_doctor_test." + std::to_string(getpid()));
    std::filesystem::create_directories(folder_);
    const std::string lens = (folder_ / "lens.yaml").string();
    writeLensFile(lens, lensFile({80, 60}));
    stereo_parameters_ = ros::NodeHandle("/" + name + "/stereo");
    stereo_parameters_.setParam("lens", lens);
    stereo_parameters_.setParam("fixed_frame", name + "_base");
    stereo_parameters_.setParam("min_baseline", 0.1);
    texture_.create(60, 80, CV_8UC1);
    cv::RNG(1).fill(texture_, cv::RNG::UNIFORM, 20, 230);
  }
  ~Doctor() override {
    stop_ = true;
    if (hand_.joinable()) hand_.join();
    std::filesystem::remove_all(folder_);
  }

  void start() {
    stereo_ = std::make_unique<StereoPipeline>(node_, stereo_parameters_);
    images_ = node_.advertise<sensor_msgs::Image>("image_raw", 4);
    hand_ = std::thread([this] {
      for (int lap = 0; !stop_; ++lap) {
        const double x = (lap / 8 % 2) * step_;
        const ros::Time now = ros::Time::now();
        if (tf_)
          transforms_.sendTransform(
              toTransformStamped(Pose(Eigen::Translation3d(x, 0, 0)), now, base(), optical()));
        if (publish_) {
          const sensor_msgs::ImagePtr image = toImage(texture_, "mono8");
          image->header.frame_id = optical();
          // Between two poses of the same place.
          image->header.stamp = now - ros::Duration(0.1);
          images_.publish(image);
        }
        ros::WallDuration(0.05).sleep();
      }
    });
  }
  std::string base() const { return node_.getNamespace().substr(1) + "_base"; }
  std::string optical() const { return node_.getNamespace().substr(1) + "_optical"; }
  std::vector<Finding> look() {
    DoctorOptions options;
    options.camera = node_.getNamespace();
    options.seconds = 1.2;
    return diagnose(gatherFacts(options));
  }
  /// Looks until the verdict is this one: on a loaded machine the first look may be too short.
  void expectVerdict(const std::string& code) {
    std::string seen;
    EXPECT_TRUE(eventually(
        [&] {
          const std::vector<Finding> findings = look();
          seen = findings.empty() ? "nothing" : findings.front().code;
          return seen == code;
        },
        60.0))
        << "the last verdict was: " << seen;
  }

  ros::NodeHandle node_, stereo_parameters_;
  std::filesystem::path folder_;
  cv::Mat texture_;
  std::atomic<bool> stop_{false}, publish_{true}, tf_{true};
  double step_ = 0.2;
  ros::Publisher images_;
  tf2_ros::TransformBroadcaster transforms_;
  std::unique_ptr<StereoPipeline> stereo_;
  std::thread hand_;
};

TEST_F(Doctor, SeesNoStereoNode) { expectVerdict("no_stereo_node"); }

TEST_F(Doctor, SeesThatNobodyPublishesImages) {
  stereo_ = std::make_unique<StereoPipeline>(node_, stereo_parameters_);
  expectVerdict("no_camera");
  images_ = node_.advertise<sensor_msgs::Image>("image_raw", 4);
  expectVerdict("no_images");
}

TEST_F(Doctor, SeesThatTheLensIsMissing) {
  stereo_parameters_.deleteParam("lens");
  start();
  expectVerdict("no_lens");
}

TEST_F(Doctor, SeesThatTheLensBelongsToAnotherSize) {
  writeLensFile(folder_ / "lens.yaml", lensFile({160, 120}));
  start();
  expectVerdict("size_mismatch");
}

TEST_F(Doctor, SeesThatTfIsMissing) {
  tf_ = false;
  start();
  expectVerdict("no_stage");
}

TEST_F(Doctor, SeesThatTheCameraStandsStill) {
  step_ = 0.0;
  start();
  expectVerdict("stage_not_moving");
}

TEST_F(Doctor, SeesThatTheCameraMovesTooLittle) {
  step_ = 0.03;
  start();
  expectVerdict("baseline_too_short");
}

TEST_F(Doctor, SeesThatImagesAreBlack) {
  texture_ = cv::Scalar(1);
  start();
  expectVerdict("dark_images");
}

TEST_F(Doctor, SeesWhichTestRejectsEveryPixel) {
  // Noise that is new in each image matches nowhere; here it is the same, so at infinity: out of
  // the search limits.
  stereo_parameters_.setParam("max_range", 1.0);
  start();
  std::string seen;
  EXPECT_TRUE(eventually(
      [&] {
        const std::vector<Finding> findings = look();
        seen = findings.empty() ? "nothing" : findings.front().code;
        return seen.find("all_") == 0;
      },
      60.0))
      << seen;
}

TEST(DoctorAnswers, WithinItsTimeWhateverTheAddress) {
  EXPECT_TRUE(answers(ros::master::getURI()));
  EXPECT_FALSE(answers("http://localhost:1/"));
  EXPECT_FALSE(answers("http://no-such-host.invalid:11311/"));
  EXPECT_FALSE(answers(""));
  EXPECT_FALSE(answers("http://nothing"));
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "doctor_test"); }
