// SPDX-License-Identifier: Apache-2.0
#include <gmock/gmock.h>
#include <ros/callback_queue.h>
#include <tf2_ros/buffer.h>
#include <tf2_ros/transform_listener.h>

#include <algorithm>
#include <atomic>
#include <fstream>
#include <future>
#include <limits>
#include <mutex>
#include <opencv2/imgcodecs.hpp>
#include <set>
#include <thread>

#include "child_process.h"
#include "omnister/common/file_io.h"
#include "omnister/lens/lens_models.h"
#include "omnister/lens/lens_store.h"
#include "ros/camera/camera_driver.h"
#include "ros/message/conversions.h"
#include "ros/ros_test.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

using std::chrono::milliseconds;
using test::Collector;
using test::eventually;
using testing::HasSubstr;

/// What a fake camera did and shall do; outlives the cameras that the driver opens and closes.
struct FakeState {
  std::atomic<int> opened{0}, started{0}, stopped{0};
  std::atomic<bool> absent{false}, unplugged{false};
  std::atomic<std::uint64_t> sequence{0};
  std::atomic<std::uint64_t> skip{0};
  std::shared_ptr<device::FramePool> pool;
  std::optional<device::SensorRegion> region;
  cv::Size size{8, 6};
  std::mutex mutex;
  std::set<const std::uint8_t*> places;
};

class FakeCamera : public device::Camera {
 public:
  explicit FakeCamera(FakeState* state) : state_(state) {
    if (state->absent) throw device::CameraError("no such camera");
    ++state->opened;
  }
  device::CameraIdentity identity() const override { return {"test", "fake", "F-1"}; }
  void start() override { ++state_->started; }
  void stop() override { ++state_->stopped; }
  std::optional<device::Frame> grab(milliseconds /*timeout*/) override {
    std::this_thread::sleep_for(milliseconds(5));
    if (state_->unplugged) throw device::CameraError("the cable is out");
    device::Frame frame;
    if (state_->pool) {
      frame.memory = state_->pool->take(6 * 8 + 16);  // the device sends more than the image
      frame.image = cv::Mat(6, 8, CV_8UC1, frame.memory->bytes.data());
      frame.image.setTo(7);
      const std::lock_guard<std::mutex> lock(state_->mutex);
      state_->places.insert(frame.image.data);
    } else {
      frame.image = cv::Mat(state_->size, CV_8UC1, cv::Scalar(7));
    }
    frame.region = state_->region;
    frame.encoding = "mono8";
    frame.stamp = device::now();
    frame.sequence = state_->sequence += 1 + state_->skip.exchange(0);
    return frame;
  }

 private:
  FakeState* state_;
};

class CameraTest : public testing::Test {
 protected:
  CameraTest()
      : node_("camera_" + std::to_string(++count_)),
        private_("~" + node_.getNamespace().substr(1)) {
    parameters_.store = (folder_.path() / "store").string();
    parameters_.retry_period_s = 0.05;
  }

  void openFake() {
    driver_ = std::make_unique<CameraDriver>(
        node_, private_, parameters_,
        [this](const CameraParameters&) { return std::make_unique<FakeCamera>(&state_); });
  }

  /// A recording of `count` images whose first pixel is their number.
  void record(int count, double rate, const std::string& more_of_frame = "") {
    std::ofstream list(folder_.path() / "replay.yaml");
    list << "version: 1\nrate: " << rate << "\nframes:\n";
    for (int i = 0; i < count; ++i) {
      const std::string name = std::to_string(i) + ".png";
      ASSERT_TRUE(
          cv::imwrite((folder_.path() / name).string(), cv::Mat(6, 8, CV_8UC1, cv::Scalar(i))));
      list << "  - {image: " << name << more_of_frame << "}\n";
    }
    parameters_.device = "replay:" + folder_.path().string();
  }

  LensFile lens() const {
    LensFile file;
    file.image_size = {8, 6};
    LensStructure structure;
    structure.model = "conic";
    file.lens = makeLens(structure, Eigen::Vector2d(3.5, 2.5), 4.0, 1.2);
    return file;
  }

