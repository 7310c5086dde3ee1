// SPDX-License-Identifier: Apache-2.0
// A two-camera rig whose lens files are right, and one whose lens files are of another lens: what
// /diagnostics says of it.
#include <diagnostic_msgs/DiagnosticArray.h>
#include <gmock/gmock.h>
#include <sensor_msgs/PointCloud2.h>

#include <map>
#include <memory>

#include "omnister/calibration/rig_file.h"
#include "ros/message/conversions.h"
#include "ros/rendered_views.h"
#include "ros/ros_test.h"
#include "ros/stereo/stereo_pipeline.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

using diagnostic_msgs::DiagnosticStatus;
using test::eventually;
using test::kBaseline;
using test::views;

/// Two cameras that see the room, and a stereo node that believes in the given lens.
class Rig {
 public:
  Rig(const std::string& name, const LensFile& lens) : node_(name) {
    const std::filesystem::path file = folder_.path() / "lens.yaml";
    writeLensFile(file, lens);
    RigFile rig;
    rig.reference = rig.displaced = file;
    rig.T_ref_disp = Pose(Eigen::Translation3d(-kBaseline, 0, 0));
    writeRigFile(folder_.path() / "rig.yaml", rig);
    ros::NodeHandle parameters(name + "/stereo");
    parameters.setParam("mode", "rig");
    parameters.setParam("rig", (folder_.path() / "rig.yaml").string());
    parameters.setParam("max_range", 20.0);
    parameters.setParam("drift_period", 0.1);
    stereo_ = std::make_unique<StereoPipeline>(node_, parameters);
    for (const char* side : {"left/image_raw", "right/image_raw"})
      images_.push_back(node_.advertise<sensor_msgs::Image>(side, 5));
    points_ = std::make_unique<test::Collector<sensor_msgs::PointCloud2>>(node_, "points2", 1);
  }

  void publish() {
    const ros::Time stamp = ros::Time::now();
    for (std::size_t eye = 0; eye < images_.size(); ++eye) {
      // The left camera of the rig is where the room was seen from the second time.
      const sensor_msgs::ImagePtr image = toImage(eye == 0 ? views().right : views().left, "bgr8");
      image->header.stamp = stamp;
      image->header.frame_id = eye == 0 ? "left" : "right";
      images_[eye].publish(image);
    }
  }

 private:
  test::TemporaryFolder folder_;
  ros::NodeHandle node_;
  std::unique_ptr<StereoPipeline> stereo_;
  std::vector<ros::Publisher> images_;
  std::unique_ptr<test::Collector<sensor_msgs::PointCloud2>> points_;
};

TEST(Drift, IsToldOfTheRigThatHasItAlone) {
  LensFile other = test::lensFile();
  LensStructure structure;
  structure.model = "conic";
  other.lens = makeLens(structure, {216.0, 160.0}, 400.0 / 3.1, 1.6);
  Rig right("drift_right", test::lensFile());
  Rig wrong("drift_wrong", other);
  test::Collector<diagnostic_msgs::DiagnosticArray> diagnostics(ros::NodeHandle(), "/diagnostics");
  std::map<std::string, DiagnosticStatus> last;
  const auto verdict = [&](const std::string& name) -> std::string {
    for (const auto& value : last[name].values)
      if (value.key == "verdict") return value.value;
    return "";
  };
  std::size_t read = 0;
  ASSERT_TRUE(eventually(
      [&] {
        right.publish();
        wrong.publish();
        ros::WallDuration(0.1).sleep();
        const auto messages = diagnostics.messages();
        for (; read < messages.size(); ++read)
          for (const DiagnosticStatus& status : messages[read]->status) last[status.name] = status;
        return verdict("drift_right/stereo: calibration") == "good" &&
               verdict("drift_wrong/stereo: calibration") == "drift";
      },
      60.0))
      << "right: " << last["drift_right/stereo: calibration"].message
      << "; wrong: " << last["drift_wrong/stereo: calibration"].message;
  EXPECT_EQ(last["drift_right/stereo: calibration"].level, DiagnosticStatus::OK);
  const DiagnosticStatus& told = last["drift_wrong/stereo: calibration"];
  EXPECT_GE(told.level, DiagnosticStatus::WARN);
  EXPECT_THAT(told.message, testing::HasSubstr("off their epipolar curves"));
}

TEST(Drift, RefusesLimitsTheWrongWayRound) {
  ros::NodeHandle parameters("/drift_limits/stereo");
  parameters.setParam("drift_warn", 2.0);
  parameters.setParam("drift_error", 1.0);
  EXPECT_THROW(StereoPipeline(ros::NodeHandle("/drift_limits"), parameters), Error);
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "drift_test"); }
