// SPDX-License-Identifier: Apache-2.0
#include "ros/message/conversions.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <boost/make_shared.hpp>
#include <cmath>
#include <limits>
#include <opencv2/core.hpp>

#include "health/clock_watch.h"
#include "omnister/lens/lens_models.h"
#include "ros/message/image_input.h"

namespace omnister {
namespace {

using testing::HasSubstr;

LensFile lensFile() {
  LensFile file;
  file.image_size = {640, 480};
  LensStructure structure;
  structure.model = "conic";
  file.lens = makeLens(structure, Eigen::Vector2d(319.5, 239.5), 200.0, 1.4);
  file.calibration.rms_px = 0.25;
  return file;
}

TEST(ImageMessages, BigEndianSamplesAreReadAsTheyWereMeant) {
  const auto image = boost::make_shared<sensor_msgs::Image>();
  image->header.stamp = ros::Time(1.0);
  image->header.frame_id = "camera_optical";
  image->encoding = "mono16";
  image->width = 2;
  image->height = 2;
  image->step = 6;  // a sample of padding
  image->is_bigendian = 1;
  image->data = {0x12, 0, 0x34, 0, 9, 9, 0x56, 0, 0xff, 0, 9, 9};
  const int bits = significantBits(*image);
  EXPECT_EQ(bits, 16);
  const cv::Mat expected = (cv::Mat_<uchar>(2, 2) << 0x12, 0x34, 0x56, 0xff);
  EXPECT_EQ(cv::norm(toGray(*image, bits), expected, cv::NORM_INF), 0.0);
  EXPECT_LE(cv::norm(toMat8(image, false), expected, cv::NORM_INF), 1.0);
}

TEST(MissingMessages, AreCountedByNumbersOfMessagesThatFollowEachOther) {
  MissingMessages missing;
  const auto before = [&](std::uint32_t number, double stamp) {
    std_msgs::Header header;
    header.seq = number;
    header.stamp = ros::Time(stamp);
    return missing.before(header);
  };
  EXPECT_EQ(before(20, 1.0), 0U);
  EXPECT_EQ(before(21, 1.1), 0U);
  EXPECT_EQ(before(24, 1.4), 2U);
  EXPECT_EQ(before(9, 0.9), 0U);  // late, and numbered for others
  EXPECT_EQ(before(25, 1.5), 0U);
  EXPECT_EQ(before(1, 1.6), 0U);  // the publisher began anew
  EXPECT_EQ(before(3, 1.8), 1U);
  // The clock was set back.
  for (std::uint32_t i = 0; i < 6; ++i) EXPECT_EQ(before(4 + i, 0.2 + 0.1 * i), 0U) << i;
  EXPECT_EQ(before(12, 1.0), 2U);
  missing.reset();
  EXPECT_EQ(before(50, 0.1), 0U);
}

TEST(Stamps, SurviveTheRoundTripAndStayInRange) {
  const device::Stamp stamp(std::chrono::nanoseconds(1342626147554042001LL));
  EXPECT_EQ(fromRosTime(toRosTime(stamp)), stamp);
  EXPECT_EQ(toRosTime(device::Stamp(std::chrono::nanoseconds(-5))), ros::Time(0, 0));
  EXPECT_EQ(
      toRosTime(device::Stamp(std::chrono::nanoseconds(std::numeric_limits<std::int64_t>::max()))),
      ros::TIME_MAX);
}

TEST(ClockWatch, TellsAClockThatWasSetFromOneThatIsKept) {
  ClockWatch watch;
  EXPECT_FALSE(watch.jump(1.7e9, 100.0));
  // Kept by a daemon: a little fast, then slow.
  for (int i = 1; i <= 10; ++i) EXPECT_FALSE(watch.jump(1.7e9 + 1.0005 * i, 100.0 + i)) << i;
  EXPECT_NEAR(watch.jump(1.7e9 + 41.0, 111.0).value_or(0.0), 30.0, 0.01);
  EXPECT_FALSE(watch.jump(1.7e9 + 42.0, 112.0));
  EXPECT_NEAR(watch.jump(1.7e9 - 60.0, 113.0).value_or(0.0), -103.0, 0.01);
  EXPECT_FALSE(watch.jump(1.7e9 - 50.0, 123.0));
}

TEST(Transforms, SurviveTheRoundTripAndRefuseNonsense) {
  Pose pose = Pose::Identity();
  pose.linear() = Eigen::AngleAxisd(0.7, Eigen::Vector3d(1, 2, 3).normalized()).toRotationMatrix();
  pose.translation() << 0.1, -0.2, 0.3;
  EXPECT_TRUE(fromTransform(toTransform(pose), "tf").isApprox(pose, 1e-12));
  geometry_msgs::Transform bad = toTransform(pose);
  bad.translation.x = std::nan("");
  EXPECT_THROW(fromTransform(bad, "tf"), InputError);
  bad = toTransform(pose);
  bad.rotation = geometry_msgs::Quaternion();
  EXPECT_THROW(fromTransform(bad, "tf"), InputError);
}

TEST(Frames, TheOpticalFrameLooksForward) {
  const Pose pose = opticalInLink();
  EXPECT_TRUE((pose * Eigen::Vector3d(0, 0, 1)).isApprox(Eigen::Vector3d(1, 0, 0)));
  EXPECT_TRUE((pose * Eigen::Vector3d(1, 0, 0)).isApprox(Eigen::Vector3d(0, -1, 0)));
  EXPECT_TRUE((pose * Eigen::Vector3d(0, 1, 0)).isApprox(Eigen::Vector3d(0, 0, -1)));
  EXPECT_NEAR(pose.linear().determinant(), 1.0, 1e-15);
  EXPECT_EQ(linkFrame("camera_optical"), "camera_link");
  EXPECT_EQ(linkFrame("left_optical_frame"), "left_link");
  EXPECT_EQ(linkFrame("eye"), "eye_link");
}

TEST(Images, KeepTheirPixels) {
  cv::Mat big(10, 12, CV_8UC3);
  cv::randu(big, 0, 255);
  const cv::Mat part = big(cv::Rect(2, 3, 5, 4));  // rows that do not follow on each other
  const sensor_msgs::ImagePtr message = toImage(part, "bgr8");
  EXPECT_EQ(message->step, 15u);
  EXPECT_EQ(cv::norm(toMat8(message, true), part, cv::NORM_INF), 0.0);
  EXPECT_THROW(toImage(part, "mono8"), Error);
  EXPECT_THROW(toImage(part, "purple"), Error);
  EXPECT_THROW(toImage(cv::Mat(), "mono8"), Error);
}

TEST(Images, EveryCameraEncodingBecomesEightBit) {
  // Of the message's own memory where it need not change.
  const auto taken = [](const cv::Mat& image, const std::string& encoding, bool color) {
    return toMat8(toImage(image, encoding), color).clone();
  };
  cv::Mat gray16(8, 8, CV_16UC1, cv::Scalar(0x8080));
  int converted = 0;
  for (const std::string encoding : {"mono16", "16UC1", "bayer_rggb16", "bayer_grbg16"}) {
    for (const bool color : {false, true}) {
      const cv::Mat image = taken(gray16, encoding, color);
      ASSERT_EQ(image.type(), color ? CV_8UC3 : CV_8UC1) << encoding;
      EXPECT_NEAR(image.ptr(4)[4], 0x80, 1) << encoding;
      ++converted;
    }
  }
  cv::Mat gray8(8, 8, CV_8UC1, cv::Scalar(77));
  for (const std::string encoding :
       {"mono8", "8UC1", "bayer_rggb8", "bayer_bggr8", "bayer_gbrg8"}) {
    for (const bool color : {false, true}) {
      const cv::Mat image = taken(gray8, encoding, color);
      ASSERT_EQ(image.type(), color ? CV_8UC3 : CV_8UC1) << encoding;
      EXPECT_NEAR(image.ptr(4)[4], 77, 1) << encoding;
      ++converted;
    }
  }
  cv::Mat bgr(8, 8, CV_8UC3, cv::Scalar(10, 20, 200));
  for (const std::string encoding : {"bgr8", "8UC3"}) {
    EXPECT_EQ(taken(bgr, encoding, true).at<cv::Vec3b>(0, 0), cv::Vec3b(10, 20, 200));
    ++converted;
  }
  EXPECT_EQ(taken(bgr, "rgb8", true).at<cv::Vec3b>(0, 0), cv::Vec3b(200, 20, 10));
  cv::Mat bgra(8, 8, CV_8UC4, cv::Scalar(10, 20, 200, 255));
  EXPECT_EQ(taken(bgra, "bgra8", true).at<cv::Vec3b>(0, 0), cv::Vec3b(10, 20, 200));
  EXPECT_EQ(converted, 20);
}

TEST(Images, WhatDoesNotAddUpIsRefusedByField) {
  const auto refusal = [](const std::function<void(sensor_msgs::Image*)>& spoil) -> std::string {
    const auto message = boost::make_shared<sensor_msgs::Image>(
        *toImage(cv::Mat(4, 6, CV_8UC1, cv::Scalar(1)), "mono8"));
    spoil(message.get());
    try {
      toMat8(message, true);
    } catch (const InputError& e) {
      return e.what();
    }
    return "";
  };
  EXPECT_EQ(refusal([](sensor_msgs::Image*) {}), "");
  EXPECT_THAT(refusal([](sensor_msgs::Image* m) { m->width = 0; }), HasSubstr("size"));
  EXPECT_THAT(refusal([](sensor_msgs::Image* m) { m->width = 7; }), HasSubstr("step"));
  EXPECT_THAT(refusal([](sensor_msgs::Image* m) { m->height = 5; }), HasSubstr("data"));
  EXPECT_THAT(refusal([](sensor_msgs::Image* m) { m->data.resize(23); }), HasSubstr("data"));
  EXPECT_THAT(refusal([](sensor_msgs::Image* m) { m->step = 5; }), HasSubstr("step"));
  EXPECT_THAT(refusal([](sensor_msgs::Image* m) { m->width = m->height = 4000000000u; }),
              HasSubstr("size"));
  EXPECT_THAT(refusal([](sensor_msgs::Image* m) { m->encoding = "purple"; }),
              HasSubstr("encoding"));
  EXPECT_THAT(refusal([](sensor_msgs::Image* m) { m->encoding = ""; }), HasSubstr("encoding"));
  EXPECT_THAT(refusal([](sensor_msgs::Image* m) { m->encoding = "8UC99999"; }), testing::Not(""));
  EXPECT_THAT(refusal([](sensor_msgs::Image* m) { m->encoding = "8UC-1"; }), testing::Not(""));
  EXPECT_THAT(refusal([](sensor_msgs::Image* m) {
                m->encoding = "32FC1";
                m->width = 1;
              }),
              HasSubstr("encoding"));
}

TEST(Lenses, TravelWhole) {
  const LensFile file = lensFile();
  std_msgs::Header header;
  header.frame_id = "camera_optical";
  const LensModelMessage message = toLensModelMessage(file, header);
  EXPECT_EQ(message.model, "conic");
  EXPECT_EQ(message.width, 640u);
  EXPECT_EQ(message.rms_px, 0.25);
  EXPECT_TRUE(std::isnan(message.holdout_rms_px));
  EXPECT_EQ(message.parameter_names.size(), message.parameters.size());
  const LensFile back = fromLensModelMessage(message, "lens_model");
  EXPECT_EQ(back.lens->parameters(), file.lens->parameters());
  EXPECT_EQ(back.lens->maxTheta(), file.lens->maxTheta());
  EXPECT_EQ(toLensModelMessage(back, header).yaml, message.yaml);
}

TEST(Lenses, AMessageThatContradictsItselfIsRefused) {
  const LensModelMessage good = toLensModelMessage(lensFile(), std_msgs::Header());
  LensModelMessage bad = good;
  bad.width = 641;
  EXPECT_THROW(fromLensModelMessage(bad, "lens_model"), InputError);
  bad = good;
  bad.model = "spherical";
  EXPECT_THROW(fromLensModelMessage(bad, "lens_model"), InputError);
  bad = good;
  bad.yaml = "";
  EXPECT_THROW(fromLensModelMessage(bad, "lens_model"), InputError);
  bad.yaml.assign(5u << 20, ' ');
  EXPECT_THROW(fromLensModelMessage(bad, "lens_model"), InputError);
}

TEST(Lenses, CameraInfoIsTheStandardModelOrNone) {
  const sensor_msgs::CameraInfo info = toCameraInfo(lensFile());
  ASSERT_EQ(info.distortion_model, "equidistant");
  EXPECT_EQ(info.D.size(), 4u);
  EXPECT_GT(info.K[0], 0.0);
  EXPECT_EQ(info.K[8], 1.0);
  EXPECT_EQ(info.R[0], 1.0);
  EXPECT_EQ(info.R[4], 1.0);
  EXPECT_EQ(info.R[8], 1.0);
  EXPECT_EQ(info.P[0], info.K[0]);
  EXPECT_EQ(info.P[2], info.K[2]);
  EXPECT_EQ(info.P[5], info.K[4]);
  EXPECT_EQ(info.P[6], info.K[5]);
  EXPECT_EQ(info.P[10], 1.0);
  EXPECT_EQ(info.P[3], 0.0);
  const sensor_msgs::CameraInfo none = uncalibratedCameraInfo(4, 3);
  EXPECT_EQ(none.distortion_model, "");
  EXPECT_TRUE(none.D.empty());
  for (const double k : none.K) EXPECT_EQ(k, 0.0);
}

}  // namespace
}  // namespace omnister