  /// The latest value of a key in the diagnostics of this camera.
  std::string diagnosed(const Collector<diagnostic_msgs::DiagnosticArray>& diagnostics,
                        const std::string& key) const {
    std::string found;
    for (const auto& array : diagnostics.messages()) {
      for (const auto& status : array->status) {
        if (status.hardware_id != "F-1" ||
            status.name.find(private_.getNamespace().substr(1)) == std::string::npos) {
          continue;
        }
        for (const auto& entry : status.values) {
          if (entry.key == key) found = entry.value;
        }
      }
    }
    return found;
  }

  /// A calibration of the images above. @param f focal length [px]
  static sensor_msgs::CameraInfo smallCamera(double f) {
    sensor_msgs::CameraInfo info;
    info.width = 8;
    info.height = 6;
    info.distortion_model = "equidistant";
    info.D = {0.01, 0.0, 0.0, 0.0};
    info.K = {f, 0, 3.5, 0, f, 2.5, 0, 0, 1};
    return info;
  }

  static int count_;
  ros::NodeHandle node_, private_;
  test::TemporaryFolder folder_;
  CameraParameters parameters_;
  FakeState state_;
  std::unique_ptr<CameraDriver> driver_;  // goes first
};
int CameraTest::count_ = 0;

TEST_F(CameraTest, StreamsOnlyWhileSomeoneListens) {
  openFake();
  ASSERT_TRUE(eventually([&] { return state_.opened == 1; }));
  std::this_thread::sleep_for(milliseconds(200));
  EXPECT_EQ(state_.started, 0);
  for (int round = 1; round <= 2; ++round) {
    {
      // The information alone is worth streaming, too.
      Collector<sensor_msgs::Image> images(node_, round == 1 ? "image_raw" : "unused");
      Collector<sensor_msgs::CameraInfo> infos(node_, round == 1 ? "unused" : "camera_info");
      ASSERT_TRUE(eventually([&] { return images.size() + infos.size() >= 3; }));
      EXPECT_EQ(state_.started, round);
      EXPECT_EQ(state_.stopped, round - 1);
    }
    ASSERT_TRUE(eventually([&] { return state_.stopped == round; }));
  }
  EXPECT_EQ(state_.opened, 1);
}

TEST_F(CameraTest, ImageAndInformationHaveTheSameHeaderAndNoneIsLost) {
  constexpr int kFrames = 40;
  record(kFrames, 50.0);
  parameters_.frame_id = "wide_optical";
  Collector<sensor_msgs::CameraInfo> infos(node_, "camera_info");
  Collector<sensor_msgs::Image> images(node_, "image_raw");
  driver_ = std::make_unique<CameraDriver>(node_, private_, parameters_);
  ASSERT_TRUE(eventually([&] {
    return images.size() > 0 && infos.size() > 0 && images.last()->data[0] == kFrames - 1 &&
           infos.last()->header.stamp == images.last()->header.stamp;
  }));
  const auto got = images.messages();
  int compared = 0;
  for (const auto& image : got) {
    EXPECT_EQ(image->header.frame_id, "wide_optical");
    EXPECT_EQ(image->encoding, "mono8");
    for (const auto& info : infos.messages()) {
      if (info->header.stamp != image->header.stamp) continue;
      EXPECT_EQ(info->header.frame_id, image->header.frame_id);
      EXPECT_EQ(info->width, image->width);
      EXPECT_EQ(info->height, image->height);
      EXPECT_EQ(info->K[0], 0.0);  // not calibrated
      ++compared;
    }
  }
  // The second subscriber may join a few frames after the first.
  EXPECT_GE(compared, kFrames - 10);
  for (std::size_t i = 1; i < got.size(); ++i) {
    EXPECT_EQ(got[i]->data[0], got[i - 1]->data[0] + 1);
    EXPECT_NEAR((got[i]->header.stamp - got[i - 1]->header.stamp).toSec(), 0.02, 1e-6);
  }
}

