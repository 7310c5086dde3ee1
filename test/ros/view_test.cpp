// SPDX-License-Identifier: Apache-2.0
#include <dynamic_reconfigure/Reconfigure.h>
#include <gmock/gmock.h>
#include <tf2_ros/buffer.h>
#include <tf2_ros/transform_listener.h>

#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>
#include <set>
#include <string>

#include "omnister/lens/lens_models.h"
#include "ros/message/conversions.h"
#include "ros/ros_test.h"
#include "ros/view/view_server.h"

namespace omnister {
namespace {

using test::Collector;
using test::eventually;

LensFile lensFile() {
  LensFile file;
  file.image_size = {400, 300};
  LensStructure structure;
  structure.model = "conic";
  file.lens = makeLens(structure, {201.3, 148.2}, 400.0 / 3.1, 1.6);
  return file;
}

/// A camera whose picture is black but for one soft dot, where the lens shows `point`.
cv::Mat pictureOf(const Eigen::Vector3d& point) {
  const LensFile file = lensFile();
  const auto pixel = file.lens->project(point);
  EXPECT_TRUE(pixel);
  cv::Mat image(file.image_size, CV_8UC1);
  for (int v = 0; v < image.rows; ++v)
    for (int u = 0; u < image.cols; ++u)
      image.at<uchar>(v, u) = cv::saturate_cast<uchar>(
          250.0 * std::exp(-(Eigen::Vector2d(u, v) - *pixel).squaredNorm() / 8.0));
  return image;
}

Eigen::Vector2d brightest(const sensor_msgs::Image& image) {
  const cv::Mat pixels(static_cast<int>(image.height), static_cast<int>(image.width), CV_8UC1,
                       const_cast<std::uint8_t*>(image.data.data()), image.step);
  const cv::Moments m = cv::moments(pixels);
  return {m.m10 / m.m00, m.m01 / m.m00};
}

class ViewNode : public testing::Test {
 protected:
  void SetUp() override {
    const std::string name = testing::UnitTest::GetInstance()->current_test_info()->name();
    node_ = ros::NodeHandle("/" + name);
    private_node_ = ros::NodeHandle("/" + name + "/view_node");
    private_node_.setParam("pan", 0.5);
    private_node_.setParam("tilt", -0.2);
    private_node_.setParam("roll", 0.1);
    images_ = node_.advertise<sensor_msgs::Image>("image_raw", 10);
    ranges_ = node_.advertise<sensor_msgs::Image>("range", 10);
    lenses_ = node_.advertise<LensModelMessage>("lens_model", 1, true);
  }
  void start() {
    view_ = std::make_unique<ViewServer>(node_, private_node_);
    std_msgs::Header header;
    header.stamp = ros::Time::now();
    header.frame_id = optical();
    lenses_.publish(toLensModelMessage(lensFile(), header));
  }
  std::string optical() const { return node_.getNamespace().substr(1) + "_optical"; }
  void publish(ros::Publisher& publisher, const sensor_msgs::ImagePtr& image) {
    image->header.stamp = ros::Time::now();
    image->header.frame_id = optical();
    publisher.publish(image);
  }

