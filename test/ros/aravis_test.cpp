// SPDX-License-Identifier: Apache-2.0
// The camera driver on a GigE Vision camera that goes away and comes back.
#include <dynamic_reconfigure/Reconfigure.h>
#include <gmock/gmock.h>
#include <message_filters/subscriber.h>
#include <message_filters/sync_policies/approximate_time.h>
#include <message_filters/synchronizer.h>
#include <rosgraph_msgs/Log.h>
#include <std_srvs/Trigger.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <sstream>

#include "child_process.h"
#include "omnister/sim/gige_server.h"
#include "ros/camera/camera_driver.h"
#include "ros/ros_test.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

using test::Collector;
using test::eventually;
using testing::HasSubstr;

constexpr double kLong = 60.0;

class AravisDriver : public testing::Test {
 protected:
  AravisDriver()
      : node_("gige_" + std::to_string(++count_)), private_("~" + node_.getNamespace().substr(1)) {
    options_.serial = "R-1";
    options_.size = {64, 48};
    options_.frame_rate_hz = 50.0;
    parameters_.store = (folder_.path() / "store").string();
    parameters_.retry_period_s = 0.2;
    parameters_.device = "aravis:R-1";
  }
  void serve() {
    server_ = std::make_unique<sim::GigeServer>(
        options_, [](device::Stamp) { return cv::Mat(48, 64, CV_8UC1, cv::Scalar(9)); });
  }
  void drive() { driver_ = std::make_unique<CameraDriver>(node_, private_, parameters_); }

  /// camera_node as a process of its own.
  std::unique_ptr<test::ChildProcess> startNode(std::vector<std::string> arguments) {
    output_ = (folder_.path() / arguments.at(0)).string();
    arguments.insert(arguments.begin(),
                     std::filesystem::read_symlink("/proc/self/exe").parent_path() / "camera_node");
    return std::make_unique<test::ChildProcess>(arguments, output_);
  }
  /// What the last one printed.
  std::string said() const {
    std::stringstream text;
    text << std::ifstream(output_).rdbuf();
    return text.str();
  }

  /// @return the configuration as the node tells it
  dynamic_reconfigure::Config configure(const std::string& key, double value) {
    ros::ServiceClient client =
        private_.serviceClient<dynamic_reconfigure::Reconfigure>("set_parameters");
    EXPECT_TRUE(client.waitForExistence(ros::Duration(kLong)));
    dynamic_reconfigure::Reconfigure call;
    dynamic_reconfigure::DoubleParameter parameter;
    parameter.name = key;
    parameter.value = value;
    call.request.config.doubles.push_back(parameter);
    EXPECT_TRUE(client.call(call));
    return call.response.config;
  }
  static double number(const dynamic_reconfigure::Config& config, const std::string& key) {
    for (const auto& entry : config.doubles) {
      if (entry.name == key) return entry.value;
    }
    return std::nan("");
  }

  static int count_;
  ros::NodeHandle node_, private_;
  test::TemporaryFolder folder_;
  std::string output_;
  sim::GigeServerOptions options_;
  CameraParameters parameters_;
  std::unique_ptr<sim::GigeServer> server_;
  std::unique_ptr<CameraDriver> driver_;  // goes first
};
int AravisDriver::count_ = 0;

TEST_F(AravisDriver, LiveValuesAreWrittenBackAsTheCameraTookThemAndSurviveALoss) {
  parameters_.settings.trigger = "off";
  drive();
  Collector<sensor_msgs::Image> images(node_, "image_raw");
  Collector<rosgraph_msgs::Log> log(ros::NodeHandle(), "/rosout");
  // Absent at start.
  serve();
  ASSERT_TRUE(eventually([&] { return images.size() >= 3; }, kLong));
  EXPECT_EQ(images.last()->encoding, "bgr8");
  EXPECT_EQ(images.last()->data.at(0), 9);

  EXPECT_EQ(number(configure("exposure_us", 3000.0), "exposure_us"), 3000.0);
  const dynamic_reconfigure::Config taken = configure("gain", 500.0);
  EXPECT_EQ(number(taken, "gain"), 24.0);
  EXPECT_EQ(number(taken, "exposure_us"), 3000.0);
  EXPECT_NEAR(number(taken, "frame_rate"), 50.0, 1e-6);
  double stored = 0.0;
  EXPECT_TRUE(eventually([&] { return private_.getParam("gain", stored) && stored == 24.0; }));

  for (int round = 0; round < 2; ++round) {
    server_.reset();
    ASSERT_TRUE(eventually(
        [&] {
          for (const auto& line : log.messages()) {
            if (line->level == rosgraph_msgs::Log::WARN &&
                line->msg.find("no frame for") != std::string::npos) {
              return true;
            }
          }
          return false;
        },
        kLong));
    const std::size_t had = images.size();
    serve();
    ASSERT_TRUE(eventually([&] { return images.size() > had + 3; }, kLong));
  }
  // It was powered down, and yet has its settings.
  const dynamic_reconfigure::Config again = configure("black_level", 1.0);
  EXPECT_EQ(number(again, "exposure_us"), 3000.0);
  EXPECT_EQ(number(again, "gain"), 24.0);
}

