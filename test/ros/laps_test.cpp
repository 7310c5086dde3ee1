// SPDX-License-Identifier: Apache-2.0
// A recording of the rendered room, played by rosbag on its own clock: again and again, with
// pauses, at other rates.
#include <sensor_msgs/PointCloud2.h>
#include <std_srvs/SetBool.h>

#include <map>
#include <set>

#include "child_process.h"
#include "omnister/ros/stereo_pipeline.h"
#include "ros/recorded_rig.h"
#include "ros/ros_test.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

using test::Collector;
using test::eventually;

constexpr int kFrames = 6;

/// `rosbag play` of the recording, over and over.
class Player : public test::ChildProcess {
 public:
  Player(const std::string& bag, const std::string& rate)
      : ChildProcess({"rosbag", "play", "--quiet", "--clock", "--loop", "--rate", rate, bag,
                      "__name:=player"}) {}
  void pause(bool paused) {
    std_srvs::SetBool call;
    call.request.data = paused;
    ASSERT_TRUE(ros::service::waitForService("/player/pause_playback", 60000));
    ASSERT_TRUE(ros::service::call("/player/pause_playback", call));
  }
};

class Laps : public testing::Test {
 protected:
  Laps() {
    test::recordRoom(bag_, kFrames);
    ros::NodeHandle parameters("~stereo");
    parameters.setParam("fixed_frame", "stage_base");
    parameters.setParam("max_range", 20.0);
    stereo_ = std::make_unique<StereoPipeline>(ros::NodeHandle("camera"), parameters);
  }

  /// Until a cloud of every frame but the first came `times` more often. Whatever the lap, the
  /// clouds of a frame are the same to the last bit.
  void expectLaps(std::size_t times) {
    const std::size_t from = clouds_.size();
    std::map<ros::Time, std::size_t> seen;
    const bool done = eventually(
        [&] {
          seen.clear();
          const auto messages = clouds_.messages();
          for (std::size_t i = from; i < messages.size(); ++i) ++seen[messages[i]->header.stamp];
          std::size_t complete = 0;
          for (const auto& [stamp, count] : seen) complete += count >= times ? 1 : 0;
          return complete >= kFrames - 1;
        },
        90.0);
    ASSERT_TRUE(done) << seen.size() << " different clouds";
    ASSERT_EQ(seen.size(), kFrames - 1U);
    EXPECT_EQ(seen.count(test::kBegin + ros::Duration(1.0)), 0U)
        << "the first frame has none before it, unless the last lap still counts";
    std::map<ros::Time, sensor_msgs::PointCloud2ConstPtr> first;
    std::size_t compared = 0;
    for (const auto& cloud : clouds_.messages()) {
      const auto known = first.emplace(cloud->header.stamp, cloud);
      if (known.second) continue;
      ASSERT_EQ(known.first->second->data, cloud->data) << cloud->header.stamp;
      ++compared;
    }
    EXPECT_GE(compared, from + (kFrames - 1) * (times - 1));
  }

  test::TemporaryFolder folder_;
  const std::string bag_ = (folder_.path() / "room.bag").string();
  std::unique_ptr<StereoPipeline> stereo_;
  Collector<sensor_msgs::PointCloud2> clouds_{ros::NodeHandle("camera"), "points2"};
};

TEST_F(Laps, AreAllTheSameWhateverTheRateAndThePauses) {
  {
    Player player(bag_, "4");
    expectLaps(3);
    player.pause(true);
    ros::WallDuration(1.0).sleep();
    player.pause(false);
    expectLaps(1);
  }
  // Time begins anew, and passes at another rate.
  const Player slower(bag_, "2");
  expectLaps(1);
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "laps_test"); }
