// SPDX-License-Identifier: Apache-2.0
// Clouds, their files, and planes in them.
#include "omnister/stereo/cloud.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <cstring>
#include <filesystem>
#include <limits>
#include <opencv2/imgcodecs.hpp>
#include <random>

#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/lens/lens_models.h"
#include "omnister/stereo/plane_fit.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;
using ::testing::HasSubstr;
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

class CloudFile : public ::testing::Test {
 protected:
  // 5 x 3, every other pixel invalid.
  static Cloud sample() {
    Cloud cloud{cv::Mat(3, 5, CV_32FC3), cv::Mat(3, 5, CV_8UC3), cv::Mat(3, 5, CV_32FC1),
                cv::Mat(3, 5, CV_32FC1)};
    for (int i = 0; i < 15; ++i) {
      const bool valid = i % 2 == 0;
      cloud.xyz.at<cv::Vec3f>(i / 5, i % 5) =
          valid ? cv::Vec3f(0.5f * i, -1.25f * i, 100.0f + i) : cv::Vec3f(kNan, kNan, kNan);
      cloud.bgr.at<cv::Vec3b>(i / 5, i % 5) = cv::Vec3b(i, 100 + i, 255 - i);
      cloud.sigma.at<float>(i / 5, i % 5) = valid ? 0.01f * i : kNan;
      cloud.score.at<float>(i / 5, i % 5) = valid ? 0.9f : kNan;
    }
    return cloud;
  }

  std::string refusal(const std::string& bytes) const {
    const fs::path path = folder_ / "bad.ply";
    writeFileAtomically(path, bytes);
    try {
      readCloud(path);
    } catch (const InputError& error) {
      EXPECT_THAT(error.what(), HasSubstr("bad.ply"));
      return error.what();
    }
    return "accepted";
  }

  std::size_t entries() const {
    return std::distance(fs::directory_iterator(folder_), fs::directory_iterator());
  }

  const test::TemporaryFolder temporary_;
  const fs::path folder_ = temporary_.path();
};

bool sameBytes(const cv::Mat& a, const cv::Mat& b) {
  return a.size() == b.size() && a.type() == b.type() &&
         std::memcmp(a.data, b.data, a.total() * a.elemSize()) == 0;
}

TEST_F(CloudFile, PlyReadsBackToTheLastBit) {
  const Cloud cloud = sample();
  writeCloud(folder_ / "cloud.ply", cloud);
  const Cloud again = readCloud(folder_ / "cloud.ply");
  EXPECT_TRUE(sameBytes(again.xyz, cloud.xyz));
  EXPECT_TRUE(sameBytes(again.bgr, cloud.bgr));
  EXPECT_TRUE(sameBytes(again.sigma, cloud.sigma));
  EXPECT_TRUE(sameBytes(again.score, cloud.score));
  EXPECT_EQ(entries(), 1u);
}

TEST_F(CloudFile, PlyHasTheDocumentedHeaderAndLayout) {
  writeCloud(folder_ / "cloud.PLY", sample());
  const std::string bytes = readFile(folder_ / "cloud.PLY");
  const std::string header =
      "ply\nformat binary_little_endian 1.0\ncomment width 5\ncomment height 3\nelement vertex 15\n"
      "property float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar "
      "green\n"
      "property uchar blue\nproperty float sigma\nproperty float score\nend_header\n";
  EXPECT_EQ(bytes.substr(0, header.size()), header);
  ASSERT_EQ(bytes.size(), header.size() + 15 * 23);
  const char* vertex = bytes.data() + header.size() + 4 * 23;
  float z = 0.0f;
  std::memcpy(&z, vertex + 8, 4);
  EXPECT_EQ(z, 104.0f);
  EXPECT_EQ(static_cast<unsigned char>(vertex[12]), 251) << "red";
  EXPECT_EQ(static_cast<unsigned char>(vertex[13]), 104) << "green";
  EXPECT_EQ(static_cast<unsigned char>(vertex[14]), 4) << "blue";
}

