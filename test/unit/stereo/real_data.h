// SPDX-License-Identifier: Apache-2.0
/// @file Real sequences beside the repository, in the product's terms. See the README of each data
/// set.
#pragma once

#include <cmath>
#include <filesystem>
#include <fstream>
#include <map>
#include <nlohmann/json.hpp>
#include <opencv2/imgcodecs.hpp>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "omnister/common/pose.h"
#include "omnister/lens/lens_fit.h"
#include "omnister/lens/lens_import.h"
#include "omnister/lens/lens_models.h"

namespace omnister::test {

namespace fs = std::filesystem;

inline fs::path dataFolder(const std::string& name) {
  return fs::path(OMNISTER_SOURCE_DIR) / ".." / "shared" / "data" / name;
}

/// A lens through pairs that `project` makes over the field, and how far it is from them.
template <typename Project>
LensFit lensThrough(const std::string& model, const Eigen::Vector2d& center, double focal,
                    double max_theta, const Project& project) {
  LensStructure structure;
  structure.model = model;
  structure.even_terms = model == "asphere" ? 3 : 0;
  structure.affinity = true;
  structure.decentring = model == "asphere" || model == "spline";
  std::vector<Eigen::Vector3d> bearings;
  std::vector<Eigen::Vector2d> pixels;
  for (int i = 0; i <= 40; ++i) {
    const double theta = 0.999 * max_theta * i / 40.0;
    for (int j = 0; j < (i == 0 ? 1 : 48); ++j) {
      const double azimuth = 2.0 * M_PI * j / 48.0;
      bearings.emplace_back(std::sin(theta) * std::cos(azimuth),
                            std::sin(theta) * std::sin(azimuth), std::cos(theta));
      pixels.push_back(project(bearings.back()));
    }
  }
  return fitLens(*makeLens(structure, center, focal, max_theta), bearings, pixels);
}

/// planesweep_car_fisheye: one camera that slides sideways over a pavement.
struct CarSequence {
  LensFit lens;
  std::vector<std::string> images;
  std::vector<Pose> T_world_camera;
  cv::Size size;

  cv::Mat image(std::size_t i) const { return cv::imread(images.at(i), cv::IMREAD_GRAYSCALE); }
  Pose T_ref_disp(std::size_t reference, std::size_t displaced) const {
    return T_world_camera.at(reference).inverse() * T_world_camera.at(displaced);
  }
};

/// @param side "left" or "right"
inline CarSequence readCarSequence(const std::string& side, const std::string& model = "spline") {
  const fs::path folder = dataFolder("planesweep_car_fisheye") / side;
  CarSequence sequence;
  std::ifstream calib(folder / "calib.txt");
  double fx, skew, cx, fy, cy, xi, k1, k2, p1, p2;
  calib >> fx >> skew >> cx >> fy >> cy >> xi >> k1 >> k2 >> p1 >> p2;
  Pose T_vehicle_camera = Pose::Identity();
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 4; ++c) calib >> T_vehicle_camera.matrix()(r, c);
  }
  if (!calib) throw std::runtime_error("calib.txt of planesweep_car_fisheye is not as described");
  // The printed rotation has ten digits; make it a rotation to the last one.
  T_vehicle_camera.linear() = Eigen::Quaterniond(T_vehicle_camera.linear()).normalized().matrix();

  // The same numbers as Kalibr writes them, through the product's importer.
  std::ostringstream camchain;
  camchain.precision(17);
  camchain << "cam0:\n  camera_model: omni\n  intrinsics: [" << xi << ", " << fx << ", " << fy
           << ", " << cx << ", " << cy << "]\n  distortion_model: radtan\n  distortion_coeffs: ["
           << k1 << ", " << k2 << ", " << p1 << ", " << p2 << "]\n  resolution: [1280, 800]\n";
  sequence.lens =
      fitForeignCamera(readForeignCamera(camchain.str(), "camchain.yaml", "kalibr"), model).fit;

  std::map<std::string, Pose> poses;
  std::ifstream pose_file(folder / "system_poses.txt");
  std::string line;
  while (std::getline(pose_file, line)) {
    std::istringstream fields(line);
    std::string time;
    double yaw, pitch, roll, x, y, z;
    if (line[0] == '#' || !(fields >> time >> yaw >> pitch >> roll >> x >> y >> z)) continue;
    Pose T_world_vehicle = Pose::Identity();
    T_world_vehicle.linear() = (Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) *
                                Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()) *
                                Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitX()))
                                   .toRotationMatrix();
    T_world_vehicle.translation() = Eigen::Vector3d(x, y, z);
    poses[time] = T_world_vehicle * T_vehicle_camera;
  }
  std::vector<fs::path> files;
  for (const auto& entry : fs::directory_iterator(folder)) {
    if (entry.path().extension() == ".png") files.push_back(entry.path());
  }
  std::sort(files.begin(), files.end());
  for (const fs::path& file : files) {
    const std::string stem = file.stem().string();
    const auto pose = poses.find(stem.substr(stem.rfind('_') + 1));
    if (pose == poses.end()) continue;
    sequence.images.push_back(file.string());
    sequence.T_world_camera.push_back(pose->second);
  }
  if (sequence.images.empty()) throw std::runtime_error("no frames with poses");
  sequence.size = sequence.image(0).size();
  return sequence;
}

