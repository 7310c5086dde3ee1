// SPDX-License-Identifier: Apache-2.0
#include "omnister/sim/scene.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <string>
#include <vector>

#include "omnister/common/error.h"

namespace omnister::sim {
namespace {

using ::testing::HasSubstr;

const std::string kHead = "version: 1\ntextures: {grey: {type: solid, color: [100, 100, 100]}}\n";

ScenePtr withObjects(const std::string& objects) {
  return parseScene(kHead + "objects:\n" + objects, "test.yaml");
}

std::string refusal(const std::string& text) {
  try {
    parseScene(text, "test.yaml");
  } catch (const InputError& error) {
    return error.what();
  }
  return "accepted";
}

TEST(Scene, RangeToPlanesBoxesAndSpheres) {
  const auto scene = withObjects(
      "  - {type: plane, position: [0, 0, 4], size: [2, 1], texture: grey}\n"
      "  - {type: box, position: [0, 0, 5], size: [20, 20, 40], texture: grey}\n"
      "  - {type: sphere, position: [5, 0, 0], radius: 1, texture: grey}\n"
      "  - {type: plane, position: [-3, 0, 0], rotation: [0, 60, 0], size: [1, 1], texture: "
      "grey}\n");
  const auto range = [&](double x, double y, double z) {
    return scene->rangeAlong(Eigen::Vector3d::Zero(), {x, y, z}).value_or(-1.0);
  };
  EXPECT_NEAR(range(0, 0, 1), 4.0, 1e-12);
  EXPECT_NEAR(range(0.9, 0.4, 4), std::sqrt(0.81 + 0.16 + 16.0), 1e-12);  // inside the rectangle
  EXPECT_NEAR(range(1.1, 0, 4), 25.0 * std::hypot(1.1, 4.0) / 4.0,
              1e-12);  // past it: the box's far side
  EXPECT_NEAR(range(0, -1, 0), 10.0, 1e-12);
  EXPECT_NEAR(range(0, 0, -2), 15.0, 1e-12);
  EXPECT_NEAR(range(1, 0, 0), 4.0, 1e-12);
  EXPECT_NEAR(range(-1, 0, 0), 3.0, 1e-12);
  // The tilted plane x cos 60 ... : its normal is (sin 60, 0, cos 60).
  const Eigen::Vector3d normal(std::sin(M_PI / 3), 0, std::cos(M_PI / 3));
  const Eigen::Vector3d ray = Eigen::Vector3d(-3, 0.1, 0.2).normalized();
  EXPECT_NEAR(range(-3, 0.1, 0.2), -3 * normal.x() / ray.dot(normal), 1e-12);
}

TEST(Scene, NothingHitIsNothing) {
  const auto scene = withObjects("  - {type: plane, position: [0, 0, 2], texture: grey}\n");
  EXPECT_FALSE(scene->rangeAlong(Eigen::Vector3d::Zero(), {0, 0, -1}));
  EXPECT_FALSE(scene->rangeAlong(Eigen::Vector3d::Zero(), {1, 0, 0}));
  EXPECT_FALSE(scene->rangeAlong(Eigen::Vector3d::Zero(), {1, 0, 1e-6}));  // beyond a kilometre
}

TEST(Scene, BoardsStandWhereTheFileSays) {
  const auto scene = withObjects(
      "  - {type: board, target: {type: checkerboard, cols: 4, rows: 3, square_m: 0.1},\n"
      "     position: [0.1, 0.2, 1.5], quaternion: [0, 0, 1, 1], margin: 0.05}\n");
  ASSERT_EQ(scene->boards().size(), 1u);
  const auto& board = scene->boards()[0];
  EXPECT_EQ(board.target.cols, 4);
  EXPECT_TRUE(board.T_world_board.translation().isApprox(Eigen::Vector3d(0.1, 0.2, 1.5)));
  // A quarter turn about z: the board's x is the world's y.
  EXPECT_TRUE((board.T_world_board.linear() * Eigen::Vector3d::UnitX())
                  .isApprox(Eigen::Vector3d::UnitY(), 1e-12));
  // It reaches one square and the margin beyond the first corner, here to +x of the world.
  const auto hit = [&](double x, double y) {
    return scene->rangeAlong({x, y, 0}, {0, 0, 1}).has_value();
  };
  EXPECT_TRUE(hit(0.1 + 0.149, 0.2));
  EXPECT_FALSE(hit(0.1 + 0.151, 0.2));
  EXPECT_TRUE(hit(0.1, 0.2 + 0.449));
  EXPECT_FALSE(hit(0.1, 0.2 + 0.451));
}

TEST(Scene, ShippedScenesAreRead) {
  for (const char* name : {"room", "corridor", "weak_texture", "plane", "calibration_board"}) {
    const auto scene =
        readScene(std::string(OMNISTER_SOURCE_DIR) + "/config/scenes/" + name + ".yaml");
    EXPECT_TRUE(scene->rangeAlong(Eigen::Vector3d::Zero(), Eigen::Vector3d::UnitZ())) << name;
  }
}

TEST(Scene, RefusalsNameKeyValueAndExpectation) {
  struct Case {
    std::string text;
    std::vector<std::string> said;
  };
  const std::string plane = "objects: [{type: plane, position: [0, 0, 1], texture: grey}]\n";
  const std::vector<Case> cases{
      {"", {"test.yaml", "expected a mapping"}},
      {"[1, 2]", {"a sequence", "expected a mapping"}},
      {"version: 1\nobjects: {", {"line", "is not YAML"}},
      {"version: 1\nobjects: []\n...\nversion: 1", {"line 4", "begins another YAML document"}},
      {"objects: []", {"version", "is missing"}},
      {"version: 2\nobjects: []", {"version", "is 2, expected 1"}},
      {"version: 1\nobjects: []\nfog: 1",
       {"fog", "is not a key of a scene", "ambient, background"}},
      {"version: 1\nversion: 1\nobjects: []", {"version", "stands there twice"}},
      {"version: 1", {"objects", "is missing"}},
      {"version: 1\nobjects: 3", {"objects", "is '3'", "sequence"}},
      {"version: 1\nambient: nan\nobjects: []", {"ambient", "is 'nan'", "from 0 to 1"}},
      {"version: 1\nbackground: [0, 0, 256]\nobjects: []", {"background[2]", "'256'", "0 to 255"}},
      {kHead + "objects: [{type: cone}]",
       {"objects[0].type", "'cone'", "plane, box, sphere or board"}},
      {kHead + "objects: [{type: plane, position: [0, 0], texture: grey}]",
       {"objects[0].position", "3 numbers"}},
      {kHead + "objects: [{type: plane, position: [0, 0, 1], texture: red}]",
       {"objects[0].texture", "'red'", "grey"}},
      {kHead + "objects: [{type: plane, position: [0, 0, 1], texture: grey, radius: 2}]",
       {"objects[0].radius", "is not a key of a plane", "position"}},
      {kHead + "objects: [{type: plane, position: [0, 0, 1], texture: grey, size: [0, 1]}]",
       {"objects[0].size[0]", "'0'"}},
      {kHead + "objects: [{type: box, position: [0, 0, 1], size: [1, 1, 1], textures: [grey]}]",
       {"objects[0].textures", "six names"}},
      {kHead + "objects: [{type: sphere, position: [0, 0, 1], radius: -1, texture: grey}]",
       {"objects[0].radius", "'-1'"}},
      {kHead +
           "objects: [{type: plane, position: [0, 0, 1], quaternion: [0, 0, 0, 0], texture: grey}]",
       {"objects[0].quaternion", "no length"}},
      {"version: 1\ntextures: {a: {type: noise, octaves: 1.5, colors: [[0,0,0],[1,1,1]]}}\n" +
           plane,
       {"textures.a.octaves", "1.5", "whole"}},
      {"version: 1\ntextures: {a: {type: fog}}\n" + plane,
       {"textures.a.type", "'fog'", "noise, solid"}},
      {"version: 1\ntextures: {a: {type: solid, color: [1,2,3], grain: {size: 2}}}\n" + plane,
       {"textures.a.grain.size", "is not a key of grain"}},
      {"version: 1\ntextures: {a: {type: image, file: missing.png, width: 1}}\n" + plane,
       {"missing.png"}},
  };
  for (const Case& c : cases) {
    std::string message;
    try {
      parseScene(c.text, "test.yaml");
      message = "accepted";
    } catch (const Error& error) {
      message = error.what();
    }
    for (const std::string& part : c.said) EXPECT_THAT(message, HasSubstr(part)) << c.text;
    EXPECT_THAT(message, ::testing::Not(HasSubstr("\n")));
  }
  EXPECT_THAT(refusal(kHead + "objects: [{type: board, position: [0, 0, 1], "
                              "target: {type: checkerboard, cols: 4, rows: 3}}]"),
              HasSubstr("square_m"));
}

}  // namespace
}  // namespace omnister::sim
