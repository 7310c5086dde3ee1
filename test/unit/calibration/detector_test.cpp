// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/detector.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <iostream>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "full_tests.h"
#include "omnister/calibration/detections.h"
#include "omnister/common/error.h"
#include "omnister/common/image_file.h"
#include "omnister/common/numbers.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;
using ::testing::HasSubstr;

const fs::path kData = fs::path(OMNISTER_SOURCE_DIR) / ".." / "shared" / "data";

std::vector<std::string> imagesIn(const fs::path& folder) {
  std::vector<std::string> files;
  if (!fs::is_directory(folder)) return files;
  for (const auto& entry : fs::directory_iterator(folder)) {
    if (entry.path().extension() == ".jpg") files.push_back(entry.path().string());
  }
  // 2.jpg before 10.jpg: the order of the recorded views.
  std::sort(files.begin(), files.end(), [](const std::string& a, const std::string& b) {
    return std::make_pair(a.size(), a) < std::make_pair(b.size(), b);
  });
  return files;
}

// Views of a detections file as lists of corners, by view in order.
std::vector<std::vector<Eigen::Vector2d>> recorded(const fs::path& csv) {
  std::vector<std::vector<Eigen::Vector2d>> views;
  std::ifstream file(csv);
  std::string line;
  std::getline(file, line);
  std::string last;
  while (std::getline(file, line)) {
    const auto numbers = parseNumbers(line);
    if (!numbers || numbers->size() != 6) continue;
    const std::string view = line.substr(0, line.find(','));
    if (views.empty() || view != last) views.emplace_back();
    last = view;
    views.back().emplace_back((*numbers)[1], (*numbers)[2]);
  }
  return views;
}

// RMS distance under the best of the orders that an image cannot tell apart.
double rms(const std::vector<Eigen::Vector2d>& pixels, const std::vector<Eigen::Vector2d>& truth,
           const Target& target) {
  double best = 1e9;
  for (const auto& order : targetSymmetries(target)) {
    double sum = 0.0;
    for (std::size_t i = 0; i < truth.size(); ++i)
      sum += (pixels[order[i]] - truth[i]).squaredNorm();
    best = std::min(best, std::sqrt(sum / truth.size()));
  }
  return best;
}

void compareWithRecorded(const Detections& found, const std::vector<std::string>& files,
                         const fs::path& csv, const Target& target, double tolerance) {
  const auto truth = recorded(csv);
  ASSERT_EQ(truth.size(), files.size());
  double sum = 0.0;
  int compared = 0;
  for (const auto& view : found.views) {
    const auto index = std::find(files.begin(), files.end(), view.name) - files.begin();
    const double error = rms(view.pixels, truth[index], target);
    if (error > 0.5) std::cout << view.name << " differs by " << error << " px RMS\n";
    sum += error * error;
    ++compared;
  }
  std::cout << compared << " views, RMS " << std::sqrt(sum / compared) << " px\n";
  EXPECT_LT(std::sqrt(sum / compared), tolerance);
}

TEST(DetectorOnRealImages, FindsEveryBoardOfTheStereoSet) {
  const Target target{TargetType::kCheckerboard, 8, 6, 0.0244};
  auto left = imagesIn(kData / "opencv_jy_stereo" / "left");
  if (left.empty()) GTEST_SKIP() << "no " << kData / "opencv_jy_stereo";
  std::vector<std::string> missed;
  const Detections found = detectInFiles(left, target, {}, &missed);
  EXPECT_EQ(found.views.size(), left.size());
  EXPECT_EQ(found.image_size, cv::Size(1280, 800));
  compareWithRecorded(found, left, kData / "detections" / "opencv_jy_left.csv", target, 0.2);
  EXPECT_THAT(missed, ::testing::IsEmpty());
}

