// SPDX-License-Identifier: Apache-2.0
#include <diagnostic_msgs/DiagnosticArray.h>
#include <dynamic_reconfigure/Reconfigure.h>
#include <geometry_msgs/Point.h>
#include <geometry_msgs/PointStamped.h>
#include <gmock/gmock.h>
#include <omnister/StageTimes.h>
#include <sensor_msgs/PointCloud2.h>
#include <sensor_msgs/point_cloud2_iterator.h>
#include <tf2_ros/static_transform_broadcaster.h>
#include <visualization_msgs/MarkerArray.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <limits>
#include <map>
#include <memory>
#include <mutex>
#include <opencv2/core.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "omnister/calibration/rig_file.h"
#include "omnister/lens/lens_models.h"
#include "omnister/sim/renderer.h"
#include "ros/message/conversions.h"
#include "ros/message/stereo_messages.h"
#include "ros/moving_camera.h"
#include "ros/ros_test.h"
#include "ros/stereo/stereo_pipeline.h"

namespace omnister {
namespace {

using test::Camera;
using test::Collector;
using test::eventually;
using test::kBaseline;
using test::lensFile;
using test::lensPath;
using test::medianError;
using test::parametersFor;
using test::publishPair;
using test::views;

cv::Mat floats(const sensor_msgs::Image& image) {
  return cv::Mat(static_cast<int>(image.height), static_cast<int>(image.width), CV_32FC1,
                 const_cast<std::uint8_t*>(image.data.data()), image.step);
}

TEST(Stereo, CloudDepthAndRangeAgreeWithTheScene) {
  Camera camera("truth");
  const StereoPipeline stereo(camera.node(), parametersFor(camera, "truth"));
  Collector<sensor_msgs::PointCloud2> points(camera.node(), "points2");
  Collector<sensor_msgs::Image> depths(camera.node(), "depth");
  Collector<sensor_msgs::Image> ranges(camera.node(), "range");
  const ros::Time stamp = ros::Time::now();
  publishPair(camera, stamp - ros::Duration(2.0), stamp);
  ASSERT_TRUE(eventually([&] { return points.size() && depths.size() && ranges.size(); }));

  for (const auto& header : {points.last()->header, depths.last()->header, ranges.last()->header}) {
    EXPECT_EQ(header.stamp, stamp) << "the newest frame is the reference";
    EXPECT_EQ(header.frame_id, camera.optical());
  }
  EXPECT_EQ(ranges.last()->encoding, "32FC1");
  EXPECT_EQ(depths.last()->encoding, "32FC1");
  double share = 0.0;
  const cv::Mat range = floats(*ranges.last());
  ASSERT_EQ(range.size(), views().right.size());
  EXPECT_LT(medianError(range, views().right_range, &share), 0.02);
  EXPECT_GT(share, 0.6);

  const auto& message = *points.last();
  EXPECT_FALSE(message.is_dense);
  EXPECT_EQ(message.point_step * message.width, message.row_step);
  const Cloud cloud = fromPointCloud(message);
  ASSERT_EQ(cloud.xyz.size(), range.size());
  EXPECT_EQ(cv::norm(cloud.bgr, views().right, cv::NORM_INF), 0.0) << "colour of the image";
  const cv::Mat depth = floats(*depths.last());
  int valid = 0;
  for (int v = 0; v < range.rows; ++v)
    for (int u = 0; u < range.cols; ++u) {
      const cv::Vec3f xyz = cloud.xyz.at<cv::Vec3f>(v, u);
      const float expected = range.at<float>(v, u);
      if (std::isnan(expected)) {
        ASSERT_TRUE(std::isnan(xyz[0]) && std::isnan(xyz[1]) && std::isnan(xyz[2]));
        ASSERT_TRUE(std::isnan(depth.at<float>(v, u)));
        continue;
      }
      ++valid;
      ASSERT_NEAR(cv::norm(xyz), expected, 1e-4 * expected);
      const auto ray =
          views().lens.lens->unproject({static_cast<double>(u), static_cast<double>(v)});
      ASSERT_TRUE(ray);
      ASSERT_NEAR(xyz[0], ray->x() * expected, 1e-3 * expected);
      ASSERT_NEAR(xyz[2], ray->z() * expected, 1e-3 * expected);
      if (xyz[2] > 0.0F)
        ASSERT_EQ(depth.at<float>(v, u), xyz[2]);
      else
        ASSERT_TRUE(std::isnan(depth.at<float>(v, u))) << "at or past 90 degrees";
      ASSERT_GT(cloud.sigma.at<float>(v, u), 0.0F);
      ASSERT_TRUE(cloud.score.at<float>(v, u) >= 0.0F && cloud.score.at<float>(v, u) <= 1.0F);
    }
  EXPECT_GT(valid, range.rows * range.cols / 3);
}

TEST(Stereo, ListensToImagesOnlyWhileSomebodyListensToIt) {
  Camera camera("lazy");
  const StereoPipeline stereo(camera.node(), parametersFor(camera, "lazy"));
  ros::WallDuration(0.3).sleep();
  EXPECT_EQ(camera.listeners(), 0);
  for (const std::string topic : {"points2", "depth", "range", "epipolar"}) {
    using Points = Collector<sensor_msgs::PointCloud2>;
    using Images = Collector<sensor_msgs::Image>;
    std::unique_ptr<Points> points;
    std::unique_ptr<Images> images;
    if (topic == "points2")
      points = std::make_unique<Points>(camera.node(), topic);
    else
      images = std::make_unique<Images>(camera.node(), topic);
    EXPECT_TRUE(eventually([&] { return camera.listeners() == 1; })) << topic;
    points.reset();
    images.reset();
    EXPECT_TRUE(eventually([&] { return camera.listeners() == 0; })) << topic;
  }
}

TEST(Stereo, GoesOnAfterEveryKindOfBadMessage) {
  Camera camera("bad");
  const StereoPipeline stereo(camera.node(), parametersFor(camera, "bad"));
  Collector<sensor_msgs::Image> ranges(camera.node(), "range");
  ASSERT_TRUE(eventually([&] { return camera.listeners() > 0; }));
  const ros::Time start = ros::Time::now();
  int sent = 0;
  const auto spoil = [&](const std::function<void(sensor_msgs::Image&)>& change) {
    const sensor_msgs::ImagePtr image = toImage(views().left, "bgr8");
    change(*image);
    camera.publish(image, start + ros::Duration(0.001 * ++sent));
    ros::WallDuration(0.02).sleep();  // so that none is lost in a queue
  };
  spoil([](sensor_msgs::Image& image) { image.encoding = "nonsense"; });
  spoil([](sensor_msgs::Image& image) { image.encoding = "8UC999999999"; });
  spoil([](sensor_msgs::Image& image) { image.encoding = "32FC1"; });
  spoil([](sensor_msgs::Image& image) { image.encoding.assign(100000, '\x1b'); });
  spoil([](sensor_msgs::Image& image) { image.step = 1; });
  spoil([](sensor_msgs::Image& image) { image.step = 0xffffffffu; });
  spoil([](sensor_msgs::Image& image) { image.data.resize(image.data.size() / 2); });
  spoil([](sensor_msgs::Image& image) { image.data.clear(); });
  spoil([](sensor_msgs::Image& image) { image.width = image.height = 0; });
  spoil([](sensor_msgs::Image& image) { image.width = image.height = 0xffffffffu; });
  spoil([](sensor_msgs::Image& image) {
    image.width = image.height = 1;
    image.step = 3;
    image.data.resize(3);
  });
  // A stamp of none, one in the far future, and a frame nobody knows.
  camera.publish(toImage(views().left, "bgr8"), ros::Time());
  camera.publish(toImage(views().left, "bgr8"), start + ros::Duration(1e6));
  // A pose that is no pose; tf refuses it or the node does.
  geometry_msgs::TransformStamped nan =
      toTransformStamped(Pose::Identity(), ros::Time::now(), camera.base(), camera.optical());
  nan.transform.translation.x = std::numeric_limits<double>::quiet_NaN();
  tf2_ros::TransformBroadcaster().sendTransform(nan);

  const ros::Time stamp = ros::Time::now() + ros::Duration(0.5);
  camera.rest(0.0, stamp);
  camera.publish(toImage(views().left, "bgr8"), stamp);
  camera.rest(kBaseline, stamp + ros::Duration(1.0));
  camera.publish(toImage(views().right, "bgr8"), stamp + ros::Duration(1.0));
  EXPECT_TRUE(eventually([&] { return ranges.size() > 0; }));
}

TEST(Stereo, UnderOverloadTheNewestComesFirstAndTheRestIsCounted) {
  constexpr int kImages = 60;
  Camera camera("overload");
  ros::NodeHandle parameters = parametersFor(camera, "overload");
  parameters.setParam("settle_time", 0.0);
  parameters.setParam("max_rate", 5.0);
  const StereoPipeline stereo(camera.node(), parameters);
  std::map<std::string, std::int64_t> values;
  std::mutex mutex;
  const ros::Subscriber diagnostics = camera.node().subscribe<diagnostic_msgs::DiagnosticArray>(
      "/diagnostics", 100, [&](const diagnostic_msgs::DiagnosticArray::ConstPtr& message) {
        const std::lock_guard<std::mutex> lock(mutex);
        for (const auto& status : message->status) {
          if (status.name.find("overload: stereo") == std::string::npos) continue;
          values.clear();
          for (const auto& value : status.values)
            values[value.key] = std::atoll(value.value.c_str());
        }
      });
  Collector<sensor_msgs::PointCloud2> clouds(camera.node(), "points2");
  ASSERT_TRUE(eventually([&] { return camera.listeners() > 0; }));
  const ros::Time begin = ros::Time::now();
  ros::Time stamp;
  for (int i = 0; i < kImages; ++i) {
    stamp = begin + ros::Duration(0.02 * (i + 1));
    camera.pass(i % 2 == 0 ? 0.0 : kBaseline, stamp);
    camera.publish(toImage(i % 2 == 0 ? views().left : views().right, "bgr8"), stamp);
    ros::WallDuration(0.02).sleep();
  }
  ASSERT_TRUE(eventually([&] { return clouds.size() > 0 && clouds.last()->header.stamp == stamp; }))
      << "the last image has no cloud";
  const auto got = clouds.messages();
  EXPECT_LT(got.size(), kImages / 2U);
  for (std::size_t i = 1; i < got.size(); ++i)
    EXPECT_GT(got[i]->header.stamp, got[i - 1]->header.stamp);
  // Every image is found in one of the counters.
  const auto count = [&](const std::string& key) {
    const auto found = values.find(key);
    return found == values.end() ? 0 : found->second;
  };
  const std::string received = "images of " + camera.node().resolveName("image_raw");
  EXPECT_TRUE(eventually([&] {
    const std::lock_guard<std::mutex> lock(mutex);
    return count("clouds") == static_cast<std::int64_t>(got.size()) &&
           count(received) + count("dropped, missed") == kImages &&
           count(received) ==
               count("frames, settled") + count("frames, no pose") + count("frames, queue full") &&
           count("frames, settled") == count("frames, paired") + count("frames, no baseline") &&
           count("frames, paired") ==
               count("clouds") + count("dropped, busy") + count("frames, superseded");
  })) << testing::PrintToString(values);
  // Where they wait for each other, or for tf.
  EXPECT_GT(count("dropped, busy") + count("frames, superseded") + count("frames, queue full"), 0);
}

TEST(Stereo, ImagesOfAnyDepthAndColourGiveTheSameCloud) {
  cv::Mat left, right;
  cv::cvtColor(views().left, left, cv::COLOR_BGR2GRAY);
  cv::cvtColor(views().right, right, cv::COLOR_BGR2GRAY);
  // 12 significant bits in 16, as cameras send them.
  cv::Mat left12, right12;
  left.convertTo(left12, CV_16U, 16.0);
  right.convertTo(right12, CV_16U, 16.0);
  struct Case {
    std::string encoding;
    cv::Mat left, right;
  };
  std::vector<cv::Mat> results;
  int number = 0;
  for (const Case& c : {Case{"mono8", left, right}, Case{"mono16", left12, right12},
                        Case{"16UC1", left12, right12}}) {
    Camera camera("depth" + std::to_string(number++));
    const StereoPipeline stereo(camera.node(), parametersFor(camera, camera.base()));
    Collector<sensor_msgs::Image> ranges(camera.node(), "range");
    ASSERT_TRUE(eventually([&] { return camera.listeners() > 0; }));
    const ros::Time stamp = ros::Time::now();
    camera.rest(0.0, stamp - ros::Duration(2.0));
    camera.publish(toImage(c.left, c.encoding), stamp - ros::Duration(2.0));
    camera.rest(kBaseline, stamp);
    camera.publish(toImage(c.right, c.encoding), stamp);
    ASSERT_TRUE(eventually([&] { return ranges.size() > 0; })) << c.encoding;
    results.push_back(floats(*ranges.last()).clone());
    double share = 0.0;
    EXPECT_LT(medianError(results.back(), views().right_range, &share), 0.02) << c.encoding;
    EXPECT_GT(share, 0.6) << c.encoding;
  }
  // 4080 of 4095 at the brightest: the same grey levels but for rounding.
  for (const cv::Mat& result : results) {
    cv::Mat both = (result == result) & (results[0] == results[0]);
    EXPECT_GT(cv::countNonZero(both), 0.95 * cv::countNonZero(results[0] == results[0]));
  }
}

/// Sets what may be set live, and tells what the node made of it.
StereoConfig configure(const ros::NodeHandle& private_node,
                       const std::function<void(StereoConfig&)>& change) {
  dynamic_reconfigure::Reconfigure call;
  ros::service::waitForService(private_node.resolveName("set_parameters"), ros::Duration(30.0));
  // An empty request changes nothing and tells how things stand.
  ros::NodeHandle node = private_node;
  ros::ServiceClient client =
      node.serviceClient<dynamic_reconfigure::Reconfigure>("set_parameters");
  EXPECT_TRUE(client.call(call));
  StereoConfig config;
  config.__fromMessage__(call.response.config);
  change(config);
  config.__toMessage__(call.request.config);
  EXPECT_TRUE(client.call(call));
  config.__fromMessage__(call.response.config);
  return config;
}

TEST(Stereo, IsTunedLiveWithinItsLimits) {
  Camera camera("tuned");
  const ros::NodeHandle private_node = parametersFor(camera, "tuned");
  const StereoPipeline stereo(camera.node(), private_node);
  Collector<sensor_msgs::Image> ranges(camera.node(), "range");
  Collector<StageTimes> times(camera.node(), "timing");
  const ros::Time stamp = ros::Time::now();
  publishPair(camera, stamp - ros::Duration(2.0), stamp);
  ASSERT_TRUE(eventually([&] { return ranges.size() == 1; }));
  const auto farthest = [](const sensor_msgs::Image& image) {
    double most = 0.0;
    const cv::Mat range = floats(image);
    for (const float r : cv::Mat_<float>(range))
      most = std::isnan(r) ? most : std::max<double>(most, r);
    return most;
  };
  EXPECT_GT(farthest(*ranges.last()), 2.0);
  const StereoConfig nearer = configure(private_node, [](StereoConfig& c) { c.max_range = 1.9; });
  EXPECT_EQ(nearer.max_range, 1.9);
  EXPECT_EQ(nearer.min_baseline, 0.1) << "the others stay";
  publishPair(camera, stamp + ros::Duration(2.0), stamp + ros::Duration(4.0));
  ASSERT_TRUE(eventually([&] { return ranges.size() >= 2; }));
  EXPECT_LE(farthest(*ranges.last()), 1.9);
  EXPECT_GT(farthest(*ranges.last()), 0.5);

  // What contradicts itself stays as it was, and who asked is told.
  const StereoConfig crossed = configure(private_node, [](StereoConfig& c) {
    c.min_range = 5.0;
    c.min_baseline = 0.5;
    c.epipolar_pixels = "one two";
    c.max_range = std::nan("");
  });
  EXPECT_EQ(crossed.max_range, 1.9);
  EXPECT_EQ(crossed.min_range, 0.0);
  EXPECT_EQ(crossed.min_baseline, 0.1);
  EXPECT_EQ(crossed.epipolar_pixels, "");
  StereoConfig preset = configure(private_node, [](StereoConfig& c) { c.preset = "accurate"; });
  EXPECT_EQ(preset.positions, 4);
  EXPECT_TRUE(preset.refine);
  preset = configure(private_node, [](StereoConfig& c) { c.preset = "balanced"; });
  EXPECT_EQ(preset.positions, 1);
  EXPECT_EQ(preset.hypotheses, 0);
  EXPECT_EQ(preset.reduce, 1);
  EXPECT_FALSE(preset.refine);
  preset = configure(private_node, [](StereoConfig& c) { c.preset = "fast"; });
  EXPECT_EQ(preset.reduce, 2);
  preset = configure(private_node, [](StereoConfig& c) { c.max_range = 3.0; });
  EXPECT_EQ(preset.preset, "fast") << "says nothing of ranges";
  const ros::Time later = stamp + ros::Duration(8.0);
  publishPair(camera, stamp + ros::Duration(6.0), later);
  ASSERT_TRUE(eventually([&] { return ranges.last()->header.stamp == later; }));
  EXPECT_EQ(ranges.last()->width, 200u) << "half of 400";
  for (const auto& change :
       {std::function<void(StereoConfig&)>([](StereoConfig& c) { c.reduce = 3; }),
        std::function<void(StereoConfig&)>([](StereoConfig& c) { c.refine = true; }),
        std::function<void(StereoConfig&)>([](StereoConfig& c) { c.hypotheses = 99; })}) {
    configure(private_node, [](StereoConfig& c) { c.preset = "balanced"; });
    preset = configure(private_node, change);
    EXPECT_EQ(preset.preset, "custom");
  }
  EXPECT_EQ(preset.hypotheses, 99);
  EXPECT_EQ(configure(private_node, [](StereoConfig& c) { c.preset = "best"; }).preset, "custom");

  ASSERT_TRUE(eventually([&] { return times.size() >= 2; }));
  const StageTimes& first = *times.messages().front();
  EXPECT_EQ(first.header.stamp, stamp);
  ASSERT_EQ(first.stages.size(), first.seconds.size());
  const auto total = std::find(first.stages.begin(), first.stages.end(), "total");
  ASSERT_NE(total, first.stages.end());
  const double whole = first.seconds[static_cast<std::size_t>(total - first.stages.begin())];
  EXPECT_GT(whole, 0.0);
  double parts = 0.0;
  for (std::size_t i = 0; i < first.stages.size(); ++i)
    if (first.stages[i] != "total" && first.stages[i].find("match ") != 0)
      parts += first.seconds[i];
  EXPECT_LE(parts, whole + 1e-6);
  EXPECT_GT(parts, 0.5 * whole);
}

TEST(Stereo, RegionReductionAndMaskChangeWhileItRuns) {
  Camera camera("cut");
  const ros::NodeHandle private_node = parametersFor(camera, "cut");
  const StereoPipeline stereo(camera.node(), private_node);
  Collector<sensor_msgs::PointCloud2> points(camera.node(), "points2");
  Collector<sensor_msgs::Image> overlays(camera.node(), "epipolar");
  double lap = 0.0;
  const ros::Time start = ros::Time::now();
  const auto nextCloud = [&] {
    lap += 4.0;
    const ros::Time last = start + ros::Duration(lap + 2.0);
    publishPair(camera, start + ros::Duration(lap), last);
    // The first of the pair makes a cloud with the frame before; it may come or not.
    const auto isLast = [&](const auto& collector) {
      return collector.last() && collector.last()->header.stamp == last;
    };
    EXPECT_TRUE(eventually([&] { return isLast(points) && isLast(overlays); }));
    return fromPointCloud(*points.last());
  };
  const auto known = [](const Cloud& cloud, int u, int v) {
    return !std::isnan(cloud.sigma.at<float>(v, u));
  };
  const Cloud whole = nextCloud();
  ASSERT_EQ(whole.sigma.size(), cv::Size(400, 300));

  StereoConfig now = configure(private_node, [](StereoConfig& c) {
    c.reduce = 2;
    c.roi = "100,60,200,180";
    c.cost = "zncc";
    c.window = "best";
  });
  EXPECT_EQ(now.reduce, 2);
  EXPECT_EQ(now.roi, "100,60,200,180");
  EXPECT_EQ(now.cost, "zncc");
  EXPECT_EQ(now.window, "best");
  const Cloud half = nextCloud();
  ASSERT_EQ(half.sigma.size(), cv::Size(200, 150));
  EXPECT_EQ(overlays.last()->width, 400u) << "both images side by side, reduced";
  std::vector<double> apart;
  for (int v = 0; v < 150; ++v) {
    for (int u = 0; u < 200; ++u) {
      if (!known(half, u, v)) continue;
      ASSERT_TRUE(cv::Rect(50, 30, 100, 90).contains(cv::Point(u, v)));
      // Honest geometry: the ray is that of the middle of four pixels.
      const cv::Vec3f p = half.xyz.at<cv::Vec3f>(v, u);
      const auto ray = views().lens.lens->unproject({2 * u + 0.5, 2 * v + 0.5});
      ASSERT_TRUE(ray);
      const double range = cv::norm(p);
      for (int i = 0; i < 3; ++i) ASSERT_NEAR(p[i] / range, (*ray)[i], 1e-5) << u << " " << v;
      const float truth = views().right_range.at<float>(2 * v, 2 * u);
      if (!std::isnan(truth)) apart.push_back(std::abs(range / truth - 1.0));
    }
  }
  ASSERT_GT(apart.size(), 5000u);
  std::nth_element(apart.begin(), apart.begin() + apart.size() / 2, apart.end());
  // Of so few pixels; the pixel beside is up to that far off on slanted walls.
  EXPECT_LT(apart[apart.size() / 2], 0.05);

  const std::string mask = (std::filesystem::path(lensPath()).parent_path() / "mask.png").string();
  cv::Mat robot(300, 400, CV_8UC1, cv::Scalar(255));
  robot(cv::Rect(200, 0, 200, 300)).setTo(0);
  ASSERT_TRUE(cv::imwrite(mask, robot));
  configure(private_node, [&](StereoConfig& c) {
    c.reduce = 1;
    c.roi = "";
    c.mask = mask;
    c.cost = "eq3.1";
    c.window = "surface";
  });
  const Cloud masked = nextCloud();
  ASSERT_EQ(masked.sigma.size(), cv::Size(400, 300));
  EXPECT_EQ(cv::countNonZero(masked.sigma(cv::Rect(200, 0, 200, 300)) > 0), 0);
  EXPECT_GT(cv::countNonZero(masked.sigma(cv::Rect(0, 0, 200, 300)) > 0), 10000);

  // What cannot be stays as it was, and who asked is told.
  now = configure(private_node, [](StereoConfig& c) {
    c.roi = "0,0,1000,1000";
    c.mask = "/none.png";
    c.cost = "magic";
    c.window = "magic";
  });
  EXPECT_EQ(now.roi, "");
  EXPECT_EQ(now.mask, mask);
  EXPECT_EQ(now.cost, "eq3.1");
  EXPECT_EQ(now.window, "surface");
}

TEST(Stereo, AStreamGetsBetterWithTheTravel) {
  Camera camera("stream");
  ros::NodeHandle private_node = parametersFor(camera, "stream");
  private_node.setParam("min_baseline", 0.02);
  private_node.setParam("stream", true);
  const StereoPipeline stereo(camera.node(), private_node);
  Collector<sensor_msgs::Image> ranges(camera.node(), "range");
  ASSERT_TRUE(eventually([&] { return camera.listeners() > 0; }));
  const ros::Time start = ros::Time::now();
  const auto go = [&](int step, double x) {
    const ros::Time stamp = start + ros::Duration(2.0 * step);
    camera.rest(x, stamp);
    camera.publish(toImage(test::roomFrom(x).image, "bgr8"), stamp);
  };
  std::vector<double> errors, shares;
  const cv::Mat truth = test::roomFrom(0.0).range;
  go(0, 0.0);
  for (int step = 1; step <= 5; ++step) {
    go(step, 0.05 * step);
    ASSERT_TRUE(eventually([&] { return ranges.size() == static_cast<std::size_t>(step); }))
        << step;
    EXPECT_EQ(ranges.last()->header.stamp, start) << "the reference stays";
    double share = 0.0;
    errors.push_back(medianError(floats(*ranges.last()), truth, &share));
    shares.push_back(share);
  }
  std::cout << "median errors with the travel:";
  for (const double error : errors) std::cout << ' ' << error;
  std::cout << '\n';
  EXPECT_LT(errors.back(), 0.5 * errors.front());
  EXPECT_GT(shares.back(), 0.95 * shares.front());

  // Back where it began there is nothing to learn; too far away another reference is taken.
  go(6, 0.001);
  go(7, 0.31);
  ASSERT_TRUE(eventually([&] { return ranges.size() == 6; }));
  EXPECT_GT(ranges.last()->header.stamp, start);
}

TEST(Stereo, WhatWasKnownBeforeFillsWhatImagesConfirm) {
  const auto lastOfTwo = [](const std::string& name, bool use_prior) {
    Camera camera(name);
    ros::NodeHandle private_node = parametersFor(camera, name);
    private_node.setParam("use_prior", use_prior);
    private_node.setParam("refine", true);
    const StereoPipeline stereo(camera.node(), private_node);
    Collector<sensor_msgs::Image> ranges(camera.node(), "range");
    const ros::Time stamp = ros::Time::now();
    publishPair(camera, stamp - ros::Duration(6.0), stamp - ros::Duration(4.0));
    EXPECT_TRUE(eventually([&] { return ranges.size() == 1; }));
    // The camera goes on; the cloud of before moves along.
    camera.rest(kBaseline + 0.11, stamp);
    camera.publish(toImage(test::roomFrom(kBaseline + 0.11).image, "bgr8"), stamp);
    EXPECT_TRUE(eventually([&] { return ranges.size() == 2; }));
    double share = 0.0;
    const double error =
        medianError(floats(*ranges.last()), test::roomFrom(kBaseline + 0.11).range, &share);
    return std::make_pair(share, error);
  };
  const auto [share, error] = lastOfTwo("with_prior", true);
  const auto [share_alone, error_alone] = lastOfTwo("without_prior", false);
  EXPECT_GT(share, share_alone);
  EXPECT_LT(error, 1.1 * error_alone);
}

TEST(Stereo, SaysWhatIsWrongWithImagesThatGiveNothing) {
  struct Case {
    cv::Scalar grey;
    const char* words;
  };
  int number = 0;
  for (const Case& c :
       {Case{cv::Scalar::all(0), "is black"}, Case{cv::Scalar::all(255), "saturated"},
        Case{cv::Scalar::all(90), "has no contrast"}}) {
    Camera camera("plain" + std::to_string(number++));
    const StereoPipeline stereo(camera.node(), parametersFor(camera, camera.base()));
    Collector<sensor_msgs::Image> ranges(camera.node(), "range");
    Collector<diagnostic_msgs::DiagnosticArray> diagnostics(camera.node(), "/diagnostics");
    ASSERT_TRUE(eventually([&] { return camera.listeners() > 0; }));
    const auto isTold = [&] {
      for (const auto& message : diagnostics.messages())
        for (const auto& status : message->status)
          if (status.message.find(c.words) != std::string::npos) return true;
      return false;
    };
    const cv::Mat plain(views().right.size(), CV_8UC3, c.grey);
    ros::Time stamp = ros::Time::now();
    // It is told while images come, and once a second.
    EXPECT_TRUE(eventually(
        [&] {
          for (const double x : {0.0, kBaseline}) {
            stamp += ros::Duration(2.0);
            camera.rest(x, stamp);
            camera.publish(toImage(plain, "bgr8"), stamp);
          }
          return eventually(isTold, 0.2);
        },
        60.0))
        << c.words;
    ASSERT_GT(ranges.size(), 0u) << "an honest empty cloud";
    EXPECT_EQ(cv::countNonZero(floats(*ranges.last()) > 0), 0);
  }
}

TEST(Stereo, ShowsEpipolarCurvesOfTheClickedPixels) {
  Camera camera("clicked");
  const StereoPipeline stereo(camera.node(), parametersFor(camera, "clicked"));
  Collector<sensor_msgs::Image> overlays(camera.node(), "epipolar");
  ros::Publisher pixels = camera.node().advertise<geometry_msgs::Point>("epipolar_mouse_left", 4);
  ros::Publisher points = camera.node().advertise<geometry_msgs::PointStamped>("clicked_point", 4);
  ASSERT_TRUE(eventually([&] { return pixels.getNumSubscribers() && points.getNumSubscribers(); }));
  geometry_msgs::Point pixel;
  pixel.x = 120;
  pixel.y = 170;
  pixels.publish(pixel);
  pixel.x = 790;  // the right half picks nothing
  pixels.publish(pixel);
  const ros::Time stamp = ros::Time::now();
  publishPair(camera, stamp - ros::Duration(2.0), stamp);
  ASSERT_TRUE(eventually([&] { return overlays.size() == 1; }));
  const auto changed = [&](const sensor_msgs::Image& overlay, int u, int v) {
    EXPECT_EQ(overlay.width, 800u);
    EXPECT_EQ(overlay.encoding, "bgr8");
    const cv::Mat picture(300, 800, CV_8UC3, const_cast<std::uint8_t*>(overlay.data.data()),
                          overlay.step);
    const cv::Rect around(u - 6, v - 6, 13, 13);
    return cv::norm(picture(around), views().right(around), cv::NORM_INF) > 60.0;
  };
  EXPECT_EQ(overlays.last()->header.stamp, stamp);
  EXPECT_TRUE(changed(*overlays.last(), 120, 170));
  EXPECT_FALSE(changed(*overlays.last(), 40, 40));

  // A point in space, as rviz publishes it, is picked where the camera sees it.
  geometry_msgs::PointStamped point;
  point.header.frame_id = camera.optical();
  const auto ray = views().lens.lens->unproject({40.0, 60.0});
  ASSERT_TRUE(ray);
  point.point.x = 3.0 * ray->x();
  point.point.y = 3.0 * ray->y();
  point.point.z = 3.0 * ray->z();
  points.publish(point);
  int lap = 0;
  EXPECT_TRUE(eventually(
      [&] {
        lap += 4;
        publishPair(camera, stamp + ros::Duration(lap), stamp + ros::Duration(lap + 2.0));
        const std::size_t before = overlays.size();
        eventually([&] { return overlays.size() > before; });
        return changed(*overlays.last(), 40, 60);
      },
      60.0));
}

TEST(Stereo, ShowsTheLensSurfaceToWhoComesLate) {
  Camera camera("shown");
  ros::NodeHandle private_node = parametersFor(camera, "shown");
  private_node.deleteParam("lens");
  const StereoPipeline stereo(camera.node(), private_node);
  ros::Publisher lenses = camera.node().advertise<LensModelMessage>("lens_model", 1, true);
  std_msgs::Header header;
  header.stamp = ros::Time::now();
  header.frame_id = camera.optical();
  lenses.publish(toLensModelMessage(lensFile(), header));
  ros::WallDuration(0.2).sleep();
  Collector<visualization_msgs::MarkerArray> markers(camera.node(), "lens_surface");
  ASSERT_TRUE(eventually([&] { return markers.size() > 0; }));
  ASSERT_EQ(markers.last()->markers.size(), 3u);
  const visualization_msgs::Marker& surface = markers.last()->markers[0];
  EXPECT_EQ(surface.header.frame_id, camera.optical());
  EXPECT_EQ(surface.ns, "surface");
  ASSERT_GT(surface.points.size(), 1000u);
  ASSERT_EQ(surface.points.size() % 3, 0u);
  ASSERT_EQ(surface.points.size(), surface.colors.size());
  // Every vertex stands over the pixel that its direction projects to, in one scale.
  const LensPtr kept = lensFile().lens;
  const LensModel& lens = *kept;
  double scale = 0.0;
  for (const auto& p : surface.points) {
    const Eigen::Vector3d at(p.x, p.y, p.z);
    const auto pixel = lens.project(at);
    ASSERT_TRUE(pixel);
    const double r = (*pixel - lens.center()).norm();
    if (r < 5.0) continue;
    if (scale == 0.0) scale = at.head<2>().norm() / r;
    ASSERT_NEAR(at.head<2>().norm() / r, scale, 1e-3 * scale);
  }
  ASSERT_GT(scale, 0.0);
  EXPECT_EQ(markers.last()->markers[1].ns, "sphere");
  for (const auto& p : markers.last()->markers[1].points)
    ASSERT_NEAR(std::sqrt(p.x * p.x + p.y * p.y + p.z * p.z), 0.1, 1e-9);
}

/// Plays a pair of two cameras into a node set up by parameters. @param name namespace, unique
void expectRangeFromTwoCameras(const std::string& name, ros::NodeHandle private_node) {
  ros::NodeHandle node(name);
  private_node.setParam("mode", "rig");
  private_node.setParam("max_range", 20.0);
  const StereoPipeline stereo(node, private_node);
  Collector<sensor_msgs::Image> ranges(node, "range");
  ros::Publisher left = node.advertise<sensor_msgs::Image>("left/image_raw", 5);
  ros::Publisher right = node.advertise<sensor_msgs::Image>("right/image_raw", 5);
  ASSERT_TRUE(eventually([&] { return left.getNumSubscribers() && right.getNumSubscribers(); }));
  // The reference is the left topic; here it carries the view whose truth is known.
  const sensor_msgs::ImagePtr reference = toImage(views().right, "bgr8");
  const sensor_msgs::ImagePtr displaced = toImage(views().left, "bgr8");
  reference->header.frame_id = name + "_left";
  displaced->header.frame_id = name + "_right";
  const bool came = eventually([&] {
    reference->header.stamp = ros::Time::now();
    displaced->header.stamp = reference->header.stamp + ros::Duration(0.003);
    left.publish(reference);
    right.publish(displaced);
    ros::WallDuration(0.2).sleep();
    return ranges.size() > 0;
  });
  ASSERT_TRUE(came);
  EXPECT_EQ(ranges.last()->header.frame_id, name + "_left");
  double share = 0.0;
  EXPECT_LT(medianError(floats(*ranges.last()), views().right_range, &share), 0.02);
  EXPECT_GT(share, 0.6);
}

TEST(Stereo, TwoCamerasWithTheirPoseFromTf) {
  ros::NodeHandle private_node("~by_tf");
  private_node.setParam("lens", lensPath());
  private_node.setParam("lens_displaced", lensPath());
  tf2_ros::StaticTransformBroadcaster transforms;
  transforms.sendTransform(toTransformStamped(Pose(Eigen::Translation3d(-kBaseline, 0, 0)),
                                              ros::Time::now(), "by_tf_left", "by_tf_right"));
  expectRangeFromTwoCameras("by_tf", private_node);
}

TEST(Stereo, TwoCamerasWithTheirPoseAndLensesFromTheRigFile) {
  const std::string rig_path =
      (std::filesystem::path(lensPath()).parent_path() / "rig.yaml").string();
  RigFile rig;
  rig.reference = rig.displaced = lensPath();
  rig.T_ref_disp = Pose(Eigen::Translation3d(-kBaseline, 0, 0));
  writeRigFile(rig_path, rig);
  ros::NodeHandle private_node("~by_file");
  private_node.setParam("rig", rig_path);
  expectRangeFromTwoCameras("by_file", private_node);
}

TEST(Stereo, TakesTheLensFromTheTopicAndTheLaterOneWins) {
  Camera camera("topic");
  ros::NodeHandle private_node = parametersFor(camera, "topic");
  private_node.deleteParam("lens");
  const StereoPipeline stereo(camera.node(), private_node);
  Collector<sensor_msgs::Image> ranges(camera.node(), "range");
  ros::Publisher lenses = camera.node().advertise<LensModelMessage>("lens_model", 3, true);
  ASSERT_TRUE(eventually([&] { return lenses.getNumSubscribers() > 0; }));
  std_msgs::Header header;
  header.frame_id = camera.optical();
  header.stamp = ros::Time::now();
  lenses.publish(toLensModelMessage(views().lens, header));
  // Neither an older lens nor a broken message takes its place.
  LensFile other = views().lens;
  other.image_size = {17, 17};
  header.stamp -= ros::Duration(100.0);
  lenses.publish(toLensModelMessage(other, header));
  LensModelMessage broken = toLensModelMessage(views().lens, header);
  broken.header.stamp = ros::Time::now() + ros::Duration(1.0);
  broken.yaml = "lens_surface: {version: 1, model: [[[";
  lenses.publish(broken);
  ros::WallDuration(0.3).sleep();
  const ros::Time stamp = ros::Time::now();
  publishPair(camera, stamp - ros::Duration(2.0), stamp);
  EXPECT_TRUE(eventually([&] { return ranges.size() > 0; }));
}

TEST(Stereo, RefusesParametersByName) {
  const auto refusal = [](const std::string& name, const std::string& value) -> std::string {
    ros::NodeHandle private_node("~refused");
    private_node.setParam(name, value);
    std::string message = "taken";
    try {
      StereoPipeline stereo(ros::NodeHandle("refused"), private_node);
    } catch (const Error& error) {
      message = error.what();
    }
    private_node.deleteParam(name);
    return message;
  };
  using testing::HasSubstr;
  EXPECT_THAT(refusal("mode", "three"), HasSubstr("mode"));
  EXPECT_THAT(refusal("positions", "0"), HasSubstr("positions"));
  EXPECT_THAT(refusal("min_baseline", "nan"), HasSubstr("min_baseline"));
  EXPECT_THAT(refusal("min_baseline", "5"), HasSubstr("max_baseline"));
  EXPECT_THAT(refusal("max_range", "-1"), HasSubstr("max_range"));
  EXPECT_THAT(refusal("matcher", "magic"), HasSubstr("matcher"));
  EXPECT_THAT(refusal("mask", "/none.png"), HasSubstr("/none.png"));
  EXPECT_THAT(refusal("lens", "/none.yaml"), HasSubstr("/none.yaml"));
  EXPECT_THAT(refusal("hypotheses", "99999"), HasSubstr("hypotheses"));
  EXPECT_THAT(refusal("cost", "sad"), HasSubstr("cost"));
  EXPECT_THAT(refusal("window", "round"), HasSubstr("window"));
  EXPECT_THAT(refusal("roi", "1,2,3"), HasSubstr("roi"));
  EXPECT_THAT(refusal("reduce", "0"), HasSubstr("reduce"));
}

TEST(StereoMessages, CloudsComeBackAsTheyWent) {
  // Rows begin at any address, and are longer than the blocks that they are written in.
  constexpr int kRows = 3, kColumns = 133;
  const cv::Size size(kColumns, kRows);
  Cloud cloud{cv::Mat(size, CV_32FC3), cv::Mat(size, CV_8UC3), cv::Mat(size, CV_32FC1),
              cv::Mat(size, CV_32FC1)};
  cv::randu(cloud.xyz, -5.0F, 5.0F);
  cv::randu(cloud.bgr, 0, 255);
  cv::randu(cloud.sigma, 0.0F, 1.0F);
  cv::randu(cloud.score, 0.0F, 1.0F);
  const sensor_msgs::PointCloud2Ptr message = toPointCloud(cloud, {});
  const Cloud back = fromPointCloud(*message);
  EXPECT_EQ(cv::norm(back.xyz, cloud.xyz, cv::NORM_INF), 0.0);
  EXPECT_EQ(cv::norm(back.bgr, cloud.bgr, cv::NORM_INF), 0.0);
  EXPECT_EQ(cv::norm(back.sigma, cloud.sigma, cv::NORM_INF), 0.0);
  EXPECT_EQ(cv::norm(back.score, cloud.score, cv::NORM_INF), 0.0);
  const auto ranges = [](const sensor_msgs::PointCloud2& of) {
    cv::Mat result(kRows, kColumns, CV_32FC1);
    sensor_msgs::PointCloud2ConstIterator<float> in(of, "range");
    for (int i = 0; i < kRows * kColumns; ++i, ++in)
      result.at<float>(i / kColumns, i % kColumns) = *in;
    return result;
  };
  for (int v = 0; v < kRows; ++v)
    for (int u = 0; u < kColumns; ++u)
      EXPECT_FLOAT_EQ(ranges(*message).at<float>(v, u), cv::norm(cloud.xyz.at<cv::Vec3f>(v, u)));
  // Filled right from a match it is the same, and so is one that was filled before.
  MatchResult match;
  match.range = cloud.sigma * 3.0;
  match.range.at<float>(1, 2) = std::numeric_limits<float>::quiet_NaN();
  match.sigma = cloud.sigma;
  match.score = cloud.score;
  cv::Mat grey;
  cv::cvtColor(cloud.bgr, grey, cv::COLOR_BGR2GRAY);
  sensor_msgs::PointCloud2 filled = *message;
  for (const cv::Mat& picture : {cloud.bgr, grey}) {
    fillPointCloud(match, cloud.xyz, picture, {}, 2, &filled);
    const sensor_msgs::PointCloud2Ptr whole =
        toPointCloud(makeCloud(match, cloud.xyz, picture), {});
    EXPECT_EQ(filled.fields, whole->fields);
    const Cloud a = fromPointCloud(filled), b = fromPointCloud(*whole);
    for (int v = 0; v < kRows; ++v) {
      for (int u = 0; u < kColumns; ++u) {
        const cv::Vec3f p = a.xyz.at<cv::Vec3f>(v, u), q = b.xyz.at<cv::Vec3f>(v, u);
        EXPECT_TRUE(p == q || (std::isnan(p[0]) && std::isnan(q[0]))) << u << " " << v;
      }
    }
    EXPECT_EQ(cv::norm(a.bgr, b.bgr, cv::NORM_INF), 0.0);
    EXPECT_TRUE(std::isnan(a.xyz.at<cv::Vec3f>(1, 2)[0]));
    cv::Mat along = ranges(filled);
    EXPECT_TRUE(std::isnan(along.at<float>(1, 2)));
    along.at<float>(1, 2) = match.range.at<float>(0, 0);
    cv::Mat expected = match.range.clone();
    expected.at<float>(1, 2) = expected.at<float>(0, 0);
    EXPECT_EQ(cv::norm(along, expected, cv::NORM_INF), 0.0);
  }
  EXPECT_THROW(fillPointCloud(match, cloud.xyz, cv::Mat(2, 2, CV_8UC1), {}, 1, &filled), Error);
  sensor_msgs::PointCloud2 spoiled = *message;
  spoiled.data.pop_back();
  EXPECT_THROW(fromPointCloud(spoiled), InputError);
  spoiled = *message;
  spoiled.width = 0xffffffffu;
  EXPECT_THROW(fromPointCloud(spoiled), InputError);
  spoiled = *message;
  spoiled.fields[3].name = "intensity";
  EXPECT_THROW(fromPointCloud(spoiled), InputError);
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) { return omnister::test::runTests(argc, argv, "stereo_test"); }