  ros::NodeHandle node_, private_node_;
  ros::Publisher images_, ranges_, lenses_;
  tf2_ros::Buffer tf_;
  tf2_ros::TransformListener listener_{tf_};
  std::unique_ptr<ViewServer> view_;
};

TEST_F(ViewNode, APinholeWithItsCameraInfoAndFrameFindsAPointWhereItIs) {
  start();
  Collector<sensor_msgs::Image> views(node_, "view/image_raw");
  Collector<sensor_msgs::CameraInfo> infos(node_, "view/camera_info");
  const Eigen::Vector3d point(0.9, -0.1, 1.2);
  const cv::Mat picture = pictureOf(point);
  ASSERT_TRUE(eventually([&] { return images_.getNumSubscribers() > 0 && views.connected(); }));
  ASSERT_TRUE(eventually([&] {
    publish(images_, toImage(picture, "mono8"));
    ros::WallDuration(0.05).sleep();
    return views.size() > 0 && infos.size() > 0;
  }));
  const sensor_msgs::Image view = *views.messages().front();
  const sensor_msgs::CameraInfo info = *infos.messages().front();
  EXPECT_EQ(view.header, info.header);
  EXPECT_EQ(view.encoding, "mono8");
  EXPECT_EQ(view.width, 640u);
  EXPECT_EQ(info.width, 640u);
  EXPECT_EQ(info.distortion_model, "plumb_bob");
  EXPECT_THAT(info.D, testing::Each(0.0));
  EXPECT_NEAR(info.K[0], 320.0, 1e-9) << "90 degrees over 640 pixels";
  // What any node would do: the point into the frame of the view, then K.
  ASSERT_TRUE(
      eventually([&] { return tf_.canTransform(view.header.frame_id, optical(), ros::Time()); }));
  const Pose T_view_camera = fromTransform(
      tf_.lookupTransform(view.header.frame_id, optical(), ros::Time()).transform, "tf");
  const Eigen::Vector3d at = T_view_camera * point;
  ASSERT_GT(at.z(), 0.0);
  const Eigen::Vector2d expected(info.K[0] * at.x() / at.z() + info.K[2],
                                 info.K[4] * at.y() / at.z() + info.K[5]);
  EXPECT_GT((expected - Eigen::Vector2d(319.5, 239.5)).norm(), 20.0) << "a point off the axis";
  EXPECT_LT((brightest(view) - expected).norm(), 0.5);
}

TEST_F(ViewNode, DepthOfAPlaneIsAlongTheAxisOfTheView) {
  start();
  Collector<sensor_msgs::Image> depths(node_, "view/depth/image_raw");
  Collector<sensor_msgs::CameraInfo> infos(node_, "view/depth/camera_info");
  // A wall 2 m ahead of the camera, with a hole of unknown range.
  const LensFile file = lensFile();
  cv::Mat range(file.image_size, CV_32FC1, cv::Scalar(std::numeric_limits<float>::quiet_NaN()));
  int known = 0;
  for (int v = 0; v < range.rows; ++v)
    for (int u = 0; u < range.cols; ++u) {
      const auto ray = file.lens->unproject({static_cast<double>(u), static_cast<double>(v)});
      if (!ray || ray->z() < 0.1 || (std::abs(u - 200) < 5 && std::abs(v - 150) < 5)) continue;
      range.at<float>(v, u) = static_cast<float>(2.0 / ray->z());
      ++known;
    }
  ASSERT_GT(known, 50000);
  ASSERT_TRUE(eventually([&] {
    publish(ranges_, toImage(range, "32FC1"));
    ros::WallDuration(0.05).sleep();
    return depths.size() > 0 && infos.size() > 0;
  }));
  const sensor_msgs::Image& message = *depths.messages().front();
  const sensor_msgs::CameraInfo& info = *infos.messages().front();
  EXPECT_EQ(message.header, info.header);
  ASSERT_EQ(message.encoding, "32FC1");
  const cv::Mat depth(static_cast<int>(message.height), static_cast<int>(message.width), CV_32FC1,
                      const_cast<std::uint8_t*>(message.data.data()), message.step);
  ASSERT_TRUE(eventually(
      [&] { return tf_.canTransform(optical(), message.header.frame_id, ros::Time()); }));
  const Pose T_camera_view = fromTransform(
      tf_.lookupTransform(optical(), message.header.frame_id, ros::Time()).transform, "tf");
  int compared = 0, holes = 0;
  for (int v = 0; v < depth.rows; v += 3)
    for (int u = 0; u < depth.cols; u += 3) {
      const float z = depth.at<float>(v, u);
      if (std::isnan(z)) {
        ++holes;
        continue;
      }
      const Eigen::Vector3d point =
          T_camera_view *
          Eigen::Vector3d((u - info.K[2]) / info.K[0] * z, (v - info.K[5]) / info.K[4] * z, z);
      // The nearest pixel of the camera is up to 0.7 px off, 0.3 degrees.
      ASSERT_NEAR(point.z(), 2.0, 0.02 + 0.02 * std::abs(point.x())) << u << " " << v;
      ++compared;
    }
  EXPECT_GT(compared, 20000);
  EXPECT_GT(holes, 10);
}

TEST_F(ViewNode, TurnsAndZoomsLive) {
  start();
  Collector<sensor_msgs::Image> views(node_, "view/image_raw");
  Collector<sensor_msgs::CameraInfo> infos(node_, "view/camera_info");
  ros::ServiceClient client =
      private_node_.serviceClient<dynamic_reconfigure::Reconfigure>("set_parameters");
  ASSERT_TRUE(client.waitForExistence(ros::Duration(30.0)));
  const auto set = [&](const std::string& name, double value) {
    dynamic_reconfigure::Reconfigure call;
    dynamic_reconfigure::DoubleParameter parameter;
    parameter.name = name;
    parameter.value = value;
    call.request.config.doubles.push_back(parameter);
    EXPECT_TRUE(client.call(call));
    for (const auto& answer : call.response.config.doubles)
      if (answer.name == name) return answer.value;
    return std::nan("");
  };
  EXPECT_EQ(set("pan", 0.0), 0.0);
  EXPECT_EQ(set("tilt", 0.0), 0.0);
  EXPECT_EQ(set("roll", 0.0), 0.0);
  EXPECT_EQ(set("pan", std::nan("")), 0.0) << "what is no number changes nothing";
  EXPECT_EQ(set("pan", 100.0), ViewConfig::__getMax__().pan);
  EXPECT_EQ(set("pan", 0.0), 0.0);
  EXPECT_EQ(set("hfov", 6.0), 3.0) << "the widest pinhole: who asked is told";
  EXPECT_EQ(set("pan", 99.0), M_PI) << "clamped";
  EXPECT_EQ(set("pan", 0.25), 0.25);
  EXPECT_EQ(set("hfov", 1.0), 1.0);
  // A point straight along the turned axis stands in the middle, whatever the zoom.
  const cv::Mat picture = pictureOf({std::sin(0.25), 0.0, std::cos(0.25)});
  const std::size_t before = views.size();
  ASSERT_TRUE(eventually([&] {
    publish(images_, toImage(picture, "mono8"));
    ros::WallDuration(0.05).sleep();
    return views.size() > before && infos.size() > 0;
  }));
  EXPECT_NEAR(infos.last()->K[0], 320.0 / std::tan(0.5), 1e-6);
  EXPECT_LT((brightest(*views.last()) - Eigen::Vector2d(319.5, 239.5)).norm(), 0.7);
}

TEST_F(ViewNode, APanoramaHasNoPinholeCameraInfo) {
  private_node_.setParam("projection", "equirectangular");
  private_node_.setParam("hfov", 3.2);
  start();
  Collector<sensor_msgs::Image> views(node_, "view/image_raw");
  Collector<sensor_msgs::CameraInfo> infos(node_, "view/camera_info");
  ASSERT_TRUE(eventually([&] {
    publish(images_, toImage(pictureOf({0.5, 0, 1}), "mono8"));
    ros::WallDuration(0.05).sleep();
    return views.size() > 0 && infos.size() > 0;
  }));
  EXPECT_EQ(infos.last()->K[0], 0.0);
  EXPECT_EQ(infos.last()->distortion_model, "");
}

TEST_F(ViewNode, ListensOnlyToWhatIsWanted) {
  start();
  for (const auto& [topic, source, other] :
       {std::tuple(std::string("view/image_raw"), &images_, &ranges_),
        std::tuple(std::string("view/camera_info"), &images_, &ranges_),
        std::tuple(std::string("view/depth/image_raw"), &ranges_, &images_),
        std::tuple(std::string("view/depth/camera_info"), &ranges_, &images_)}) {
    EXPECT_EQ(source->getNumSubscribers(), 0u);
    std::unique_ptr<Collector<sensor_msgs::Image>> images;
    std::unique_ptr<Collector<sensor_msgs::CameraInfo>> infos;
    if (topic.find("info") == std::string::npos)
      images = std::make_unique<Collector<sensor_msgs::Image>>(node_, topic);
    else
      infos = std::make_unique<Collector<sensor_msgs::CameraInfo>>(node_, topic);
    ros::Publisher* const wanted = source;
    EXPECT_TRUE(eventually([&] { return wanted->getNumSubscribers() == 1; })) << topic;
    EXPECT_EQ(other->getNumSubscribers(), 0u) << topic;
    images.reset();
    infos.reset();
    EXPECT_TRUE(eventually([&] { return wanted->getNumSubscribers() == 0; })) << topic;
  }
}

TEST_F(ViewNode, RefusesParametersByName) {
  private_node_.setParam("hfov", 3.1);
  try {
    start();
    FAIL() << "a pinhole of 178 degrees was taken";
  } catch (const Error& error) {
    EXPECT_THAT(error.what(), testing::HasSubstr("hfov"));
    EXPECT_THAT(error.what(), testing::HasSubstr("3.1"));
  }
}

TEST_F(ViewNode, GoesOnAfterBadMessages) {
  start();
  Collector<sensor_msgs::Image> views(node_, "view/image_raw");
  Collector<sensor_msgs::Image> depths(node_, "view/depth/image_raw");
  ASSERT_TRUE(
      eventually([&] { return images_.getNumSubscribers() && ranges_.getNumSubscribers(); }));
  const cv::Mat picture = pictureOf({0.5, 0, 1});
  for (const std::string encoding : {"32FC1", "nonsense", "mono8"}) {
    for (ros::Publisher* publisher : {&images_, &ranges_}) {
      const sensor_msgs::ImagePtr image = toImage(picture, "mono8");
      image->encoding = encoding;
      image->data.resize(100);
      publish(*publisher, image);
      publish(*publisher, toImage(cv::Mat(5, 5, CV_32FC1, cv::Scalar(1.0)), "32FC1"));
    }
  }
  EXPECT_TRUE(eventually([&] {
    publish(images_, toImage(picture, "mono8"));
    ros::WallDuration(0.05).sleep();
    return views.size() > 0;
  }));
  EXPECT_EQ(depths.size(), 0u);
}

TEST_F(ViewNode, TellsTfOfFewFramesHoweverManyImagesName) {
  start();
  Collector<sensor_msgs::Image> views(node_, "view/image_raw");
  ASSERT_TRUE(eventually([&] { return images_.getNumSubscribers() > 0; }));
  const cv::Mat picture = pictureOf({0.5, 0, 1});
  std::set<std::string> seen;
  int named = 0;
  const auto show = [&] {
    const sensor_msgs::ImagePtr image = toImage(picture, "mono8");
    image->header.stamp = ros::Time::now();
    image->header.frame_id = "stranger_" + std::to_string(named++ % 40);
    images_.publish(image);
    ros::WallDuration(0.02).sleep();
    for (const auto& view : views.messages()) seen.insert(view->header.frame_id);
    views.clear();
  };
  // The lens' own frame is the sixteenth.
  ASSERT_TRUE(eventually([&] {
    show();
    return seen.size() >= 15;
  }));
  for (int i = 0; i < 80; ++i) show();
  EXPECT_EQ(seen.size(), 15u);
  EXPECT_TRUE(eventually([&] {
    publish(images_, toImage(picture, "mono8"));
    ros::WallDuration(0.02).sleep();
    const auto last = views.last();
    return last && last->header.frame_id.find("stranger") == std::string::npos;
  }));
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "view_test"); }