TEST(DetectorOnRealImages, FindsEveryBoardOfTheOtherCamera) {
  const Target target{TargetType::kCheckerboard, 8, 6, 0.0244};
  const auto right = imagesIn(kData / "opencv_jy_stereo" / "right");
  if (right.empty()) GTEST_SKIP() << "no " << kData / "opencv_jy_stereo";
  if (!test::fullTests()) GTEST_SKIP() << "runs with ./run test --full";
  std::vector<std::string> missed;
  EXPECT_EQ(detectInFiles(right, target, {}, &missed).views.size(), right.size());
  EXPECT_THAT(missed, ::testing::IsEmpty());
}

TEST(DetectorOnRealImages, FindsEveryBoardOfTheThetaSet) {
  const Target target{TargetType::kCheckerboard, 6, 4, 1.0};
  const auto files = imagesIn(kData / "boofcv_theta" / "chessboard");
  if (files.empty()) GTEST_SKIP() << "no " << kData / "boofcv_theta";
  std::vector<std::string> missed;
  const Detections found = detectInFiles(files, target, {}, &missed);
  EXPECT_EQ(found.views.size(), files.size());
  EXPECT_THAT(missed, ::testing::IsEmpty());
  compareWithRecorded(found, files, kData / "detections" / "boofcv_theta.csv", target, 0.2);
}

class ImageFiles : public ::testing::Test {
 protected:
  void SetUp() override {
    folder_ = fs::path(::testing::TempDir()) / "omnister_detector_test";
    fs::remove_all(folder_);
    fs::create_directories(folder_);
  }
  void TearDown() override { fs::remove_all(folder_); }

  std::string write(const std::string& name, const std::string& bytes) const {
    std::ofstream(folder_ / name, std::ios::binary) << bytes;
    return (folder_ / name).string();
  }
  std::string write(const std::string& name, const cv::Mat& image) const {
    cv::imwrite((folder_ / name).string(), image);
    return (folder_ / name).string();
  }
  static std::string bytesOf(const std::string& file) {
    std::ifstream in(file, std::ios::binary);
    return {std::istreambuf_iterator<char>(in), {}};
  }

  fs::path folder_;
};

std::string refusal(const std::vector<std::string>& files) {
  try {
    detectInFiles(files, {TargetType::kCheckerboard, 8, 6, 0.02}, {}, nullptr);
  } catch (const Error& error) {
    return error.what();
  }
  return "";
}

TEST_F(ImageFiles, BadOnesAreRefusedByName) {
  const cv::Mat gray(60, 80, CV_8UC1, cv::Scalar(90));
  const std::string good = write("good.png", gray);
  const std::string jpeg = write("whole.jpg", gray);
  const std::string png_bytes = bytesOf(good);
  const std::string jpeg_bytes = bytesOf(jpeg);
  std::string huge = png_bytes;
  for (int i = 16; i < 24; ++i) huge[i] = i % 4 == 2 ? '\x7f' : '\0';  // 32512 x 32512
  std::string broken = png_bytes;
  for (std::size_t i = 45; i + 20 < broken.size(); ++i) broken[i] = '\x55';

  const std::pair<std::string, std::string> cases[] = {
      {(folder_ / "absent.png").string(), "absent.png"},
      {folder_.string(), "regular file"},
      {write("empty.png", std::string()), "is empty"},
      {write("text.png", std::string("not an image")), "is not an image"},
      {write("cut.jpg", jpeg_bytes.substr(0, jpeg_bytes.size() / 2)), "is cut off"},
      {write("cut.png", png_bytes.substr(0, png_bytes.size() - 14)), "is cut off"},
      {write("broken.png", broken), "broken.png"},
      {write("huge.png", huge), "32512x32512 pixels, expected at most"},
      {write("other.png", cv::Mat(61, 80, CV_8UC1, cv::Scalar(1))), "80x61 pixels, expected 80x60"},
      {write("header.jpg", std::string("\xFF\xD8\xFF\xD9")), "damaged header"},
      {write("liar.pgm", std::string("P5\n99999 99999\n255\nx")), "99999x99999 pixels"},
  };
  int refused = 0;
  for (const auto& [file, message] : cases) {
    const std::string text = refusal({good, file});
    EXPECT_THAT(text, HasSubstr(message)) << file;
    EXPECT_THAT(text, HasSubstr(fs::path(file).filename().string()));
    ++refused;
  }
  EXPECT_EQ(refused, 11);
}

