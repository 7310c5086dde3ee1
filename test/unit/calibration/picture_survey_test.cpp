// SPDX-License-Identifier: Apache-2.0
// A folder as people bring it: good pictures of a board among all kinds of bad ones.
#include "omnister/calibration/picture_survey.h"

#include <gmock/gmock.h>

#include <fstream>
#include <map>
#include <nlohmann/json.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "command_run.h"
#include "omnister/calibration/board_hint.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "rendered_boards.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;
using ::testing::AllOf;
using ::testing::HasSubstr;

const cv::Size kSize(640, 480);

Target board() {
  return parseTarget("{type: checkerboard, cols: 8, rows: 5, square_m: 0.03}", "t");
}

class Folder : public ::testing::Test {
 protected:
  void SetUp() override {
    fs::create_directories(pictures_);
    writeFileAtomically(target_, formatTarget(board()));
  }

  std::string put(const std::string& name, const cv::Mat& image) const {
    EXPECT_TRUE(cv::imwrite((pictures_ / name).string(), image));
    return (pictures_ / name).string();
  }

  cv::Mat picture(int i, const LensModel& lens) const {
    const test::Placement placement{8.0 + 4.1 * (i % 12), 37.0 * i, 0.26 + 0.01 * (i % 7),
                                    i % 2 == 0 ? 33.0 : -29.0, 5.0 + 17.0 * i};
    return test::draw(board(), test::boardPose(board(), placement), lens, kSize);
  }

  void putGood(int count) const {
    for (int i = 0; i < count; ++i) put("good" + std::to_string(i) + ".png", picture(i, *lens_));
  }

  nlohmann::json calibrated(const std::vector<std::string>& more = {}) const {
    std::vector<std::string> arguments = {"calibrate", "--target", target_.string(),  "--model",
                                          "conic",     "--json",   pictures_.string()};
    arguments.insert(arguments.end(), more.begin(), more.end());
    const test::Outcome outcome = test::run(arguments);
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    return outcome.code == 0 ? nlohmann::json::parse(outcome.out) : nlohmann::json();
  }

  test::TemporaryFolder folder_;
  fs::path pictures_ = fs::path(folder_.path()) / "pictures";
  fs::path target_ = fs::path(folder_.path()) / "target.yaml";
  LensPtr lens_ = test::wideLens(kSize);
};

TEST_F(Folder, BadPicturesAreNamedAndDoNotMatter) {
  putGood(20);
  // Not bad at all: the same camera's picture with 16 bits.
  cv::Mat deep;
  picture(21, *lens_).convertTo(deep, CV_16U, 16.0);
  put("deep.png", deep);
  const nlohmann::json clean = calibrated();
  EXPECT_EQ(clean["views"], 21);
  EXPECT_EQ(clean["left_out"].size(), 0u) << clean["left_out"];

  std::map<std::string, std::string> expected;
  const auto bad = [&](const std::string& name, const cv::Mat& image, const std::string& reason) {
    put(name, image);
    expected[name] = reason;
  };
  bad("dark.png", picture(22, *lens_) * 0.001, "too dark");
  bad("bright.png", picture(23, *lens_) + 240, "too bright");
  bad("small.png", cv::Mat(240, 320, CV_8UC1, cv::Scalar(90)), "is 320x240 pixels");
  cv::Mat upright;
  cv::rotate(picture(5, *lens_), upright, cv::ROTATE_90_CLOCKWISE);
  bad("upright.png", upright, "it was turned");
  bad("copy.png", picture(4, *lens_), "is the same picture as");
  cv::Mat again;
  cv::cvtColor(picture(6, *lens_), again, cv::COLOR_GRAY2BGR);
  put("again.jpg", again);
  expected["again.jpg"] = "just where";
  cv::Mat blurred;
  cv::GaussianBlur(picture(7, *lens_), blurred, {}, 2.5);
  bad("blurred.png", blurred, "blurred");
  cv::Mat moved = cv::Mat::zeros(1, 11, CV_32FC1);
  moved.setTo(1.0 / 11);
  cv::Mat shaken;
  cv::filter2D(picture(8, *lens_), shaken, -1, moved);
  bad("shaken.png", shaken, "blurred");
  cv::Mat covered = picture(9, *lens_);
  cv::circle(covered, {320, 240}, 200, cv::Scalar(60), -1);
  bad("covered.png", covered, "no board");
  cv::Mat mirrored;
  cv::flip(picture(10, *lens_), mirrored, 1);
  bad("mirrored.png", mirrored, "px");
  bad("room.png", cv::Mat(kSize, CV_8UC1, cv::Scalar(128)), "");
  const LensPtr narrow = makeLens({"conic"}, {300.0, 250.0}, 420.0, 0.9);
  put("foreign.png",
      test::draw(board(), test::boardPose(board(), {5, 40, 0.5, 30, 15}), *narrow, kSize));
  expected["foreign.png"] = "px";
  std::ofstream(pictures_ / "text.png") << "no picture";
  expected["text.png"] = "is not an image";
  {
    std::ifstream whole(pictures_ / "good1.png", std::ios::binary);
    std::string bytes((std::istreambuf_iterator<char>(whole)), {});
    std::ofstream(pictures_ / "cut.png", std::ios::binary) << bytes.substr(0, bytes.size() / 2);
  }
  expected["cut.png"] = "cut off";
  std::ofstream(pictures_ / "notes.txt") << "no picture, and not taken for one";

  const nlohmann::json json = calibrated();
  EXPECT_EQ(json["views"], 21 + static_cast<int>(expected.size()));
  std::map<std::string, std::string> told;
  for (const auto& row : json["left_out"]) {
    told[fs::path(row["image"].get<std::string>()).filename()] = row["reason"];
  }
  for (const auto& [name, reason] : expected) {
    EXPECT_EQ(told.count(name), 1u) << name;
    EXPECT_THAT(told[name], HasSubstr(reason)) << name;
  }
  for (const auto& [name, reason] : told) {
    EXPECT_EQ(expected.count(name), 1u) << name << ": " << reason;
  }
  EXPECT_NEAR(json["rms_px"].get<double>() / clean["rms_px"].get<double>(), 1.0, 0.02);
  EXPECT_NEAR(json["height_px"].get<double>() / clean["height_px"].get<double>(), 1.0, 0.001);
}

