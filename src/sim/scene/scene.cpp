// SPDX-License-Identifier: Apache-2.0
#include "omnister/sim/scene.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <set>
#include <utility>

#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/image_file.h"
#include "omnister/common/numbers.h"
#include "omnister/common/yaml_text.h"
#include "sim/scene/scene_data.h"

namespace omnister::sim {
namespace {

constexpr std::size_t kMaxFile = 4u << 20;
constexpr std::size_t kMaxObjects = 1000;
constexpr double kDegree = 3.14159265358979324 / 180.0;

std::string quoted(const YAML::Node& node) {
  if (node.IsScalar()) return "'" + printable(node.Scalar(), 60) + "'";
  if (node.IsSequence()) return "a sequence";
  if (node.IsMap()) return "a mapping";
  return "empty";
}

std::string listed(const std::set<std::string>& names) {
  std::string list;
  for (const auto& name : names) list += (list.empty() ? "" : ", ") + name;
  return list;
}

/// One mapping of the file. What is asked for is known; finish() refuses the rest.
class Block {
 public:
  Block(const YAML::Node& node, std::string source, std::string place)
      : source_(std::move(source)), place_(std::move(place)) {
    if (!node.IsMap())
      throw InputError(source_, place_, "is " + quoted(node) + ", expected a mapping");
    for (const auto& entry : node) {
      if (!entry.first.IsScalar())
        throw InputError(source_, place_, "has a key that is not a word");
      if (!values_.emplace(entry.first.Scalar(), entry.second).second) {
        fail(entry.first.Scalar(), "stands there twice");
      }
    }
  }

  [[noreturn]] void fail(const std::string& key, const std::string& problem) const {
    throw InputError(source_, at(key), problem);
  }

  std::string at(const std::string& key) const { return place_.empty() ? key : place_ + "." + key; }
  const std::string& source() const { return source_; }

  bool has(const std::string& key) {
    known_.insert(key);
    return values_.count(key) != 0;
  }

  const YAML::Node& node(const std::string& key, const std::string& expected) {
    if (!has(key)) fail(key, "is missing, expected " + expected);
    return values_.at(key);
  }

  std::string text(const std::string& key, const std::string& expected) {
    const YAML::Node& value = node(key, expected);
    if (!value.IsScalar()) fail(key, "is " + quoted(value) + ", expected " + expected);
    return value.Scalar();
  }

  double number(const std::string& key, double low, double high) {
    return toNumber(node(key, range(low, high)), key, low, high);
  }
  double number(const std::string& key, double low, double high, double otherwise) {
    return has(key) ? number(key, low, high) : otherwise;
  }

  std::uint64_t whole(const std::string& key, double low, double high, std::uint64_t otherwise) {
    if (!has(key)) return otherwise;
    const double value = number(key, low, high);
    if (value != std::floor(value)) {
      fail(key, "is " + formatNumber(value) + ", expected a whole " + range(low, high));
    }
    return static_cast<std::uint64_t>(value);
  }

  std::vector<double> numbers(const std::string& key, std::size_t count, double low, double high) {
    const std::string expected = std::to_string(count) + " numbers in brackets";
    const YAML::Node& value = node(key, expected);
    return toNumbers(value, key, count, low, high);
  }

  Eigen::Vector3d vector(const std::string& key, double limit) {
    const auto v = numbers(key, 3, -limit, limit);
    return {v[0], v[1], v[2]};
  }

  Color color(const std::string& key) { return toColor(node(key, "[red, green, blue]"), key); }

  std::array<Color, 2> colors() {
    const YAML::Node& value = node("colors", "two colours");
    if (!value.IsSequence() || value.size() != 2) {
      fail("colors", "is " + quoted(value) + ", expected two colours: [[r, g, b], [r, g, b]]");
    }
    return {toColor(value[0], "colors[0]"), toColor(value[1], "colors[1]")};
  }