TEST_F(AravisDriver, ATriggerIsAService) {
  serve();
  parameters_.device = "aravis:127.0.0.1";
  parameters_.settings.trigger = "software";
  drive();
  Collector<sensor_msgs::Image> images(node_, "image_raw");
  ros::ServiceClient client = node_.serviceClient<std_srvs::Trigger>("trigger");
  std_srvs::Trigger call;
  ASSERT_TRUE(eventually([&] { return client.call(call) && call.response.success; }, kLong));
  ASSERT_TRUE(eventually([&] { return images.size() == 1; }, kLong));
  ASSERT_TRUE(client.call(call));
  EXPECT_TRUE(call.response.success) << call.response.message;
  ASSERT_TRUE(eventually([&] { return images.size() == 2; }, kLong));
}

TEST_F(AravisDriver, TwoTriggeredCamerasPairWithinTheStatedBound) {
  // As two_cameras.launch states it.
  constexpr double kMaxSkew = 0.005;
  constexpr int kPairs = 3;
  struct Eye {
    sim::GigeServerOptions options;
    std::unique_ptr<sim::GigeServer> server;
    std::unique_ptr<CameraDriver> driver;
    std::unique_ptr<Collector<sensor_msgs::Image>> images;
  };
  Eye eyes[2];
  for (Eye& eye : eyes) {
    const bool left = &eye == &eyes[0];
    eye.options = options_;
    eye.options.interface = left ? "127.0.0.1" : "127.0.0.2";
    eye.options.serial = left ? "L-1" : "R-1";
    eye.server = std::make_unique<sim::GigeServer>(
        eye.options, [](device::Stamp) { return cv::Mat(48, 64, CV_8UC1, cv::Scalar(9)); });
    CameraParameters parameters = parameters_;
    parameters.device = "aravis:" + eye.options.interface;
    parameters.settings.trigger = "line0";
    parameters.settings.ptp = true;
    const std::string name = left ? "left" : "right";
    eye.driver = std::make_unique<CameraDriver>(ros::NodeHandle(node_, name),
                                                ros::NodeHandle(private_, name), parameters);
    eye.images = std::make_unique<Collector<sensor_msgs::Image>>(node_, name + "/image_raw");
  }
  using Policy =
      message_filters::sync_policies::ApproximateTime<sensor_msgs::Image, sensor_msgs::Image>;
  message_filters::Subscriber<sensor_msgs::Image> left(node_, "left/image_raw", 10);
  message_filters::Subscriber<sensor_msgs::Image> right(node_, "right/image_raw", 10);
  Policy policy(8);
  policy.setMaxIntervalDuration(ros::Duration(kMaxSkew));
  message_filters::Synchronizer<Policy> synchronizer(static_cast<const Policy&>(policy), left,
                                                     right);
  std::mutex mutex;
  std::vector<std::pair<sensor_msgs::ImageConstPtr, sensor_msgs::ImageConstPtr>> pairs;
  const auto collect = [&](const sensor_msgs::ImageConstPtr& l,
                           const sensor_msgs::ImageConstPtr& r) {
    const std::lock_guard<std::mutex> lock(mutex);
    pairs.emplace_back(l, r);
  };
  synchronizer.registerCallback(
      boost::bind<void>(collect, boost::placeholders::_1, boost::placeholders::_2));
  const auto paired = [&] {
    const std::lock_guard<std::mutex> lock(mutex);
    return static_cast<int>(pairs.size());
  };
  // A pulse that comes before a camera streams is lost; one that reaches a busy camera late makes
  // no pair. Only pairs count.
  ASSERT_TRUE(eventually(
      [&] {
        const std::size_t had[2] = {eyes[0].images->size(), eyes[1].images->size()};
        for (Eye& eye : eyes) eye.server->pulseLine0();
        eventually(
            [&] { return eyes[0].images->size() > had[0] && eyes[1].images->size() > had[1]; },
            1.0);
        return paired() >= kPairs;
      },
      kLong));
  const std::lock_guard<std::mutex> lock(mutex);
  for (const auto& [l, r] : pairs) {
    EXPECT_LE(std::abs((l->header.stamp - r->header.stamp).toSec()), kMaxSkew);
  }
}