TEST_F(CloudFile, PcdIsOrganizedWithPackedColour) {
  writeCloud(folder_ / "cloud.pcd", sample());
  const std::string bytes = readFile(folder_ / "cloud.pcd");
  const std::string end = "DATA binary\n";
  const std::size_t data = bytes.find(end) + end.size();
  const std::string header = bytes.substr(0, data);
  for (const char* line : {"\nVERSION 0.7\n", "\nFIELDS x y z rgb sigma score\n", "\nWIDTH 5\n",
                           "\nHEIGHT 3\n", "\nPOINTS 15\n", "\nTYPE F F F F F F\n"}) {
    EXPECT_THAT(header, HasSubstr(line));
  }
  ASSERT_EQ(bytes.size(), data + 15 * 24);
  std::uint32_t rgb = 0;
  std::memcpy(&rgb, bytes.data() + data + 2 * 24 + 12, 4);
  EXPECT_EQ(rgb, (253u << 16) | (102u << 8) | 2u);
}

TEST_F(CloudFile, BrokenFilesAreRefused) {
  writeCloud(folder_ / "cloud.ply", sample());
  const std::string good = readFile(folder_ / "cloud.ply");
  const auto changed = [&](const std::string& from, const std::string& to) {
    std::string bytes = good;
    bytes.replace(bytes.find(from), from.size(), to);
    return refusal(bytes);
  };
  EXPECT_EQ(refusal(good), "accepted");
  EXPECT_THAT(refusal(""), HasSubstr("line 1"));
  EXPECT_THAT(refusal("ply\n"), HasSubstr("line 2"));
  EXPECT_THAT(refusal(std::string(100000, 'x')), HasSubstr("line 1"));
  EXPECT_THAT(refusal(good + "x"), HasSubstr("346 bytes of vertices, expected 345"));
  EXPECT_THAT(refusal(good.substr(0, good.size() - 1)), HasSubstr("344 bytes"));
  EXPECT_THAT(changed("binary_little_endian", "ascii"), HasSubstr("line 2"));
  EXPECT_THAT(changed("width 5", "width 0"), HasSubstr("line 3"));
  EXPECT_THAT(changed("width 5", "width -5"), HasSubstr("line 3"));
  EXPECT_THAT(changed("height 3", "height 99999999999999999999999"), HasSubstr("line 4"));
  EXPECT_THAT(changed("vertex 15", "vertex 16"), HasSubstr("line 5"));
  EXPECT_THAT(changed("float z", "double z"), HasSubstr("line 8"));
  EXPECT_THAT(changed("width 5\ncomment height 3\nelement vertex 15",
                      "width 65535\ncomment height 65535\nelement vertex 4294836225"),
              HasSubstr("bytes of vertices"));
  std::string infinite = good;
  const float infinity = std::numeric_limits<float>::infinity();
  std::memcpy(infinite.data() + good.size() - 23, &infinity, 4);
  EXPECT_THAT(refusal(infinite), HasSubstr("vertex (4, 2)"));
  EXPECT_THROW(readCloud(folder_ / "absent.ply"), IoError);
}

TEST_F(CloudFile, AFailedWriteNamesTheFileAndLeavesNothing) {
  const auto refusalOf = [](auto action) -> std::string {
    try {
      action();
    } catch (const Error& error) {
      return error.what();
    }
    return "accepted";
  };
  EXPECT_THAT(refusalOf([&] { writeCloud(folder_ / "cloud.xyz", sample()); }),
              HasSubstr("expected .ply or .pcd"));
  EXPECT_THAT(refusalOf([&] { writeCloud(folder_ / "absent" / "cloud.ply", sample()); }),
              HasSubstr("absent/cloud.ply"));
  EXPECT_THAT(refusalOf([&] { writeRange(folder_ / "range.png", cv::Mat(2, 2, CV_32FC1)); }),
              HasSubstr("expected .tif or .tiff"));
  EXPECT_THAT(refusalOf([&] {
                writeRange(folder_ / "absent" / "r.tiff", cv::Mat(2, 2, CV_32FC1, cv::Scalar(1)));
              }),
              HasSubstr("absent/r.tiff"));
  Cloud broken = sample();
  broken.sigma = cv::Mat(2, 2, CV_32FC1);
  EXPECT_THAT(refusalOf([&] { writeCloud(folder_ / "cloud.ply", broken); }),
              HasSubstr("different size"));
  EXPECT_EQ(entries(), 0u);
  // Staged but not committed: the old file stays.
  writeFileAtomically(folder_ / "cloud.ply", "old");
  { const auto staged = stageCloud(folder_ / "cloud.ply", sample()); }
  EXPECT_EQ(readFile(folder_ / "cloud.ply"), "old");
  EXPECT_EQ(entries(), 1u);
}