  void finish(const std::string& what) const {
    for (const auto& [key, value] : values_) {
      if (known_.count(key) == 0) {
        fail(key, "is not a key of " + what + ", which has " + listed(known_));
      }
    }
  }

 private:
  static std::string range(double low, double high) {
    return "number from " + formatNumber(low) + " to " + formatNumber(high);
  }

  double toNumber(const YAML::Node& value, const std::string& key, double low, double high) const {
    const auto parsed = value.IsScalar() ? parseNumber(value.Scalar()) : std::nullopt;
    if (!parsed || !(*parsed >= low && *parsed <= high)) {
      fail(key, "is " + quoted(value) + ", expected a " + range(low, high));
    }
    return *parsed;
  }

  std::vector<double> toNumbers(const YAML::Node& value, const std::string& key, std::size_t count,
                                double low, double high) const {
    if (!value.IsSequence() || value.size() != count) {
      fail(key,
           "is " + quoted(value) + ", expected " + std::to_string(count) + " numbers in brackets");
    }
    std::vector<double> result;
    for (std::size_t i = 0; i < count; ++i) {
      result.push_back(toNumber(value[i], key + "[" + std::to_string(i) + "]", low, high));
    }
    return result;
  }

  Color toColor(const YAML::Node& value, const std::string& key) const {
    const auto c = toNumbers(value, key, 3, 0, 255);
    return {static_cast<float>(c[0]), static_cast<float>(c[1]), static_cast<float>(c[2])};
  }

  std::string source_, place_;
  std::map<std::string, YAML::Node> values_;
  std::set<std::string> known_;
};

NoiseParameters readNoise(Block& block) {
  NoiseParameters noise;
  noise.scale = block.number("scale", 1e-4, 1e3, noise.scale);
  noise.octaves = static_cast<int>(block.whole("octaves", 1, 16, 7));
  noise.persistence = block.number("persistence", 0.01, 2.0, noise.persistence);
  noise.contrast = block.number("contrast", 0.0, 1.0, noise.contrast);
  noise.seed = block.whole("seed", 0, 4294967295.0, noise.seed);
  return noise;
}

cv::Mat readPicture(Block& block, const std::filesystem::path& folder) {
  const cv::Mat image =
      readImage(folder / block.text("file", "the name of an image file"), ImageColor::kColor);
  cv::Mat bytes = image;
  if (image.depth() == CV_16U) image.convertTo(bytes, CV_8U, 1.0 / 257.0);
  if (bytes.type() != CV_8UC3) block.fail("file", "is not an image of 8 or 16 bits a channel");
  return bytes;
}

TexturePtr readTexture(const YAML::Node& node, const std::string& source, const std::string& place,
                       const std::filesystem::path& folder) {
  Block block(node, source, place);
  const std::string expected = "noise, solid, checker, bricks, dots or image";
  const std::string type = block.text("type", expected);
  TexturePtr texture;
  if (type == "noise") {
    const NoiseParameters noise = readNoise(block);
    texture = makeNoise(noise, block.colors());
  } else if (type == "solid") {
    texture = makeSolid(block.color("color"));
  } else if (type == "checker") {
    const double size = block.number("size", 1e-4, 1e3);
    texture = makeChecker(size, block.colors());
  } else if (type == "bricks") {
    const auto size = block.numbers("size", 2, 1e-3, 1e3);
    const double mortar = block.number("mortar", 0.0, std::min(size[0], size[1]), 0.0);
    const double variation = block.number("variation", 0.0, 1.0, 0.3);
    const auto seed = block.whole("seed", 0, 4294967295.0, 1);
    texture = makeBricks(size[0], size[1], mortar, variation, seed, block.colors());
  } else if (type == "dots") {
    const double size = block.number("size", 1e-4, 1e3);
    const double radius = block.number("radius", 0.0, 0.5 * size);
    const double share = block.number("share", 0.0, 1.0, 1.0);
    const auto seed = block.whole("seed", 0, 4294967295.0, 1);
    texture = makeDots(size, radius, share, seed, block.colors());
  } else if (type == "image") {
    const double width = block.number("width", 1e-4, 1e3);
    texture = makeImage(readPicture(block, folder), width);
  } else {
    block.fail("type", "is '" + printable(type, 60) + "', expected " + expected);
  }
  if (type != "noise" && block.has("grain")) {
    Block grain(block.node("grain", "a mapping"), source, block.at("grain"));
    const NoiseParameters noise = readNoise(grain);
    grain.finish("grain");
    texture = makeGrain(texture, noise);
  }
  block.finish("a texture of type " + type);
  return texture;
}

Pose readPose(Block& block) {
  Pose pose = Pose::Identity();
  pose.translation() = block.vector("position", 1000.0);
  if (block.has("quaternion")) {
    if (block.has("rotation"))
      block.fail("quaternion", "stands beside rotation, expected one of them");
    const auto q = block.numbers("quaternion", 4, -1e6, 1e6);
    Eigen::Quaterniond rotation(q[3], q[0], q[1], q[2]);
    if (rotation.norm() < 1e-6) block.fail("quaternion", "has no length");
    pose.linear() = rotation.normalized().toRotationMatrix();
  } else if (block.has("rotation")) {
    const Eigen::Vector3d angles = block.vector("rotation", 3600.0) * kDegree;
    pose.linear() = (Eigen::AngleAxisd(angles.z(), Eigen::Vector3d::UnitZ()) *
                     Eigen::AngleAxisd(angles.y(), Eigen::Vector3d::UnitY()) *
                     Eigen::AngleAxisd(angles.x(), Eigen::Vector3d::UnitX()))
                        .toRotationMatrix();
  }
  return pose;
}

class SceneReader {
 public:
  SceneReader(std::string source, std::filesystem::path folder)
      : source_(std::move(source)), folder_(std::move(folder)) {}