TEST_F(Folder, WithoutATargetTheBoardIsSuggested) {
  putGood(6);
  const test::Outcome none = test::run({"calibrate", pictures_.string()});
  EXPECT_EQ(none.code, 2);
  EXPECT_THAT(none.err, AllOf(HasSubstr("--target"), HasSubstr("cols: 8, rows: 5, square_m: SIDE"),
                              HasSubstr("--square-mm")));
  const test::Outcome sized = test::run(
      {"calibrate", pictures_.string(), "--square-mm", "30", "--model", "conic", "--json"});
  ASSERT_EQ(sized.code, 0) << sized.err;
  EXPECT_EQ(nlohmann::json::parse(sized.out)["views_used"], 6);
  EXPECT_EQ(test::run({"calibrate", pictures_.string(), "--square-mm", "30", "--target",
                       target_.string()})
                .code,
            2);
  fs::create_directories(folder_.path() / "empty");
  const test::Outcome empty =
      test::run({"calibrate", folder_.path() / "empty", "--target", target_.string()});
  EXPECT_EQ(empty.code, 1);
  EXPECT_THAT(empty.err, HasSubstr("has no picture in it"));
}

TEST(PicturesIn, NumbersCompareAsNumbers) {
  const test::TemporaryFolder folder;
  for (const char* name : {"a10.png", "a2.png", "a1.PNG", "b.jpg", "c.txt"}) {
    std::ofstream(folder.path() / name) << "x";
  }
  std::vector<std::string> names;
  for (const std::string& file : picturesIn({folder.path().string(), "elsewhere.png"})) {
    names.push_back(fs::path(file).filename());
  }
  EXPECT_THAT(names,
              ::testing::ElementsAre("a1.PNG", "a2.png", "a10.png", "b.jpg", "elsewhere.png"));
}

TEST(BoardHint, NamesTheKeyThatIsWrong) {
  const LensPtr lens = test::wideLens(kSize);
  struct Case {
    std::string shown, asked, hint;
  };
  const std::string charuco =
      "{type: charuco, cols: 7, rows: 6, square_m: 0.035, marker_m: 0.026, dictionary: ";
  const std::string tags = "{type: aprilgrid, cols: 4, rows: 3, square_m: 0.05, spacing: 0.3";
  const Case cases[] = {
      {charuco + "DICT_5X5_50}", charuco + "DICT_4X4_50}", "expected dictionary: DICT_5X5_50"},
      {charuco + "DICT_4X4_50, legacy: true}", charuco + "DICT_4X4_50}", "expected legacy: true"},
      {charuco + "DICT_4X4_50}", charuco + "DICT_4X4_50, legacy: true}", "expected legacy: false"},
      {"{type: circles, cols: 4, rows: 9, square_m: 0.025, asymmetric: true}",
       "{type: circles, cols: 4, rows: 9, square_m: 0.025}", "expected asymmetric: true"},
      {tags + ", dictionary: tag25h9}", tags + "}", "expected dictionary: tag25h9"},
      {"{type: checkerboard, cols: 8, rows: 5, square_m: 0.03}", tags + "}",
       "expected type: checkerboard"},
  };
  for (const Case& c : cases) {
    const Target shown = parseTarget(c.shown, "shown");
    const cv::Mat image =
        test::draw(shown, test::boardPose(shown, {12, 30, 0.3, 25, 15}), *lens, kSize);
    const auto hint = boardHint(image, parseTarget(c.asked, "asked"));
    ASSERT_TRUE(hint) << c.hint;
    EXPECT_THAT(*hint, HasSubstr(c.hint));
    EXPECT_FALSE(boardHint(image, shown)) << c.shown;
  }
}

TEST(BoardHint, TwoPicturesInOneAreNamed) {
  const LensPtr lens = test::wideLens(kSize);
  const Target target = board();
  const cv::Mat left =
      test::draw(target, test::boardPose(target, {12, 30, 0.3, 25, 15}), *lens, kSize);
  const cv::Mat right =
      test::draw(target, test::boardPose(target, {10, 20, 0.31, 25, 15}), *lens, kSize);
  cv::Mat beside, above;
  cv::hconcat(left, right, beside);
  cv::vconcat(left, right, above);
  for (const cv::Mat& image : {beside, above}) {
    const auto hint = boardHint(image, target);
    ASSERT_TRUE(hint);
    EXPECT_THAT(*hint, HasSubstr("shows the board twice"));
  }
  EXPECT_FALSE(boardHint(left, target));
}

}  // namespace
}  // namespace omnister
