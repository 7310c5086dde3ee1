// SPDX-License-Identifier: Apache-2.0
// The camera driver as a nodelet runs it, with a listener in the same process: what it costs beside
// bare_aravis_loop (see camera_cost.py).
//   camera_driver_loop ADDRESS WIDTH HEIGHT RATE PACKET_BYTES SECONDS
// prints a line when the driver begins; then frames and seconds of processor time: all; without a
// driver, as the threads of any ROS node look around ten times a second; of the thread in which the
// listener is called.
#include <ros/ros.h>
#include <sensor_msgs/Image.h>
#include <sys/resource.h>
#include <time.h>

#include <atomic>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <thread>

#include "ros/camera/camera_driver.h"
#include "ros/node/callback_threads.h"

namespace {

double processorSeconds() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  const auto seconds = [](const timeval& t) {
    return static_cast<double>(t.tv_sec) + 1e-6 * static_cast<double>(t.tv_usec);
  };
  return seconds(usage.ru_utime) + seconds(usage.ru_stime);
}

/// Of the calling thread.
double threadSeconds() {
  timespec time{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);
  return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

}  // namespace

int main(int argc, char** argv) {
  ros::init(argc, argv, "camera_driver_loop", ros::init_options::AnonymousName);
  if (argc != 7) return 2;
  ros::NodeHandle node("bench"), private_node("~");
  ros::AsyncSpinner spinner(1);
  spinner.start();
  std::atomic<int> frames{0};
  std::atomic<double> listener{0.0};
  omnister::CallbackThreads listening;
  const ros::Subscriber images = listening.on(node).subscribe<sensor_msgs::Image>(
      "image_raw", 4,
      boost::function<void(const sensor_msgs::ImageConstPtr&)>(
          [&](const sensor_msgs::ImageConstPtr&) {
            listener = threadSeconds();
            ++frames;
          }));
  const auto seconds = std::chrono::seconds(std::atoi(argv[6]));
  const auto spentDuring = [](std::chrono::seconds time) {
    const double before = processorSeconds();
    std::this_thread::sleep_for(time);
    return processorSeconds() - before;
  };
  try {
    constexpr std::chrono::seconds kRest(4);
    std::this_thread::sleep_for(std::chrono::seconds(1));
    const double rest = spentDuring(kRest) / static_cast<double>(kRest.count()) *
                        static_cast<double>(seconds.count());
    std::puts("the driver begins");
    std::fflush(stdout);
    listening.start();
    omnister::CameraParameters parameters;
    parameters.device = std::string("aravis:") + argv[1];
    parameters.store = std::filesystem::temp_directory_path().string();
    parameters.settings.size = {std::atoi(argv[2]), std::atoi(argv[3])};
    parameters.settings.offset = {0, 0};
    parameters.settings.frame_rate_hz = std::atof(argv[4]);
    parameters.settings.packet_size = std::atoi(argv[5]);
    const omnister::CameraDriver driver(node, private_node, parameters);
    while (ros::ok() && frames < 30) std::this_thread::sleep_for(std::chrono::milliseconds(10));
    const int had = frames;
    const double listener_then = listener;
    const double all = spentDuring(seconds);
    std::printf("%d %.4f %.4f %.4f\n", frames - had, all, rest, listener - listener_then);
  } catch (const std::exception& e) {
    std::fprintf(stderr, "%s\n", e.what());
    return 1;
  }
  return 0;
}