  std::unique_ptr<const SceneData> read(const YAML::Node& root) {
    Block block(root, source_, "");
    auto scene = std::make_unique<SceneData>();
    const double version = block.number("version", 0, 1e9);
    if (version != 1) {
      block.fail("version", "is " + formatNumber(version) + ", expected 1");
    }
    if (block.has("background")) scene->background = block.color("background");
    scene->ambient = block.number("ambient", 0.0, 1.0, scene->ambient);
    if (block.has("light")) scene->light = block.vector("light", 1000.0);
    if (block.has("textures")) {
      const YAML::Node& textures = block.node("textures", "a mapping");
      if (!textures.IsMap())
        block.fail("textures", "is " + quoted(textures) + ", expected a mapping");
      if (textures.size() > kMaxObjects) block.fail("textures", "are more than 1000");
      for (const auto& entry : textures) {
        if (!entry.first.IsScalar()) block.fail("textures", "has a name that is not a word");
        const std::string& name = entry.first.Scalar();
        const std::string place = "textures." + name;
        if (textures_.count(name) != 0) throw InputError(source_, place, "stands there twice");
        textures_[name] = readTexture(entry.second, source_, place, folder_);
      }
    }
    const YAML::Node& objects = block.node("objects", "a sequence of objects");
    if (!objects.IsSequence()) {
      block.fail("objects", "is " + quoted(objects) + ", expected a sequence of objects");
    }
    if (objects.size() > kMaxObjects) block.fail("objects", "are more than 1000");
    for (std::size_t i = 0; i < objects.size(); ++i) {
      readObject(objects[i], "objects[" + std::to_string(i) + "]", *scene);
    }
    block.finish("a scene");
    return scene;
  }

