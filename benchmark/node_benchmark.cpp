// SPDX-License-Identifier: Apache-2.0
/// @file How many clouds a second the stereo node makes, from image messages to published clouds,
/// with publisher and subscriber in the node's process, as nodelets have them. Needs a ROS master.
#include <omnister/StageTimes.h>
#include <ros/ros.h>
#include <sensor_msgs/PointCloud2.h>

#include <CLI/CLI.hpp>
#include <atomic>
#include <cstdio>
#include <filesystem>
#include <map>
#include <memory>
#include <mutex>
#include <opencv2/imgproc.hpp>
#include <string>
#include <vector>

#include "measure.h"
#include "omnister/calibration/rig_file.h"
#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "omnister/sim/scene.h"
#include "ros/message/conversions.h"
#include "ros/stereo/stereo_pipeline.h"
#include "stereo_pair.h"
#include "temporary_folder.h"

namespace omnister::bench {
namespace {

struct Settings {
  int width = 1280, height = 960;
  int clouds = 100;
  int threads = 0;
  bool color = false;
};

/// Publishes a pair whenever fewer than two are on their way.
class Loop {
 public:
  Loop(const Settings& settings, const StereoCase& pair)
      : settings_(settings), node_("bench_stereo") {
    LensFile lens;
    lens.lens = pair.geometry.reference_lens;
    lens.image_size = pair.reference.size();
    const std::string lens_path = (folder_.path() / "lens.yaml").string();
    writeLensFile(lens_path, lens);
    RigFile rig;
    rig.reference = rig.displaced = lens_path;
    rig.T_ref_disp = pair.geometry.displaced[0].T_ref_disp;
    const std::string rig_path = (folder_.path() / "rig.yaml").string();
    writeRigFile(rig_path, rig);
    ros::NodeHandle private_node("~stereo");
    private_node.setParam("mode", "rig");
    private_node.setParam("rig", rig_path);
    private_node.setParam("threads", settings.threads);
    stereo_ = std::make_unique<StereoPipeline>(node_, private_node);
    const auto message = [&](const cv::Mat& grey, const char* frame) {
      cv::Mat picture = grey;
      if (settings.color) cv::cvtColor(grey, picture, cv::COLOR_GRAY2BGR);
      sensor_msgs::ImagePtr image = toImage(picture, settings.color ? "bgr8" : "mono8");
      image->header.frame_id = frame;
      return image;
    };
    images_[0] = message(pair.reference, "left");
    images_[1] = message(pair.displaced[0], "right");
    publishers_[0] = node_.advertise<sensor_msgs::Image>("left/image_raw", 4);
    publishers_[1] = node_.advertise<sensor_msgs::Image>("right/image_raw", 4);
    points_ = node_.subscribe<sensor_msgs::PointCloud2>(
        "points2", 4, [this](const sensor_msgs::PointCloud2::ConstPtr&) { ++clouds_; });
    times_ = node_.subscribe("timing", 1000, &Loop::onTimes, this);
  }

  void run() {
    ros::AsyncSpinner spinner(2);
    spinner.start();
    const auto there = [&] {
      return publishers_[0].getNumSubscribers() > 0 && publishers_[1].getNumSubscribers() > 0;
    };
    while (ros::ok() && !there()) ros::WallDuration(0.01).sleep();
    constexpr int kWarm = 10;
    until(kWarm);
    stages_.clear();
    const Instant start = Instant::now();
    const int from = clouds_;
    until(from + settings_.clouds);
    const Instant end = Instant::now();
    const int made = clouds_ - from;
    const double cpu_ms = 1e3 * (end.cpu - start.cpu) / made;
    const int cores = threadCount(settings_.threads);
    std::printf(
        "%dx%d, %s, %d cores: %.1f clouds a second by the clock; %.1f ms of processor time a "
        "cloud, which is %.1f a second where nothing else runs\n",
        settings_.width, settings_.height, settings_.color ? "bgr8" : "mono8", cores,
        made / (end.wall - start.wall), cpu_ms, 1e3 * cores / cpu_ms);
    const std::lock_guard<std::mutex> lock(mutex_);
    std::printf("medians of the stages [ms]:");
    for (auto& [stage, seconds] : stages_)
      std::printf("  %s %.1f", stage.c_str(), 1e3 * medianOf(seconds));
    std::printf("\n");
  }

 private:
  void onTimes(const StageTimes& times) {
    const std::lock_guard<std::mutex> lock(mutex_);
    for (std::size_t i = 0; i < times.stages.size(); ++i)
      stages_[times.stages[i]].push_back(times.seconds[i]);
  }

  void until(int clouds) {
    int sent = clouds_;
    ros::WallTime last = ros::WallTime::now();
    while (ros::ok() && clouds_ < clouds) {
      // One that was dropped is not waited for for ever.
      if (ros::WallTime::now() - last > ros::WallDuration(5.0)) sent = clouds_;
      if (sent - clouds_ >= 2) {
        ros::WallDuration(0.0005).sleep();
        continue;
      }
      const ros::Time stamp = ros::Time::now();
      for (int i = 0; i < 2; ++i) {
        // Messages are shared with their receivers, so each is a new one; its pixels are copied as
        // a camera's driver would.
        auto message = boost::make_shared<sensor_msgs::Image>(*images_[i]);
        message->header.stamp = stamp;
        publishers_[i].publish(message);
      }
      ++sent;
      last = ros::WallTime::now();
    }
  }

  const Settings settings_;
  test::TemporaryFolder folder_;
  ros::NodeHandle node_;
  std::unique_ptr<StereoPipeline> stereo_;
  sensor_msgs::ImagePtr images_[2];
  ros::Publisher publishers_[2];
  ros::Subscriber points_, times_;
  std::atomic<int> clouds_{0};
  std::mutex mutex_;
  std::map<std::string, std::vector<double>> stages_;
};

int run(int argc, char** argv) {
  ros::init(argc, argv, "bench_node", ros::init_options::AnonymousName);
  Settings settings;
  CLI::App app("Clouds a second of the stereo node, image messages to published clouds");
  app.add_option("--width", settings.width)->check(CLI::Range(64, 8192))->capture_default_str();
  app.add_option("--height", settings.height)->check(CLI::Range(64, 8192))->capture_default_str();
  app.add_option("--clouds", settings.clouds, "That are timed")
      ->check(CLI::Range(1, 100000))
      ->capture_default_str();
  app.add_option("--threads", settings.threads, "Of the matcher; 0: every core")
      ->check(CLI::Range(0, 256))
      ->capture_default_str();
  app.add_flag("--color", settings.color, "Images of bgr8 in place of mono8");
  CLI11_PARSE(app, argc, argv);
  const sim::ScenePtr scene = sim::readScene(std::string(OMNISTER_SCENES) + "/room.yaml");
  const cv::Size size(settings.width, settings.height);
  Loop(settings, makeCase("room", *scene, equidistant180(size), size)).run();
  return 0;
}

}  // namespace
}  // namespace omnister::bench

int main(int argc, char** argv) {
  return omnister::bench::report("omnister_bench_node",
                                 [&] { return omnister::bench::run(argc, argv); });
}