/// opencv_jy_stereo: a rig of two cameras, a checkerboard held before it.
struct BoardRig {
  LensFit left, right;
  Pose T_left_right;
  cv::Size size{1280, 800};
  std::vector<std::string> left_images, right_images;
  std::vector<std::vector<Eigen::Vector2d>> left_corners, right_corners;  ///< by pair [px]
};

inline std::vector<std::vector<Eigen::Vector2d>> readRecordedCorners(const fs::path& path) {
  std::ifstream file(path);
  std::vector<std::vector<Eigen::Vector2d>> views;
  std::vector<double> numbers;
  std::string word;
  while (file >> word) {
    if (word.rfind("<image_", 0) == 0) numbers.clear();
    std::size_t used = 0;
    try {
      numbers.push_back(std::stod(word, &used));
    } catch (const std::invalid_argument&) {
      used = 0;
    }
    // The last number of a view has the closing tag attached.
    if (word.find("</image_") != std::string::npos) {
      auto& view = views.emplace_back();
      for (std::size_t i = 0; i + 1 < numbers.size(); i += 2)
        view.emplace_back(numbers[i], numbers[i + 1]);
    }
  }
  return views;
}

/// With the calibration that was measured for it (equidistant polynomials).
inline BoardRig readBoardRig(const std::string& model = "spline") {
  const fs::path folder = dataFolder("opencv_jy_stereo");
  BoardRig rig;
  const nlohmann::json json =
      nlohmann::json::parse(std::ifstream(folder / "measured_joint_calibration.json"));
  const auto lens = [&](const nlohmann::json& k) {
    const Eigen::Vector2d center(k["cx"], k["cy"]);
    const double fx = k["fx"], fy = k["fy"];
    // The polynomial holds over the image; its corners are 80 degrees off the axis.
    return lensThrough(model, center, fx, 1.4, [&](const Eigen::Vector3d& ray) {
      const double theta = std::atan2(ray.head<2>().norm(), ray.z()), t2 = theta * theta;
      const double r =
          theta *
          (1.0 + t2 * (double(k["k1"]) +
                       t2 * (double(k["k2"]) + t2 * (double(k["k3"]) + t2 * double(k["k4"])))));
      const Eigen::Vector2d direction =
          theta > 0.0 ? Eigen::Vector2d(ray.head<2>().normalized()) : Eigen::Vector2d(0.0, 0.0);
      return Eigen::Vector2d(center + r * Eigen::Vector2d(fx * direction.x(), fy * direction.y()));
    });
  };
  rig.left = lens(json["left"]);
  rig.right = lens(json["right"]);
  const auto vector = [&](const char* key) {
    return Eigen::Vector3d(json[key][0], json[key][1], json[key][2]);
  };
  const Eigen::Vector3d rotation = vector("rvec_right_from_left");
  Pose T_right_left = Pose::Identity();
  T_right_left.linear() =
      Eigen::AngleAxisd(rotation.norm(), rotation.normalized()).toRotationMatrix();
  T_right_left.translation() = vector("T_right_from_left_m");
  rig.T_left_right = T_right_left.inverse();
  rig.left_corners = readRecordedCorners(folder / "left.xml");
  rig.right_corners = readRecordedCorners(folder / "right.xml");
  for (std::size_t i = 0; i < rig.left_corners.size(); ++i) {
    const std::string name =
        "stereo_pair_0" + std::string(i < 10 ? "0" : "") + std::to_string(i) + ".jpg";
    rig.left_images.push_back((folder / "left" / name).string());
    rig.right_images.push_back((folder / "right" / name).string());
  }
  return rig;
}

}  // namespace omnister::test