 private:
  TexturePtr named(const Block& block, const std::string& key, const std::string& name) const {
    const auto found = textures_.find(name);
    if (found != textures_.end()) return found->second;
    std::set<std::string> names;
    for (const auto& [known, texture] : textures_) names.insert(known);
    block.fail(key, "is '" + printable(name, 60) + "', expected the name of a texture" +
                        (names.empty() ? std::string() : ": " + listed(names)));
  }

  void readTextures(Block& block, bool box, Surface& surface) const {
    if (box && block.has("textures")) {
      if (block.has("texture"))
        block.fail("textures", "stand beside texture, expected one of them");
      const YAML::Node& list = block.node("textures", "six names");
      if (!list.IsSequence() || list.size() != 6) {
        block.fail("textures", "is " + quoted(list) +
                                   ", expected six names: [left, right, top, bottom, near, far]");
      }
      for (std::size_t i = 0; i < 6; ++i) {
        const std::string key = "textures[" + std::to_string(i) + "]";
        if (!list[i].IsScalar()) block.fail(key, "is " + quoted(list[i]) + ", expected a name");
        surface.textures[i] = named(block, key, list[i].Scalar());
      }
    } else {
      surface.textures.fill(
          named(block, "texture", block.text("texture", "the name of a texture")));
    }
  }

  void readObject(const YAML::Node& node, const std::string& place, SceneData& scene) const {
    Block block(node, source_, place);
    const std::string expected = "plane, box, sphere or board";
    const std::string type = block.text("type", expected);
    Surface surface;
    if (type == "plane") {
      surface.kind = Surface::Kind::kPlane;
      if (block.has("size")) {
        const auto size = block.numbers("size", 2, 1e-4, 1e4);
        surface.half = {0.5 * size[0], 0.5 * size[1], 0.0};
      } else {
        constexpr double kEndless = std::numeric_limits<double>::infinity();
        surface.half = {kEndless, kEndless, 0.0};
      }
      readTextures(block, false, surface);
    } else if (type == "box") {
      surface.kind = Surface::Kind::kBox;
      const auto size = block.numbers("size", 3, 1e-4, 1e4);
      surface.half = 0.5 * Eigen::Vector3d(size[0], size[1], size[2]);
      readTextures(block, true, surface);
    } else if (type == "sphere") {
      surface.kind = Surface::Kind::kSphere;
      surface.half.setConstant(block.number("radius", 1e-4, 1e3));
      readTextures(block, false, surface);
    } else if (type == "board") {
      readBoard(block, surface, scene);
    } else {
      block.fail("type", "is '" + printable(type, 60) + "', expected " + expected);
    }
    surface.T_world_local = readPose(block);
    surface.T_local_world = surface.T_world_local.inverse();
    block.finish("a " + type);
    if (type == "board") scene.boards.back().T_world_board = surface.T_world_local;
    scene.surfaces.push_back(std::move(surface));
  }

  void readBoard(Block& block, Surface& surface, SceneData& scene) const {
    Scene::Board board;
    const YAML::Node& node = block.node("target", "a target or the name of a TARGET.yaml");
    board.target = node.IsScalar()
                       ? readTarget(folder_ / node.Scalar())
                       : parseTarget(YAML::Dump(node), source_ + " " + block.at("target"));
    const double dark = block.number("dark", 0.0, 255.0, 20.0);
    const double light = block.number("light", 0.0, 255.0, 235.0);
    const BoardTexture drawn = makeBoard(board.target, dark, light);
    const double margin = block.number("margin", 0.0, 100.0, drawn.margin);
    surface.kind = Surface::Kind::kPlane;
    surface.half.head<2>() = 0.5 * (drawn.high - drawn.low) + Eigen::Vector2d::Constant(margin);
    surface.middle = 0.5 * (drawn.low + drawn.high);
    surface.textures.fill(makeSolid({128, 128, 128}));
    surface.textures[0] = drawn.texture;
    surface.sharp = true;
    scene.boards.push_back(board);
  }