TEST_F(CloudFile, RangeImageKeepsFloatsAndNan) {
  cv::Mat range(4, 6, CV_32FC1, cv::Scalar(kNan));
  range.at<float>(1, 2) = 1.2345678f;
  writeRange(folder_ / "range.tiff", range);
  const cv::Mat again = cv::imread((folder_ / "range.tiff").string(), cv::IMREAD_UNCHANGED);
  ASSERT_EQ(again.type(), CV_32FC1);
  ASSERT_EQ(again.size(), range.size());
  EXPECT_EQ(again.at<float>(1, 2), 1.2345678f);
  EXPECT_TRUE(std::isnan(again.at<float>(0, 0)));
}

TEST(MakeCloud, PutsPointsOnTheirRays) {
  const LensPtr lens = makeLens(LensStructure{}, {19.5, 14.5}, 12.0, 1.8);
  MatchResult match;
  match.range = cv::Mat(30, 40, CV_32FC1, cv::Scalar(2.5));
  match.range.at<float>(3, 4) = kNan;
  match.range.at<float>(15, 20) = std::numeric_limits<float>::infinity();
  match.sigma = cv::Mat(30, 40, CV_32FC1, cv::Scalar(0.1));
  match.score = cv::Mat(30, 40, CV_32FC1, cv::Scalar(0.5));
  const cv::Mat image(30, 40, CV_8UC1, cv::Scalar(77));
  const Cloud cloud = makeCloud(match, *lens, image);
  int points = 0;
  for (int v = 0; v < 30; ++v) {
    for (int u = 0; u < 40; ++u) {
      const auto& p = cloud.xyz.at<cv::Vec3f>(v, u);
      const auto ray = lens->unproject({static_cast<double>(u), static_cast<double>(v)});
      if (!ray || !std::isfinite(match.range.at<float>(v, u))) {
        EXPECT_TRUE(std::isnan(p[0]) && std::isnan(p[1]) && std::isnan(p[2]));
        continue;
      }
      ++points;
      EXPECT_LT((Eigen::Vector3d(p[0], p[1], p[2]) - 2.5 * *ray).norm(), 1e-6);
      EXPECT_EQ(cloud.bgr.at<cv::Vec3b>(v, u), cv::Vec3b(77, 77, 77));
    }
  }
  EXPECT_GT(points, 1000);
  EXPECT_THROW(makeCloud(match, *lens, cv::Mat(30, 41, CV_8UC1)), Error);
  EXPECT_THROW(makeCloud(match, *lens, cv::Mat(30, 40, CV_16UC1)), Error);
}

// Interpolated rays against a projection for every pixel, where the field ends inside the image and
// outside it.
TEST(PointMaker, MakesTheSameCloudAsEveryRayForItself) {
  for (const cv::Size size :
       {cv::Size(400, 300), cv::Size(397, 301), cv::Size(9, 1), cv::Size(3, 70)}) {
    for (double max_theta : {0.7, 1.7}) {
      LensStructure structure;
      structure.model = "asphere";
      structure.even_terms = 2;
      const LensPtr lens =
          makeLens(structure, {0.52 * size.width, 0.47 * size.height}, 130.0, max_theta);
      MatchResult match;
      match.range = cv::Mat(size, CV_32FC1, cv::Scalar(1.0));
      match.range.at<float>(0, 0) = kNan;
      match.sigma = match.score = cv::Mat(size, CV_32FC1, cv::Scalar(0.5));
      cv::Mat image(size, CV_8UC3);
      cv::randu(image, 0, 255);
      const PointMaker maker(*lens, size);
      const Cloud fast = maker.make(match, image), slow = makeCloud(match, *lens, image);
      double worst = 0.0;
      std::size_t field = 0;
      for (int v = 0; v < size.height; ++v) {
        for (int u = 0; u < size.width; ++u) {
          const auto& a = fast.xyz.at<cv::Vec3f>(v, u);
          const auto& b = slow.xyz.at<cv::Vec3f>(v, u);
          const bool valid = !std::isnan(b[0]);
          ASSERT_EQ(!std::isnan(a[0]), valid) << u << ' ' << v;
          if (valid) worst = std::max(worst, cv::norm(a - b));
          field += lens->unproject({double(u), double(v)}).has_value();
        }
      }
      EXPECT_LT(worst, 1e-6);
      EXPECT_EQ(maker.countField(), field);
      EXPECT_EQ(maker.countField(cv::Mat(size, CV_8UC1, cv::Scalar(0))), 0u);
      EXPECT_TRUE(sameBytes(fast.bgr, image));
    }
  }
}

