// SPDX-License-Identifier: Apache-2.0
#include <actionlib/client/simple_action_client.h>
#include <gmock/gmock.h>
#include <std_srvs/SetBool.h>
#include <std_srvs/Trigger.h>
#include <unistd.h>

#include <atomic>
#include <cmath>
#include <filesystem>
#include <functional>

#include "omnister/common/file_io.h"
#include "ros/calibration/calibration_server.h"
#include "ros/message/conversions.h"
#include "ros/rig_drivers.h"
#include "ros/ros_test.h"

namespace omnister {
namespace {

using test::Collector;
using test::eventually;
using Client = actionlib::SimpleActionClient<CalibrateAction>;
using State = actionlib::SimpleClientGoalState;

const std::string kSource = OMNISTER_SOURCE_DIR;

class Calibration : public testing::Test {
 protected:
  Calibration()
      : store_(std::filesystem::temp_directory_path() /
               ("omnister_calibration_test." + std::to_string(getpid()))) {
    private_node_.setParam("target", kSource + "/config/demo/target.yaml");
    private_node_.setParam("store", store_.string());
    private_node_.setParam("camera_name", "wide");
  }
  ~Calibration() override { std::filesystem::remove_all(store_); }

  ros::NodeHandle node_{"cell"};
  ros::NodeHandle camera_node_{"cell/camera"};
  ros::NodeHandle private_node_{"~calibration"};
  const std::filesystem::path store_;
};

SimRigParameters rigParameters() {
  SimRigParameters parameters;
  parameters.scene = kSource + "/config/scenes/room.yaml";
  parameters.boards = kSource + "/config/demo/boards.yaml";
  parameters.lens = kSource + "/config/demo/lens.yaml";
  parameters.stage.homed = true;
  parameters.render.adaptive = true;
  parameters.camera.frame_rate_hz = 8.0;
  return parameters;
}

TEST_F(Calibration, FitsTheLensOfTheSimulatedCameraAndTellsEverybody) {
  const SimRigParameters parameters = rigParameters();
  const test::RigWithDrivers rig(node_, ros::NodeHandle("~rig"), parameters);
  const CalibrationServer calibration(camera_node_, private_node_);
  Collector<LensModelMessage> lenses(camera_node_, "lens_model");
  Collector<sensor_msgs::Image> residuals(camera_node_, "residuals");
  Client client(camera_node_, "calibrate", false);
  ASSERT_TRUE(client.waitForServer(ros::Duration(20.0)));

  // Whoever holds the board: it rests until a view of it is taken, and never longer than three
  // seconds.
  ros::ServiceClient show = ros::NodeHandle("~rig").serviceClient<std_srvs::SetBool>("show_board");
  std::atomic<int> views{0};
  double coverage = 0.0;
  int shown_for = -1;
  ros::WallTime since;
  const auto hold = [&](const std::function<bool()>& until) {
    return eventually(
        [&] {
          if (views > shown_for || (ros::WallTime::now() - since).toSec() > 3.0) {
            shown_for = views;
            since = ros::WallTime::now();
            std_srvs::SetBool request;
            request.request.data = 1;
            show.call(request);
          }
          return until();
        },
        150.0);
  };
  const auto send = [&](double timeout) {
    CalibrateGoal goal;
    goal.views = 1000;
    goal.model = "asphere";
    goal.timeout = timeout;
    client.sendGoal(goal, {}, {}, [&](const CalibrateFeedbackConstPtr& feedback) {
      views = static_cast<int>(feedback->views);
      coverage = feedback->coverage;
    });
  };
  const auto call = [&](const std::string& name) {
    std_srvs::Trigger trigger;
    EXPECT_TRUE(ros::service::call(private_node_.resolveName(name), trigger));
    return trigger.response;
  };
  EXPECT_FALSE(call("save").success) << "there is nothing to save yet";

  // Views outlive a goal that is cancelled, and one that runs out of time.
  send(120.0);
  ASSERT_TRUE(hold([&] { return views >= 3; }));
  client.cancelGoal();
  ASSERT_TRUE(client.waitForResult(ros::Duration(60.0)));
  EXPECT_EQ(client.getState(), State::PREEMPTED);
  const int before = static_cast<int>(client.getResult()->views);
  EXPECT_GE(before, 3);
  send(0.05);
  ASSERT_TRUE(client.waitForResult(ros::Duration(60.0)));
  EXPECT_EQ(client.getState(), State::ABORTED);
  EXPECT_GE(static_cast<int>(client.getResult()->views), before);
  EXPECT_THAT(client.getResult()->message, testing::HasSubstr("are kept in"));
  EXPECT_TRUE(std::filesystem::exists(store_ / "wide_detections.csv"));
  EXPECT_FALSE(std::filesystem::exists(store_ / "wide.yaml"));

  // The next one goes on with them, until somebody says that they will do.
  send(120.0);
  ASSERT_TRUE(hold([&] { return views >= 8; }));
  EXPECT_TRUE(call("save").success);
  ASSERT_TRUE(client.waitForResult(ros::Duration(120.0)));
  const CalibrateResultConstPtr result = client.getResult();
  ASSERT_EQ(client.getState(), State::SUCCEEDED) << result->message;
  EXPECT_TRUE(result->success);
  EXPECT_GE(result->views, 8u);
  EXPECT_FALSE(call("save").success) << "after a lens its views are done with";
  ASSERT_TRUE(eventually([&] { return residuals.size() > 0; }));
  EXPECT_EQ(residuals.last()->encoding, "bgr8");
  EXPECT_GT(coverage, 0.2);
  EXPECT_LT(result->rms_px, 0.15);

  // What is stored is what is told, and near to the truth wherever boards were seen.
  EXPECT_EQ(result->lens_file, (store_ / "wide.yaml").string());
  EXPECT_TRUE(std::filesystem::exists(store_ / "wide_detections.csv"));
  ASSERT_TRUE(eventually([&] { return lenses.size() > 0; }));
  EXPECT_EQ(lenses.last()->yaml, readFile(result->lens_file));
  const LensFile fitted = readLensFile(result->lens_file);
  const LensFile truth = readLensFile(parameters.lens);
  int compared = 0;
  for (double theta = 0.0; theta < 0.9; theta += 0.1)
    for (double phi = 0.0; phi < 6.28; phi += 0.4) {
      const Eigen::Vector3d ray(std::sin(theta) * std::cos(phi), std::sin(theta) * std::sin(phi),
                                std::cos(theta));
      const auto expected = truth.lens->project(ray);
      const auto found = fitted.lens->project(ray);
      ASSERT_TRUE(expected && found);
      EXPECT_LT((*expected - *found).norm(), 0.5) << theta << " " << phi;
      ++compared;
    }
  EXPECT_GT(compared, 120);
}

TEST_F(Calibration, SaysWhyThereAreNoViews) {
  const CalibrationServer calibration(camera_node_, private_node_);
  Client client(camera_node_, "calibrate", false);
  ASSERT_TRUE(client.waitForServer(ros::Duration(20.0)));
  CalibrateGoal goal;
  goal.timeout = 0.5;
  client.sendGoal(goal);
  ASSERT_TRUE(client.waitForResult(ros::Duration(20.0)));
  EXPECT_EQ(client.getState(), State::ABORTED);
  EXPECT_FALSE(client.getResult()->success);
  EXPECT_THAT(client.getResult()->message, testing::HasSubstr("0 of 25 views within"));
  EXPECT_FALSE(std::filesystem::exists(store_ / "wide.yaml"));
}

TEST_F(Calibration, BeginsByServiceOrByItself) {
  ros::Publisher images = camera_node_.advertise<sensor_msgs::Image>("image_raw", 1);
  {
    const CalibrationServer calibration(camera_node_, private_node_);
    EXPECT_EQ(images.getNumSubscribers(), 0u);
    std_srvs::Trigger trigger;
    ASSERT_TRUE(ros::service::call(private_node_.resolveName("start"), trigger));
    EXPECT_TRUE(trigger.response.success);
    EXPECT_TRUE(eventually([&] { return images.getNumSubscribers() == 1; }));
    EXPECT_TRUE(eventually([&] {
      std_srvs::Trigger again;
      ros::service::call(private_node_.resolveName("start"), again);
      return again.response.success == 0;
    })) << "it is under way";
    ASSERT_TRUE(ros::service::call(private_node_.resolveName("reset"), trigger));
    EXPECT_TRUE(trigger.response.success);
  }
  EXPECT_TRUE(eventually([&] { return images.getNumSubscribers() == 0; }));
  ros::NodeHandle own("~by_itself");
  own.setParam("target", kSource + "/config/demo/target.yaml");
  own.setParam("store", store_.string());
  own.setParam("start", true);
  const CalibrationServer calibration(camera_node_, own);
  EXPECT_TRUE(eventually([&] { return images.getNumSubscribers() == 1; }));
}

TEST_F(Calibration, CancelsAtOnceAndListensOnlyWhileItRuns) {
  const CalibrationServer calibration(camera_node_, private_node_);
  ros::Publisher images = camera_node_.advertise<sensor_msgs::Image>("image_raw", 1);
  Client client(camera_node_, "calibrate", false);
  ASSERT_TRUE(client.waitForServer(ros::Duration(20.0)));
  EXPECT_EQ(images.getNumSubscribers(), 0u);
  for (int lap = 0; lap < 3; ++lap) {
    client.sendGoal(CalibrateGoal());
    ASSERT_TRUE(eventually([&] { return images.getNumSubscribers() == 1; }));
    // Broken images change nothing.
    images.publish(sensor_msgs::Image());
    client.cancelGoal();
    ASSERT_TRUE(client.waitForResult(ros::Duration(20.0)));
    EXPECT_EQ(client.getState(), State::PREEMPTED);
    EXPECT_TRUE(eventually([&] { return images.getNumSubscribers() == 0; }));
  }
}

TEST_F(Calibration, RefusesGoalsAndParametersByName) {
  {
    const CalibrationServer calibration(camera_node_, private_node_);
    Client client(camera_node_, "calibrate", false);
    ASSERT_TRUE(client.waitForServer(ros::Duration(20.0)));
    const auto refusal = [&](const CalibrateGoal& goal) {
      client.sendGoal(goal);
      EXPECT_TRUE(client.waitForResult(ros::Duration(20.0)));
      EXPECT_EQ(client.getState(), State::ABORTED);
      return client.getResult()->message;
    };
    CalibrateGoal goal;
    goal.model = "magic";
    EXPECT_THAT(refusal(goal), testing::HasSubstr("magic"));
    goal = CalibrateGoal();
    goal.timeout = std::nan("");
    EXPECT_THAT(refusal(goal), testing::HasSubstr("timeout"));
    goal = CalibrateGoal();
    goal.positions = {0.1, std::nan("")};
    EXPECT_THAT(refusal(goal), testing::HasSubstr("positions"));
    goal = CalibrateGoal();
    goal.views = 4000000000u;
    EXPECT_THAT(refusal(goal), testing::HasSubstr("views"));
  }
  const auto refusal = [&](const std::string& name, const std::string& value) -> std::string {
    ros::NodeHandle refused("~refused");
    refused.setParam("target", kSource + "/config/demo/target.yaml");
    refused.setParam("store", store_.string());
    refused.setParam(name, value);
    std::string message = "taken";
    try {
      const CalibrationServer calibration(camera_node_, refused);
    } catch (const Error& error) {
      message = error.what();
    }
    refused.deleteParam(name);
    return message;
  };
  EXPECT_THAT(refusal("camera_name", "../../etc/passwd"), testing::HasSubstr("passwd"));
  EXPECT_THAT(refusal("target", "/none.yaml"), testing::HasSubstr("/none.yaml"));
  EXPECT_THAT(refusal("model", "magic"), testing::HasSubstr("magic"));
  EXPECT_THAT(refusal("views", "1"), testing::HasSubstr("views"));
  EXPECT_THAT(refusal("positions", "0.1 here"), testing::HasSubstr("positions"));
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "calibration_test"); }