TEST_F(CameraTest, SlowListenersStallNobody) {
  // 300 images of a megabyte, which no socket holds.
  constexpr std::uint64_t kImages = 300;
  state_.size = {1024, 1024};
  openFake();
  const std::string topic = node_.resolveName("image_raw");
  const std::string heard = (folder_.path() / "heard").string();
  // One in another process that stands still, and one in this process that never takes what waits
  // for it.
  const test::ChildProcess stopped({"env", "PYTHONUNBUFFERED=1", "rostopic", "hz", topic}, heard);
  ASSERT_TRUE(
      eventually([&] { return readFile(heard).find("average rate") != std::string::npos; }, 60.0));
  stopped.signal(SIGSTOP);
  ros::CallbackQueue never;
  ros::NodeHandle idle(node_);
  idle.setCallbackQueue(&never);
  const boost::function<void(const sensor_msgs::ImageConstPtr&)> ignore =
      [](const sensor_msgs::ImageConstPtr&) {};
  const ros::Subscriber sleeper = idle.subscribe<sensor_msgs::Image>("image_raw", 5, ignore);
  std::atomic<std::uint64_t> count{0}, missed{0}, last{0};
  // What was published for the other process alone, before, may come here late.
  std::atomic<double> since{std::numeric_limits<double>::infinity()};
  const ros::Subscriber quick = node_.subscribe<sensor_msgs::Image>(
      "image_raw", 1000, [&](const sensor_msgs::ImageConstPtr& image) {
        if (image->header.stamp.toSec() < since) return;
        if (last != 0) missed += image->header.seq - last - 1;
        last = image->header.seq;
        ++count;
      });
  since = ros::Time::now().toSec();
  ASSERT_TRUE(eventually([&] { return count >= 20; }, 60.0));
  const auto resident = [] {
    std::ifstream file("/proc/self/statm");
    std::uint64_t all = 0, pages = 0;
    file >> all >> pages;
    return pages * 4096 >> 20;
  };
  const std::uint64_t before = resident();
  EXPECT_TRUE(eventually([&] { return count >= kImages; }, 60.0));
  EXPECT_EQ(missed, 0U);
  EXPECT_LT(resident(), before + 50) << "megabytes";
}

TEST_F(CameraTest, ComesBackAfterALoss) {
  state_.absent = true;
  openFake();
  Collector<sensor_msgs::Image> images(node_, "image_raw");
  std::this_thread::sleep_for(milliseconds(200));
  EXPECT_EQ(images.size(), 0u);
  state_.absent = false;
  ASSERT_TRUE(eventually([&] { return images.size() >= 3; }));
  for (int round = 0; round < 5; ++round) {
    const int before = state_.opened;
    state_.unplugged = true;
    std::this_thread::sleep_for(milliseconds(100));
    state_.unplugged = false;
    ASSERT_TRUE(eventually([&] { return state_.opened > before; }));
    const std::size_t had = images.size();
    ASSERT_TRUE(eventually([&] { return images.size() > had + 2; }));
  }
}

TEST_F(CameraTest, TheConstructorDoesNotWaitForTheDevice) {
  std::promise<void> release;
  std::shared_future<void> released(release.get_future());
  std::atomic<bool> asked{false};
  {
    CameraDriver driver(node_, private_, parameters_, [&](const CameraParameters&) {
      asked = true;
      released.wait();
      return std::make_unique<FakeCamera>(&state_);
    });
    // Here the device is still being opened, and so it would stay for ever.
    ASSERT_TRUE(eventually([&] { return asked.load(); }));
    EXPECT_EQ(state_.opened, 0);
    release.set_value();
  }
  EXPECT_EQ(state_.started, 0);
}

TEST_F(CameraTest, DiagnosticsCountLostFrames) {
  Collector<diagnostic_msgs::DiagnosticArray> diagnostics(ros::NodeHandle(), "/diagnostics");
  openFake();
  Collector<sensor_msgs::Image> images(node_, "image_raw");
  ASSERT_TRUE(eventually([&] { return images.size() >= 3; }));
  state_.skip = 4;
  EXPECT_TRUE(eventually([&] { return diagnosed(diagnostics, "frames lost") == "4"; }));
  EXPECT_EQ(diagnosed(diagnostics, "state"), "streaming");
}

TEST_F(CameraTest, DiagnosticsTellOfAChangeAtOnce) {
  parameters_.diagnostic_period_s = 3600.0;
  Collector<diagnostic_msgs::DiagnosticArray> diagnostics(ros::NodeHandle(), "/diagnostics");
  openFake();
  const auto comes = [&](const std::string& state) {
    return eventually([&] { return diagnosed(diagnostics, "state") == state; });
  };
  EXPECT_TRUE(comes("idle"));
  Collector<sensor_msgs::Image> images(node_, "image_raw");
  EXPECT_TRUE(comes("streaming"));
  state_.unplugged = true;
  EXPECT_TRUE(comes("lost"));
  state_.unplugged = false;
  EXPECT_TRUE(comes("streaming"));
}

