// SPDX-License-Identifier: Apache-2.0
// `omnister render` and `omnister dewarp` as a person calls them.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <nlohmann/json.hpp>
#include <opencv2/imgcodecs.hpp>
#include <string>
#include <vector>

#include "command_run.h"
#include "omnister/common/file_io.h"
#include "omnister/lens/lens_file.h"
#include "omnister/lens/lens_models.h"
#include "temporary_folder.h"

namespace omnister {
namespace {

using test::Outcome;
using test::run;

namespace fs = std::filesystem;
using ::testing::HasSubstr;

class RenderDewarp : public ::testing::Test {
 protected:
  void SetUp() override {
    LensFile lens;
    lens.image_size = {200, 160};
    lens.lens = makeLens(LensStructure{}, {99.5, 79.5}, 60.0, 1.6);
    writeLensFile(path("lens.yaml"), lens);
    // Walls of a room in six greys, and none textured: every view has a colour of its own.
    writeFileAtomically(
        path("scene.yaml"),
        "version: 1\nambient: 1\ntextures:\n"
        "  a: {type: solid, color: [40, 40, 40]}\n  b: {type: solid, color: [80, 80, 80]}\n"
        "  c: {type: solid, color: [120, 120, 120]}\n  d: {type: solid, color: [160, 160, 160]}\n"
        "  e: {type: solid, color: [200, 200, 200]}\n  f: {type: solid, color: [240, 240, 240]}\n"
        "objects: [{type: box, position: [0, 0, 0], size: [4, 4, 4], textures: [a, b, c, d, e, "
        "f]}]\n");
  }
  std::string path(const std::string& name) const { return (folder_.path() / name).string(); }
  Outcome render(const std::vector<std::string>& more = {}) const {
    std::vector<std::string> arguments{"render",           "--lens", path("lens.yaml"), "--scene",
                                       path("scene.yaml"), "--out",  path("image.png"), "--range",
                                       path("range.tiff"), "--json"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return run(arguments);
  }
  test::TemporaryFolder folder_;
};

TEST_F(RenderDewarp, RangeIsInTheFileAndPoseMovesTheCamera) {
  const Outcome outcome = render({"--pose", "-0.5 0 0.25 0 0 0 1"});
  ASSERT_EQ(outcome.code, 0) << outcome.err;
  const auto json = nlohmann::json::parse(outcome.out);
  EXPECT_EQ(json.at("width"), 200);
  const cv::Mat range = cv::imread(path("range.tiff"), cv::IMREAD_UNCHANGED);
  ASSERT_EQ(range.type(), CV_32FC1);
  const LensFile lens = readLensFile(path("lens.yaml"));
  int checked = 0;
  for (int y = 0; y < range.rows; ++y) {
    for (int x = 0; x < range.cols; ++x) {
      const auto ray = lens.lens->unproject(Eigen::Vector2d(x, y));
      ASSERT_EQ(ray.has_value(), std::isfinite(range.at<float>(y, x)));
      if (!ray) continue;
      // The end of the ray lies on a wall: the largest coordinate is 2.
      const Eigen::Vector3d end =
          Eigen::Vector3d(-0.5, 0, 0.25) + static_cast<double>(range.at<float>(y, x)) * *ray;
      EXPECT_NEAR(end.cwiseAbs().maxCoeff(), 2.0, 1e-5);
      ++checked;
    }
  }
  EXPECT_EQ(json.at("pixels_with_range"), checked);
  EXPECT_GT(checked, 20000);
}

TEST_F(RenderDewarp, ViewsTurnRightDownAndClockwise) {
  ASSERT_EQ(render().code, 0);
  const auto middle = [&](const std::string& view) {
    const Outcome outcome = run({"dewarp", "--lens", path("lens.yaml"), "--view", view, "--hfov",
                                 "20", "--size", "30x20", path("image.png"), path("view.png")});
    EXPECT_EQ(outcome.code, 0) << outcome.err;
    const cv::Mat seen = cv::imread(path("view.png"), cv::IMREAD_GRAYSCALE);
    EXPECT_EQ(seen.size(), cv::Size(30, 20));
    return static_cast<int>(seen.at<uchar>(10, 15));
  };
  EXPECT_EQ(middle("0 0 0"), 240);    // far wall
  EXPECT_EQ(middle("-75 0 0"), 40);   // left; a value that begins with a minus
  EXPECT_EQ(middle("75 0 0"), 80);    // right
  EXPECT_EQ(middle("0 -65 0"), 120);  // up
  EXPECT_EQ(middle("0 65 30"), 160);  // down
  // Rolled clockwise by 90 degrees and wide: the right edge of the view looks down.
  ASSERT_EQ(run({"dewarp", "--lens", path("lens.yaml"), "--view", "0 0 90", "--hfov", "120",
                 "--size", "60x20", path("image.png"), path("view.png")})
                .code,
            0);
  EXPECT_EQ(cv::imread(path("view.png"), cv::IMREAD_GRAYSCALE).at<uchar>(10, 58), 160);
}

TEST_F(RenderDewarp, FailuresSayWhyAndLeaveNothingBehind) {
  ASSERT_EQ(render().code, 0);
  const std::string before = readFile(path("image.png"));
  const auto files = [&] {
    return std::distance(fs::directory_iterator(folder_.path()), fs::directory_iterator());
  };
  const auto count = files();
  struct Case {
    std::vector<std::string> arguments;
    int code;
    std::string said;
  };
  const std::string lens = path("lens.yaml");
  const std::string scene = path("scene.yaml");
  const std::string image = path("image.png");
  const std::vector<Case> cases{
      {{"render", "--lens", lens, "--scene", scene}, 2, "--out"},
      {{"render", "--lens", lens, "--scene", scene, "--out", image, "--supersampling", "0"},
       2,
       "1"},
      {{"render", "--lens", lens, "--scene", path("none.yaml"), "--out", image}, 1, "none.yaml"},
      {{"render", "--lens", lens, "--scene", lens, "--out", image}, 1, "version"},
      {{"render", "--lens", lens, "--scene", scene, "--out", image, "--pose", "0 0 0"},
       1,
       "--pose"},
      {{"render", "--lens", lens, "--scene", scene, "--out", path("new.txt")}, 1, "new.txt"},
      {{"render", "--lens", lens, "--scene", scene, "--out", path("new.png"), "--range",
        path("r.png")},
       1,
       "r.png"},
      {{"render", "--lens", lens, "--scene", scene, "--out", path("no/new.png"), "--range",
        path("r.tiff")},
       1,
       "no/"},
      {{"render", "--lens", lens, "--scene", scene, "--out", path("r.tiff"), "--range",
        path("r.tiff")},
       1,
       "two outputs"},
      {{"dewarp", "--lens", lens, image, image}, 1, "input and an output"},
      {{"dewarp", "--lens", lens, "--view", "0 0", image, path("new.png")}, 1, "pan tilt roll"},
      {{"dewarp", "--lens", lens, "--view", "0 nan 0", image, path("new.png")}, 1, "--view"},
      {{"dewarp", "--lens", lens, "--hfov", "180", image, path("new.png")}, 1, "180"},
      {{"dewarp", "--lens", lens, "--size", "0x5", image, path("new.png")}, 2, "0x5"},
      {{"dewarp", "--lens", lens, path("none.png"), path("new.png")}, 1, "none.png"},
      {{"dewarp", "--lens", lens, scene, path("new.png")}, 1, "scene.yaml"},
  };
  for (const Case& c : cases) {
    const Outcome outcome = run(c.arguments);
    EXPECT_EQ(outcome.code, c.code) << c.said;
    EXPECT_THAT(outcome.err, HasSubstr(c.said));
    EXPECT_EQ(outcome.out, "");
  }
  EXPECT_EQ(readFile(path("image.png")), before);
  EXPECT_EQ(files(), count);
}

}  // namespace
}  // namespace omnister