TEST_F(ImageFiles, ImagesWithoutTheTargetAreNamed) {
  std::vector<std::string> missed;
  std::vector<double> told;
  const std::vector<std::string> files{write("a.png", cv::Mat(60, 80, CV_8UC1, cv::Scalar(0))),
                                       write("b.png", cv::Mat(60, 80, CV_16UC1, cv::Scalar(9999)))};
  const Detections found =
      detectInFiles(files, {TargetType::kCheckerboard, 8, 6, 0.02}, {}, &missed,
                    [&](double fraction, const std::string&) { told.push_back(fraction); });
  EXPECT_TRUE(found.views.empty());
  EXPECT_EQ(missed, files);
  EXPECT_EQ(found.image_size, cv::Size(80, 60));
  ASSERT_FALSE(told.empty());
  EXPECT_EQ(told.back(), 1.0);
}

// A board drawn flat, its first corner at (x, y), blurred a little; turned clockwise by quarters.
cv::Mat drawBoard(const Target& target, int quarters, cv::Size size = {640, 480}, double x = 160.3,
                  double y = 120.6, double square = 30.2) {
  cv::Mat fine(size * 8, CV_8UC1, cv::Scalar(215));
  const TargetArtwork art = targetArtwork(target);
  const double scale = 8 * square / target.square_m;
  for (const auto& r : art.rectangles) {
    const cv::Point2d corner(r.x * scale + 8 * (x + 0.5), r.y * scale + 8 * (y + 0.5));
    cv::rectangle(fine, cv::Rect2d(corner, cv::Size2d(r.width * scale, r.height * scale)),
                  cv::Scalar(35), cv::FILLED);
  }
  cv::Mat image;
  cv::resize(fine, image, size, 0, 0, cv::INTER_AREA);
  cv::GaussianBlur(image, image, {}, 0.8);
  for (int quarter = 0; quarter < quarters; ++quarter) {
    cv::rotate(image, image, cv::ROTATE_90_CLOCKWISE);
  }
  return image;
}

TEST(Detector, NumbersAnAsymmetricBoardAlikeHoweverItIsTurned) {
  const Target target{TargetType::kCheckerboard, 8, 5, 0.02};
  const auto upright = detectTarget(drawBoard(target, 0), target);
  ASSERT_TRUE(upright.has_value());
  int same = 0;
  for (int quarters = 0; quarters < 4; ++quarters) {
    const cv::Mat image = drawBoard(target, quarters);
    const auto view = detectTarget(image, target);
    ASSERT_TRUE(view.has_value()) << quarters;
    for (std::size_t i = 0; i < view->pixels.size(); ++i) {
      EXPECT_TRUE(view->points[i].isApprox(upright->points[i]));
      // Turned back.
      Eigen::Vector2d pixel = view->pixels[i];
      int width = image.cols;
      int height = image.rows;
      for (int quarter = 0; quarter < quarters; ++quarter) {
        pixel = {pixel.y(), width - 1 - pixel.x()};
        std::swap(width, height);
      }
      EXPECT_LT((pixel - upright->pixels[i]).norm(), 0.05);
      ++same;
    }
  }
  EXPECT_EQ(same, 160);
}

