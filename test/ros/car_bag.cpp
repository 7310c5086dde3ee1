// SPDX-License-Identifier: Apache-2.0
// car_bag SIDE OUT.bag: the real sequence planesweep_car_fisheye as a recording of this package's
// camera on a stage: camera/image_raw, camera/camera_info, camera/lens_model, /tf and /tf_static.
// The stage's base stands where the camera was in the first frame. Exit code 77 when the data is
// not there.
#include <ros/time.h>
#include <rosbag/bag.h>
#include <tf2_msgs/TFMessage.h>

#include <boost/make_shared.hpp>
#include <filesystem>
#include <iostream>

#include "ros/message/conversions.h"
#include "unit/stereo/real_data.h"

namespace omnister {
namespace {

/// A message that late subscribers of the replay get, too.
template <typename Message>
void writeLatched(rosbag::Bag* bag, const std::string& topic, const ros::Time& stamp,
                  const Message& message) {
  const auto header = boost::make_shared<ros::M_string>();
  (*header)["topic"] = topic;
  (*header)["type"] = ros::message_traits::datatype(message);
  (*header)["md5sum"] = ros::message_traits::md5sum(message);
  (*header)["message_definition"] = ros::message_traits::definition(message);
  (*header)["latching"] = "1";
  bag->write(topic, stamp, message, header);
}

ros::Time stampOf(const std::string& image) {
  const std::string stem = std::filesystem::path(image).stem().string();
  const std::uint64_t microseconds = std::stoull(stem.substr(stem.rfind('_') + 1));
  return ros::Time().fromNSec(microseconds * 1000);
}

void make(const std::string& side, const std::string& out) {
  const test::CarSequence car = test::readCarSequence(side);
  const std::string optical = "camera_optical";
  rosbag::Bag bag(out, rosbag::bagmode::Write);
  const ros::Time begin = stampOf(car.images.front());

  LensFile file;
  file.image_size = car.size;
  file.lens = car.lens.lens;
  std_msgs::Header header;
  header.stamp = begin;
  header.frame_id = optical;
  writeLatched(&bag, "/camera/lens_model", begin, toLensModelMessage(file, header));
  tf2_msgs::TFMessage mount;
  mount.transforms = {toTransformStamped(Pose::Identity(), begin, "stage_carriage", "camera_link"),
                      toTransformStamped(opticalInLink(), begin, "camera_link", optical)};
  writeLatched(&bag, "/tf_static", begin, mount);

  const sensor_msgs::CameraInfo calibration = toCameraInfo(file);
  for (std::size_t i = 0; i < car.images.size(); ++i) {
    header.stamp = stampOf(car.images[i]);
    const Pose moved = car.T_ref_disp(0, i);
    tf2_msgs::TFMessage transforms;
    transforms.transforms = {toTransformStamped(opticalInLink() * moved * opticalInLink().inverse(),
                                                header.stamp, "stage_base", "stage_carriage")};
    bag.write("/tf", header.stamp, transforms);
    sensor_msgs::CameraInfo info = calibration;
    info.header = header;
    bag.write("/camera/camera_info", header.stamp, info);
    const sensor_msgs::ImagePtr image = toImage(car.image(i), "mono8");
    image->header = header;
    bag.write("/camera/image_raw", header.stamp, image);
  }
  bag.close();
  std::cout << out << ": " << car.images.size() << " frames, lens fitted to " << car.lens.rms_px
            << " px RMS" << std::endl;
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) {
  if (argc != 3) {
    std::cerr << "usage: car_bag left|right OUT.bag" << std::endl;
    return 2;
  }
  try {
    if (!std::filesystem::exists(omnister::test::dataFolder("planesweep_car_fisheye"))) {
      std::cout << "no ../shared/data/planesweep_car_fisheye: " << argv[2] << " is empty"
                << std::endl;
      rosbag::Bag(argv[2], rosbag::bagmode::Write).close();
      return 0;
    }
    omnister::make(argv[1], argv[2]);
  } catch (const std::exception& e) {
    std::cerr << "car_bag: " << e.what() << std::endl;
    return 1;
  }
  return 0;
}