// A plane seen by a wide camera, with ranges wrong in proportion to their square, outliers and
// holes.
cv::Mat noisyPlane(const Eigen::Vector3d& normal, double distance, double outliers) {
  const LensPtr lens = makeLens(LensStructure{}, {99.5, 74.5}, 60.0, 1.5);
  std::mt19937 random(3);
  std::normal_distribution<double> gauss;
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  cv::Mat xyz(150, 200, CV_32FC3, cv::Scalar::all(kNan));
  for (int v = 0; v < 150; ++v) {
    for (int u = 0; u < 200; ++u) {
      const auto ray = lens->unproject({static_cast<double>(u), static_cast<double>(v)});
      if (!ray || uniform(random) < 0.1) continue;
      double range = -distance / normal.dot(*ray);
      if (!(range > 0.0) || range > 20.0) continue;
      range += 0.002 * range * range * gauss(random);
      if (uniform(random) < outliers) range *= 0.3 + uniform(random);
      const Eigen::Vector3d p = range * *ray;
      xyz.at<cv::Vec3f>(v, u) = cv::Vec3f(p.x(), p.y(), p.z());
    }
  }
  return xyz;
}

TEST(FitPlane, FindsTheGroundAmongOutliers) {
  const Eigen::Vector3d normal = Eigen::Vector3d(0.1, -0.9, -0.3).normalized();
  const PlaneFit fit = fitPlane(noisyPlane(normal, 0.95, 0.3));
  EXPECT_NEAR(fit.distance, 0.95, 0.002);
  EXPECT_GT(fit.normal.dot(normal), std::cos(0.002));
  EXPECT_GT(fit.all.points, 9000u);
  EXPECT_NEAR(static_cast<double>(fit.all.inliers) / fit.all.points, 0.72, 0.05);
  EXPECT_GT(fit.all.rms, 0.0005);
  EXPECT_LT(fit.all.rms, 0.05);
  std::size_t points = 0;
  for (const PlaneFitBand& band : fit.bands) {
    EXPECT_NEAR(band.to_theta - band.from_theta, M_PI / 18.0, 1e-12);
    points += band.points;
  }
  EXPECT_EQ(points, fit.all.points);
}

TEST(FitPlane, MeasuresTheNoiseThatIsThere) {
  // At range r straight ahead the noise is 0.002 r^2, whose median is 0.6745 times that.
  const PlaneFit fit = fitPlane(noisyPlane({0.0, 0.0, -1.0}, 2.0, 0.0));
  ASSERT_FALSE(fit.bands.empty());
  EXPECT_NEAR(fit.bands[0].median_range_error, 0.6745 * 0.002 * 2.0, 0.0004);
  EXPECT_NEAR(fit.bands[0].rms, 0.002 * 4.0, 0.0012);
}

TEST(FitPlane, RefusesWhatHasNoPlane) {
  EXPECT_THROW(fitPlane(cv::Mat(10, 10, CV_32FC3, cv::Scalar::all(kNan))), Error);
  EXPECT_THROW(fitPlane(cv::Mat(10, 10, CV_32FC1)), Error);
  EXPECT_THROW(fitPlane(cv::Mat(10, 10, CV_32FC3, cv::Scalar(1, 2, 3))), Error) << "one point";
  std::mt19937 random(5);
  std::uniform_real_distribution<float> uniform(-1.0f, 1.0f);
  cv::Mat ball(40, 40, CV_32FC3);
  for (int i = 0; i < 1600; ++i) {
    ball.at<cv::Vec3f>(i / 40, i % 40) = {uniform(random), uniform(random), uniform(random)};
  }
  PlaneFitOptions options;
  options.tolerance = 0.01;
  EXPECT_THROW(fitPlane(ball, options), Error);
  options.tolerance = kNan;
  EXPECT_THROW(fitPlane(noisyPlane({0.0, 0.0, -1.0}, 2.0, 0.0), options), Error);
}

}  // namespace
}  // namespace omnister