TEST(Detector, FindsTheSameCornersAtAnyDepth) {
  const Target target{TargetType::kCheckerboard, 8, 6, 0.02};
  const cv::Mat gray = drawBoard(target, 0);
  const auto truth = detectTarget(gray, target);
  ASSERT_TRUE(truth.has_value());
  std::vector<cv::Mat> images(6);
  cv::cvtColor(gray, images[0], cv::COLOR_GRAY2BGR);
  cv::cvtColor(gray, images[1], cv::COLOR_GRAY2BGRA);
  gray.convertTo(images[2], CV_16U, 4.0);  // ten bits in sixteen
  gray.convertTo(images[3], CV_16U, 257.0);
  gray.convertTo(images[4], CV_32F, 1.0 / 255);
  gray.convertTo(images[5], CV_64F, 1e-3, -7.0);
  int compared = 0;
  for (const cv::Mat& image : images) {
    const auto view = detectTarget(image, target);
    ASSERT_TRUE(view.has_value()) << compared;
    for (std::size_t i = 0; i < view->pixels.size(); ++i) {
      EXPECT_LT((view->pixels[i] - truth->pixels[i]).norm(), 0.02) << compared;
    }
    ++compared;
  }
  EXPECT_EQ(compared, 6);
}

TEST(Detector, PartOfALargerBoardIsNotTheBoard) {
  const Target shown{TargetType::kCheckerboard, 8, 6, 0.02};
  const cv::Mat image = drawBoard(shown, 0);
  EXPECT_TRUE(detectTarget(image, shown).has_value());
  for (const auto& [cols, rows] : {std::pair{6, 4}, {7, 6}, {8, 5}, {6, 6}, {4, 3}}) {
    const Target asked{TargetType::kCheckerboard, cols, rows, 0.02};
    EXPECT_FALSE(detectTarget(image, asked).has_value()) << cols << " x " << rows;
    EXPECT_EQ(otherBoardSize(image, asked), cv::Size(8, 6));
  }
  const Target turned{TargetType::kCheckerboard, 6, 8, 0.02};
  for (const Target& same : {shown, turned}) {
    EXPECT_EQ(otherBoardSize(image, same), std::nullopt);
    EXPECT_EQ(otherBoardSize(cv::Mat(200, 300, CV_8UC1, cv::Scalar(7)), same), std::nullopt);
    EXPECT_EQ(otherBoardSize(cv::Mat(), same), std::nullopt);
  }
}

TEST_F(ImageFiles, CornersAreTheSameForAnyNumberOfThreads) {
  const Target target{TargetType::kCheckerboard, 8, 6, 0.02};
  std::vector<std::string> files;
  for (int i = 0; i < 6; ++i) {
    files.push_back(
        write(std::to_string(i) + ".png",
              drawBoard(target, 0, {640, 480}, 120.1 + 7.3 * i, 90.4 + 5.7 * i, 25.0 + i)));
  }
  DetectorOptions options;
  options.threads = 1;
  const Detections one = detectInFiles(files, target, options, nullptr);
  options.threads = 3;
  const Detections three = detectInFiles(files, target, options, nullptr);
  ASSERT_EQ(one.views.size(), 6u);
  ASSERT_EQ(three.views.size(), 6u);
  for (std::size_t i = 0; i < one.views.size(); ++i) {
    EXPECT_EQ(one.views[i].name, files[i]);
    EXPECT_EQ(one.views[i].pixels, three.views[i].pixels);
  }
}

TEST(Detector, SmallAndStrangeImagesHaveNoBoard) {
  const Target target{TargetType::kCheckerboard, 8, 6, 0.02};
  int searched = 0;
  for (const cv::Size size : {cv::Size(0, 0), cv::Size(1, 1), cv::Size(1, 500), cv::Size(500, 1),
                              cv::Size(19, 19), cv::Size(40, 30)}) {
    for (const int type : {CV_8UC1, CV_8UC3, CV_8UC4, CV_8UC2, CV_16UC1, CV_16UC3, CV_16SC1,
                           CV_32FC1, CV_64FC3, CV_32SC1}) {
      cv::Mat image(size, type);
      image.setTo(cv::Scalar::all(17));
      EXPECT_FALSE(detectTarget(image, target).has_value());
      ++searched;
    }
  }
  EXPECT_EQ(searched, 60);
  EXPECT_FALSE(detectTarget(cv::Mat(90, 90, CV_32FC1, cv::Scalar(NAN)), target).has_value());
}

}  // namespace
}  // namespace omnister