TEST_F(AravisDriver, DiagnosticsTellOfTheLink) {
  serve();
  parameters_.device = "aravis:127.0.0.1";
  drive();
  Collector<sensor_msgs::Image> images(node_, "image_raw");
  Collector<diagnostic_msgs::DiagnosticArray> diagnostics(ros::NodeHandle(), "/diagnostics");
  const auto value = [&](const std::string& key) -> std::string {
    std::string found;
    for (const auto& array : diagnostics.messages()) {
      for (const auto& status : array->status) {
        if (status.hardware_id != "R-1") continue;
        for (const auto& entry : status.values) {
          if (entry.key == key) found = entry.value;
        }
      }
    }
    return found;
  };
  EXPECT_TRUE(eventually([&] { return value("temperature [C]") == "41"; }, kLong));
  EXPECT_THAT(value("link"), HasSubstr("127.0.0.1"));
  EXPECT_EQ(value("frames incomplete"), "0");
}

TEST_F(AravisDriver, ANodeThatCannotStartSaysWhy) {
  ros::NodeHandle().setParam("bad_camera/frame_rate", -1.0);
  const std::unique_ptr<test::ChildProcess> node =
      startNode({"__name:=bad_camera", "_device:=aravis:nobody"});
  EXPECT_EQ(node->wait(), 1);
  EXPECT_THAT(said(), testing::AllOf(HasSubstr("/bad_camera/frame_rate"), HasSubstr("-1")));
}

TEST_F(AravisDriver, ANodeWithoutItsCameraEndsOrTriesAgainAsItIsTold) {
  serve();
  const std::unique_ptr<test::ChildProcess> ending =
      startNode({"__name:=ending", "_device:=aravis:nobody", "_exit_on_error:=true"});
  EXPECT_EQ(ending->wait(), 1);
  // One clear line, that names what there is.
  EXPECT_THAT(said(), testing::AllOf(HasSubstr("no camera \"nobody\" is there; there are: "),
                                     HasSubstr("R-1 at 127.0.0.1")));

  const std::unique_ptr<test::ChildProcess> staying =
      startNode({"__name:=staying", "_device:=aravis:nobody", "_retry_period:=0.1"});
  EXPECT_TRUE(eventually(
      [&] {
        return said().find("no camera, trying again every 0.1 s: no camera") != std::string::npos;
      },
      kLong));
  staying->signal(SIGINT);
  EXPECT_EQ(staying->wait(), 0);
}

TEST_F(AravisDriver, ABusyCameraAndAFormatThatItDoesNotHaveAreToldAndWaitedFor) {
  serve();
  parameters_.device = "aravis:127.0.0.1";
  Collector<rosgraph_msgs::Log> log(ros::NodeHandle(), "/rosout");
  const auto told = [&](const std::string& text) {
    const auto lines = log.messages();
    return std::any_of(lines.begin(), lines.end(), [&](const rosgraph_msgs::Log::ConstPtr& line) {
      return line->level == rosgraph_msgs::Log::WARN &&
             line->msg.find("no camera, trying again") == 0 &&
             line->msg.find(text) != std::string::npos;
    });
  };
  std::unique_ptr<device::Camera> other =
      device::openCamera(parameters_.device, parameters_.settings);
  drive();
  Collector<sensor_msgs::Image> images(node_, "image_raw");
  EXPECT_TRUE(eventually([&] { return told("is busy: another program controls it"); }, kLong));
  EXPECT_EQ(images.size(), 0u);
  other.reset();
  EXPECT_TRUE(eventually([&] { return images.size() > 0; }, kLong));
  driver_.reset();

  parameters_.settings.pixel_format = "Mono12Packed";
  drive();
  EXPECT_TRUE(eventually(
      [&] {
        return told("has no pixel format \"Mono12Packed\"; it offers Mono8, Mono16, BayerRG8");
      },
      kLong));
}

TEST_F(AravisDriver, WhatIsNotKnownOfACameraIsNotWrittenToItsParameters) {
  serve();
  parameters_.device = "aravis:127.0.0.1";
  drive();
  const dynamic_reconfigure::Config config = configure("gain", 3.0);
  // Every value is the camera's own, or the default.
  EXPECT_EQ(number(config, "gain"), 3.0);
  EXPECT_EQ(number(config, "black_level"), 0.0);
  EXPECT_EQ(number(config, "exposure_us"), 5000.0);
  // With these the node starts again.
  private_.setParam("device", parameters_.device);
  EXPECT_NO_THROW(loadCameraParameters(private_));
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "aravis_test"); }