TEST_F(CameraTest, PublishesTheLensOfItsParameter) {
  const LensFile file = lens();
  parameters_.lens = (folder_.path() / "lens.yaml").string();
  writeLensFile(parameters_.lens, file);
  openFake();
  Collector<LensModelMessage> models(node_, "lens_model");  // latched: comes later, sees it still
  ASSERT_TRUE(eventually([&] { return models.size() == 1; }));
  const LensFile back = fromLensModelMessage(*models.last(), "lens_model");
  EXPECT_EQ(back.lens->model(), "conic");
  EXPECT_EQ(models.last()->header.frame_id, parameters_.frame_id);
  EXPECT_EQ(back.lens->parameters(), file.lens->parameters());
  Collector<sensor_msgs::CameraInfo> infos(node_, "camera_info");
  ASSERT_TRUE(eventually([&] { return infos.size() > 0; }));
  const sensor_msgs::CameraInfo expected = toCameraInfo(file);
  EXPECT_EQ(infos.last()->K, expected.K);
  EXPECT_EQ(infos.last()->D, expected.D);
  EXPECT_EQ(infos.last()->distortion_model, expected.distortion_model);
}

TEST_F(CameraTest, ALensOfAnotherImageSizeIsNotPublishedAsCalibration) {
  LensFile file = lens();
  file.image_size = {16, 12};
  parameters_.lens = (folder_.path() / "lens.yaml").string();
  writeLensFile(parameters_.lens, file);
  openFake();
  Collector<sensor_msgs::CameraInfo> infos(node_, "camera_info");
  ASSERT_TRUE(eventually([&] { return infos.size() > 0; }));
  EXPECT_EQ(infos.last()->K[0], 0.0);
  EXPECT_EQ(infos.last()->width, 8u);
}

TEST_F(CameraTest, APartOfTheSensorIsToldByRep104) {
  // The lens is of the whole sensor, the image a binned part of it.
  LensFile file = lens();
  file.image_size = {32, 24};
  file.lens = makeLens(structureOf(*file.lens), Eigen::Vector2d(15.5, 11.5), 16.0, 1.2);
  parameters_.lens = (folder_.path() / "lens.yaml").string();
  writeLensFile(parameters_.lens, file);
  state_.region = device::SensorRegion{{32, 24}, {4, 6, 16, 12}, {2, 2}};
  openFake();
  Collector<sensor_msgs::CameraInfo> infos(node_, "camera_info");
  ASSERT_TRUE(eventually([&] { return infos.size() > 0; }));
  const auto info = infos.last();
  EXPECT_EQ(info->width, 32u);
  EXPECT_EQ(info->height, 24u);
  EXPECT_EQ(info->K, toCameraInfo(file).K);
  EXPECT_NE(info->K[0], 0.0);
  EXPECT_EQ(info->binning_x, 2u);
  EXPECT_EQ(info->binning_y, 2u);
  EXPECT_EQ(info->roi.x_offset, 4u);
  EXPECT_EQ(info->roi.y_offset, 6u);
  EXPECT_EQ(info->roi.width, 16u);
  EXPECT_EQ(info->roi.height, 12u);

  // The lens model is that of the images themselves, and of the same rays.
  Collector<LensModelMessage> models(node_, "lens_model");
  ASSERT_TRUE(eventually([&] { return models.size() > 0; }));
  const LensFile part = fromLensModelMessage(*models.last(), "lens_model");
  EXPECT_EQ(part.image_size, cv::Size(8, 6));
  int compared = 0;
  for (int y = 0; y < 6; ++y) {
    for (int x = 0; x < 8; ++x) {
      // The middle of two by two pixels of the sensor.
      const auto whole = file.lens->unproject({4 + 2 * x + 0.5, 6 + 2 * y + 0.5});
      const auto ray = part.lens->unproject(Eigen::Vector2d(x, y));
      ASSERT_EQ(whole.has_value(), ray.has_value());
      if (!ray) continue;
      EXPECT_LT((*ray - *whole).norm(), 1e-9);
      ++compared;
    }
  }
  EXPECT_GT(compared, 20);
}