  std::string source_;
  std::filesystem::path folder_;
  std::map<std::string, TexturePtr> textures_;
};

/// Distance to one surface along a unit ray in its own frame.
std::optional<double> rangeTo(const Surface& surface, const Eigen::Vector3d& origin,
                              const Eigen::Vector3d& ray) {
  switch (surface.kind) {
    case Surface::Kind::kPlane: {
      const double t = -origin.z() / ray.z();
      if (!(t > 0.0) || std::isinf(t)) return std::nullopt;
      const Eigen::Vector2d at = origin.head<2>() + t * ray.head<2>() - surface.middle;
      if (std::abs(at.x()) > surface.half.x() || std::abs(at.y()) > surface.half.y())
        return std::nullopt;
      return t;
    }
    case Surface::Kind::kBox: {
      double enter = -std::numeric_limits<double>::infinity();
      double leave = std::numeric_limits<double>::infinity();
      for (int axis = 0; axis < 3; ++axis) {
        if (ray[axis] == 0.0) {
          if (std::abs(origin[axis]) > surface.half[axis]) return std::nullopt;
          continue;
        }
        const double first = (-surface.half[axis] - origin[axis]) / ray[axis];
        const double second = (surface.half[axis] - origin[axis]) / ray[axis];
        enter = std::max(enter, std::min(first, second));
        leave = std::min(leave, std::max(first, second));
      }
      if (enter > leave) return std::nullopt;
      if (enter > 0.0) return enter;
      return leave > 0.0 ? std::optional(leave) : std::nullopt;
    }
    case Surface::Kind::kSphere: {
      const double along = -origin.dot(ray);
      const double inside = std::pow(surface.half.x(), 2) - (origin + along * ray).squaredNorm();
      if (inside <= 0.0) return std::nullopt;
      const double root = std::sqrt(inside);
      if (along > root) return along - root;
      return along + root > 0.0 ? std::optional(along + root) : std::nullopt;
    }
  }
  return std::nullopt;
}

}  // namespace

Scene::Scene(std::unique_ptr<const SceneData> data) : data_(std::move(data)) {}
Scene::~Scene() = default;

const std::vector<Scene::Board>& Scene::boards() const { return data_->boards; }

std::optional<double> Scene::rangeAlong(const Eigen::Vector3d& origin,
                                        const Eigen::Vector3d& direction) const {
  const Eigen::Vector3d ray = direction.normalized();
  double nearest = kFarthest;
  bool hit = false;
  for (const Surface& surface : data_->surfaces) {
    const auto range =
        rangeTo(surface, surface.T_local_world * origin, surface.T_local_world.linear() * ray);
    if (range && *range < nearest) {
      nearest = *range;
      hit = true;
    }
  }
  return hit ? std::optional(nearest) : std::nullopt;
}

ScenePtr parseScene(std::string_view text, std::string_view source,
                    const std::filesystem::path& folder) {
  return readYaml(text, source, [&](const YAML::Node& root) {
    return std::make_shared<const Scene>(SceneReader(std::string(source), folder).read(root));
  });
}

ScenePtr readScene(const std::filesystem::path& path) {
  return parseScene(readFile(path, kMaxFile), path.string(), path.parent_path());
}

ScenePtr withBoard(const Scene& scene, const Scene& boards, std::size_t index) {
  const SceneData& source = boards.data();
  if (index >= source.boards.size()) {
    throw Error("the scene has " + std::to_string(source.boards.size()) +
                " boards, none of number " + std::to_string(index));
  }
  auto data = std::make_unique<SceneData>(scene.data());
  data->boards.push_back(source.boards[index]);
  // Boards are the sharp surfaces, in the same order.
  for (const Surface& surface : source.surfaces) {
    if (surface.sharp && index-- == 0) {
      data->surfaces.push_back(surface);
      break;
    }
  }
  return std::make_shared<const Scene>(std::move(data));
}

}  // namespace omnister::sim
