// SPDX-License-Identifier: Apache-2.0
// A recording of the rendered room, played by rosbag on its own clock: again and again, with
// pauses, at other rates, and hours later.
#include <sensor_msgs/PointCloud2.h>
#include <std_srvs/SetBool.h>

#include <map>
#include <set>

#include "child_process.h"
#include "ros/recorded_rig.h"
#include "ros/ros_test.h"
#include "ros/stereo/stereo_pipeline.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

using test::Collector;
using test::eventually;

constexpr int kFrames = 6;
const ros::Time kHoursLater = test::kBegin + ros::Duration(4 * 3600.0);

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
    test::recordRoom(later_bag_, kFrames, kHoursLater);
    ros::NodeHandle parameters("~stereo");
    parameters.setParam("fixed_frame", "stage_base");
    parameters.setParam("max_range", 20.0);
    stereo_ = std::make_unique<StereoPipeline>(ros::NodeHandle("camera"), parameters);
  }

  /// Until a cloud of every frame but the first of the recording that begins at `begin` came
  /// `times` more often. Whatever the lap and the time, the clouds of a frame are the same to the
  /// last bit.
  void expectLaps(std::size_t times, ros::Time begin = test::kBegin) {
    const ros::Time first_stamp = begin + ros::Duration(1.0);
    const ros::Time end = begin + ros::Duration(kFrames + 1.0);
    const std::size_t from = clouds_.size();
    std::map<ros::Time, std::size_t> seen;
    const bool done = eventually(
        [&] {
          seen.clear();
          const auto messages = clouds_.messages();
          for (std::size_t i = from; i < messages.size(); ++i)
            if (messages[i]->header.stamp > first_stamp && messages[i]->header.stamp < end)
              ++seen[messages[i]->header.stamp];
          std::size_t complete = 0;
          for (const auto& [stamp, count] : seen) complete += count >= times ? 1 : 0;
          return complete >= kFrames - 1;
        },
        90.0);
    ASSERT_TRUE(done) << seen.size() << " different clouds";
    ASSERT_EQ(seen.size(), kFrames - 1U);
    std::map<ros::Duration, sensor_msgs::PointCloud2ConstPtr> first;
    std::size_t compared = 0;
    for (const auto& cloud : clouds_.messages()) {
      const bool later = cloud->header.stamp > kHoursLater;
      const ros::Duration since = cloud->header.stamp - (later ? kHoursLater : test::kBegin);
      if (since == ros::Duration(1.0)) {
        // Time that goes on leaves the frames before as they are (max_age is for that).
        EXPECT_TRUE(later)
            << "the first frame has none before it, unless the last lap still counts";
        ++compared;
        continue;
      }
      const auto known = first.emplace(since, cloud);
      if (known.second) continue;
      ASSERT_EQ(known.first->second->data, cloud->data) << cloud->header.stamp;
      ++compared;
    }
    EXPECT_GE(compared, from + (kFrames - 1) * (times - 1));
  }

  test::TemporaryFolder folder_;
  const std::string bag_ = (folder_.path() / "room.bag").string();
  const std::string later_bag_ = (folder_.path() / "later.bag").string();
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
  {
    const Player slower(bag_, "2");
    expectLaps(1);
  }
  // The clock leaps on by hours, and back again.
  {
    const Player later(later_bag_, "4");
    expectLaps(2, kHoursLater);
  }
  const Player again(bag_, "4");
  expectLaps(1);
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "laps_test"); }