TEST_F(CameraTest, ImagesAreTheDevicesOwnMemoryWhichGoesRound) {
  state_.pool = device::FramePool::make(8);
  openFake();
  // In this program messages go by pointer.
  Collector<sensor_msgs::Image> images(node_, "image_raw", 2);
  ASSERT_TRUE(eventually([&] { return images.size() >= 3; }));
  const auto image = images.last();
  ASSERT_EQ(image->data.size(), 48u);
  EXPECT_EQ(image->data[47], 7);
  EXPECT_EQ(image->step, 8u);
  {
    const std::lock_guard<std::mutex> lock(state_.mutex);
    EXPECT_EQ(state_.places.count(image->data.data()), 1u);
  }
  images.shutdown();
  const std::size_t held = images.size();
  Collector<sensor_msgs::CameraInfo> infos(node_, "camera_info");
  ASSERT_TRUE(eventually([&] { return infos.size() >= 20; }));
  // Nobody holds the later images: they share a few places.
  EXPECT_LE(state_.pool->allocated(), held + 8);
}

TEST_F(CameraTest, ABrokenLensParameterIsAnError) {
  parameters_.lens = (folder_.path() / "none.yaml").string();
  EXPECT_THROW(openFake(), Error);
  std::ofstream(parameters_.lens) << "image_width: 8\n";
  EXPECT_THROW(openFake(), Error);
}

TEST_F(CameraTest, KeepsACalibrationThatItIsGiven) {
  openFake();
  Collector<sensor_msgs::CameraInfo> infos(node_, "camera_info");
  ASSERT_TRUE(eventually([&] { return infos.size() > 0; }));
  sensor_msgs::SetCameraInfo call;
  sensor_msgs::CameraInfo& info = call.request.camera_info;
  info = smallCamera(4.0);
  ASSERT_TRUE(ros::service::call(node_.resolveName("set_camera_info"), call));
  ASSERT_TRUE(call.response.success) << call.response.status_message;
  ASSERT_TRUE(eventually([&] { return infos.last()->K[0] != 0.0; }));
  EXPECT_NEAR(infos.last()->K[0], 4.0, 0.05);
  const std::optional<LensFile> stored = LensStore(parameters_.store).load("F-1");
  ASSERT_TRUE(stored);
  EXPECT_EQ(stored->image_size, cv::Size(8, 6));

  // Another start finds it.
  driver_.reset();
  openFake();
  Collector<LensModelMessage> models(node_, "lens_model");
  EXPECT_TRUE(eventually([&] { return models.size() == 1; }));

  // Nonsense changes nothing.
  for (const double f : {0.0, -1.0, std::nan(""), 1e300}) {
    info.K[0] = f;
    ASSERT_TRUE(ros::service::call(node_.resolveName("set_camera_info"), call));
    EXPECT_FALSE(call.response.success) << f;
    EXPECT_NE(call.response.status_message, "");
  }
  // Nor does what is of other images.
  const std::size_t had = infos.size();
  ASSERT_TRUE(eventually([&] { return infos.size() > had + 1; }));
  info.K[0] = 4.0;
  info.width = 400;
  ASSERT_TRUE(ros::service::call(node_.resolveName("set_camera_info"), call));
  EXPECT_FALSE(call.response.success);
  EXPECT_THAT(call.response.status_message, HasSubstr("expected the images' 8, 6"));
  EXPECT_EQ(models.size(), 1u);
}

TEST_F(CameraTest, TakesOverALensThatACalibrationPublishes) {
  openFake();
  Collector<sensor_msgs::CameraInfo> infos(node_, "camera_info");
  ASSERT_TRUE(eventually([&] { return infos.size() > 0; }));
  EXPECT_EQ(infos.last()->K[0], 0.0);
  ros::Publisher calibration = node_.advertise<LensModelMessage>("lens_model", 1, true);
  std_msgs::Header header;
  header.frame_id = "another_optical";
  calibration.publish(toLensModelMessage(lens(), header));
  header.frame_id = parameters_.frame_id;
  LensModelMessage broken = toLensModelMessage(lens(), header);
  broken.yaml = "nonsense";
  calibration.publish(broken);
  const std::size_t had = infos.size();
  ASSERT_TRUE(eventually([&] { return infos.size() > had + 5; }));
  EXPECT_EQ(infos.last()->K[0], 0.0);
  calibration.publish(toLensModelMessage(lens(), header));
  ASSERT_TRUE(eventually([&] { return infos.last()->K[0] != 0.0; }));
  // It says so itself from now on.
  calibration.shutdown();
  Collector<LensModelMessage> models(node_, "lens_model");
  ASSERT_TRUE(eventually([&] { return models.size() == 1; }));
  EXPECT_EQ(models.last()->model, "conic");
}

TEST_F(CameraTest, ACorruptStoreStartsUncalibrated) {
  std::filesystem::create_directories(parameters_.store);
  std::ofstream(LensStore(parameters_.store).pathOf("F-1")) << "lens_surface: {";
  openFake();
  Collector<diagnostic_msgs::DiagnosticArray> diagnostics(ros::NodeHandle(), "/diagnostics");
  Collector<sensor_msgs::CameraInfo> infos(node_, "camera_info");
  ASSERT_TRUE(eventually([&] { return infos.size() > 0; }));
  EXPECT_EQ(infos.last()->K[0], 0.0);
  EXPECT_TRUE(eventually(
      [&] { return diagnosed(diagnostics, "calibrated").find("F-1.yaml") != std::string::npos; }));
  // It can be calibrated again, and what was there is kept.
  sensor_msgs::SetCameraInfo call;
  call.request.camera_info = smallCamera(4.0);
  ASSERT_TRUE(ros::service::call(node_.resolveName("set_camera_info"), call));
  ASSERT_TRUE(call.response.success) << call.response.status_message;
  ASSERT_TRUE(eventually([&] { return infos.last()->K[0] != 0.0; }));
  ListLenses list;
  ASSERT_TRUE(ros::service::call(node_.resolveName("list_lenses"), list));
  ASSERT_TRUE(list.response.success) << list.response.message;
  EXPECT_THAT(list.response.versions, testing::ElementsAre(2, 1));
  EXPECT_EQ(list.response.current, 2);
  EXPECT_THAT(list.response.descriptions[1], HasSubstr("cannot be read"));
}

TEST_F(CameraTest, RollsBackToAnEarlierCalibration) {
  openFake();
  Collector<LensModelMessage> models(node_, "lens_model");
  Collector<sensor_msgs::CameraInfo> infos(node_, "camera_info");
  ASSERT_TRUE(eventually([&] { return infos.size() > 0; }));
  for (const double f : {4.0, 5.0}) {
    sensor_msgs::SetCameraInfo call;
    call.request.camera_info = smallCamera(f);
    ASSERT_TRUE(ros::service::call(node_.resolveName("set_camera_info"), call));
    ASSERT_TRUE(call.response.success) << call.response.status_message;
  }
  ASSERT_TRUE(eventually([&] { return std::abs(infos.last()->K[0] - 5.0) < 0.1; }));
  RollBackLens back;
  ASSERT_TRUE(ros::service::call(node_.resolveName("roll_back_lens"), back));
  ASSERT_TRUE(back.response.success) << back.response.message;
  EXPECT_EQ(back.response.version, 1);
  ASSERT_TRUE(eventually([&] { return std::abs(infos.last()->K[0] - 4.0) < 0.1; }));
  EXPECT_TRUE(eventually([&] { return models.size() == 3; }));
  // There is nothing before the first, and no such version.
  for (const int version : {0, 7, -1}) {
    back.request.version = version;
    ASSERT_TRUE(ros::service::call(node_.resolveName("roll_back_lens"), back));
    EXPECT_FALSE(back.response.success) << version;
    EXPECT_NE(back.response.message, "");
  }
  back.request.version = 2;
  ASSERT_TRUE(ros::service::call(node_.resolveName("roll_back_lens"), back));
  EXPECT_TRUE(back.response.success) << back.response.message;
  ASSERT_TRUE(eventually([&] { return std::abs(infos.last()->K[0] - 5.0) < 0.1; }));
}

TEST_F(CameraTest, ARecordedStageIsPublishedBesideItsImages) {
  record(5, 20.0, ", stage_position_m: 0.25, settled: true");
  parameters_.axis = Eigen::Vector3d::UnitY();
  parameters_.parent_frame_id = "stage_carriage";
  parameters_.settings.loop = true;
  tf2_ros::Buffer buffer;
  const tf2_ros::TransformListener listener(buffer);
  driver_ = std::make_unique<CameraDriver>(node_, private_, parameters_);
  Collector<sensor_msgs::Image> images(node_, "image_raw");
  Collector<StageState> states(node_, "stage_state");
  ASSERT_TRUE(eventually([&] {
    return images.size() > 0 && states.size() > 0 &&
           buffer.canTransform("stage_base", "camera_optical", images.last()->header.stamp);
  }));
  EXPECT_EQ(states.last()->position, 0.25);
  EXPECT_FALSE(states.last()->moving);
  const Pose pose = fromTransform(
      buffer.lookupTransform("stage_base", "camera_optical", images.last()->header.stamp).transform,
      "tf");
  EXPECT_NEAR((pose.translation() - Eigen::Vector3d(0, 0.25, 0)).norm(), 0.0, 1e-12);
  // The camera looks along the link's x.
  EXPECT_NEAR((pose.linear() * Eigen::Vector3d::UnitZ() - Eigen::Vector3d::UnitX()).norm(), 0.0,
              1e-12);
  EXPECT_NEAR((pose.linear() * Eigen::Vector3d::UnitX() + Eigen::Vector3d::UnitY()).norm(), 0.0,
              1e-12);
}

TEST_F(CameraTest, RefusesParametersByKeyValueAndRange) {
  const auto refusal = [&](const std::string& key,
                           const XmlRpc::XmlRpcValue& value) -> std::string {
    private_.setParam(key, value);
    std::string message;
    try {
      loadCameraParameters(private_);
    } catch (const InputError& e) {
      message = e.what();
    }
    private_.deleteParam(key);
    return message;
  };
  for (const char* device : {"", "webcam", "magic:1", "replay:", "v4l2"}) {
    EXPECT_THAT(refusal("device", device),
                testing::AllOf(HasSubstr("device"), HasSubstr("aravis:SERIAL")));
  }
  private_.setParam("device", "replay:/there");
  EXPECT_THAT(refusal("features", "GainAuto"), HasSubstr("Name=value"));
  EXPECT_EQ(refusal("features", "GainAuto=Off"), "");
  EXPECT_THAT(refusal("frame_id", std::string(256, 'f')), HasSubstr("255"));
  EXPECT_EQ(refusal("frame_rate", 25.0), "");
  EXPECT_EQ(refusal("frame_rate", 25), "");
  EXPECT_THAT(refusal("frame_rate", -1.0),
              testing::AllOf(HasSubstr("frame_rate"), HasSubstr("-1"), HasSubstr("1000")));
  EXPECT_THAT(refusal("frame_rate", std::nan("")), HasSubstr("frame_rate"));
  EXPECT_THAT(refusal("frame_rate", "fast"), HasSubstr("fast"));
  EXPECT_THAT(refusal("exposure_us", -1), HasSubstr("exposure_us"));
  EXPECT_THAT(refusal("trigger", "sometimes"), HasSubstr("software"));
  EXPECT_THAT(refusal("frame_id", "/camera"), HasSubstr("frame_id"));
  EXPECT_THAT(refusal("frame_id", ""), HasSubstr("frame_id"));
  EXPECT_THAT(refusal("name", "../evil"), HasSubstr("evil"));
  EXPECT_THAT(refusal("name", "a/b"), HasSubstr("a/b"));
  EXPECT_THAT(refusal("mount", "1 2 3"), HasSubstr("mount"));
  EXPECT_THAT(refusal("mount", "0 0 0 0 0 0 0"), HasSubstr("mount"));
  EXPECT_THAT(refusal("axis", "0 0 0"), HasSubstr("axis"));
  EXPECT_THAT(refusal("camera_info_url", "http://there"), HasSubstr("camera_info_url"));
  EXPECT_EQ(refusal("camera_info_url", "file:///there.yaml"), "");
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "camera_test"); }
