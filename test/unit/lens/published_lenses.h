// SPDX-License-Identifier: Apache-2.0
/// @file The calibrations of lenses.json as the files that `import` reads, and what is lost.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "omnister/common/numbers.h"
#include "omnister/lens/lens_import.h"
#include "unit/lens/projection_residual.h"

namespace omnister::test {

inline constexpr double kDegree = M_PI / 180.0;

inline std::string list(std::initializer_list<double> values) {
  std::string out = "[";
  for (const double value : values) out += (out.size() > 1 ? ", " : "") + formatNumber(value);
  return out + "]";
}

inline std::string cameraInfo(const std::string& model, const std::string& K, const std::string& D,
                              int count, int width = 1280, int height = 960) {
  return "image_width: " + std::to_string(width) + "\nimage_height: " + std::to_string(height) +
         "\ncamera_name: wide\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: " + K +
         "\ndistortion_model: " + model +
         "\ndistortion_coefficients:\n  rows: 1\n  cols: " + std::to_string(count) +
         "\n  data: " + D + "\n";
}

inline std::string kalibr(const std::string& camera_model, const std::string& intrinsics,
                          const std::string& distortion, const std::string& coefficients,
                          int width = 1280, int height = 960) {
  return "cam0:\n  camera_model: " + camera_model + "\n  intrinsics: " + intrinsics +
         "\n  distortion_model: " + distortion + "\n  distortion_coeffs: " + coefficients +
         "\n  resolution: [" + std::to_string(width) + ", " + std::to_string(height) +
         "]\n  rostopic: /cam0/image_raw\n";
}

/// An entry of lenses.json as a file that `import` reads; empty when no format says its model.
inline std::string asFile(const nlohmann::json& entry) {
  const nlohmann::json& p = entry["params"];
  const auto n = [&](const char* key) { return p.at(key).get<double>(); };
  const int width = entry["width"];
  const int height = entry["height"];
  const std::string model = entry["model"];
  if (model == "kb4") {
    // camera_info rather than Kalibr: it has a place for the skew some have.
    const double skew = p.contains("skew") ? n("skew") : 0.0;
    return cameraInfo("equidistant", list({n("fx"), skew, n("cx"), 0, n("fy"), n("cy"), 0, 0, 1}),
                      list({n("k1"), n("k2"), n("k3"), n("k4")}), 4, width, height);
  }
  if (model == "ds") {
    return kalibr("ds", list({n("xi"), n("alpha"), n("fx"), n("fy"), n("cx"), n("cy")}), "none",
                  "[]", width, height);
  }
  if (model == "eucm") {
    return kalibr("eucm", list({n("alpha"), n("beta"), n("fx"), n("fy"), n("cx"), n("cy")}), "none",
                  "[]", width, height);
  }
  if (model == "mei") {
    return kalibr("omni", list({n("xi"), n("fx"), n("fy"), n("cx"), n("cy")}), "radtan",
                  list({n("k1"), n("k2"), n("p1"), n("p2")}), width, height);
  }
  if (model == "ocam") {
    std::string out = "#polynomial coefficients for the DIRECT mapping function\n\n";
    out += std::to_string(p.at("poly").size());
    for (const double k : p.at("poly")) out += " " + formatNumber(k);
    out +=
        "\n\n#inverse\n\n1 0\n\n#center: \"row\" and \"column\", starting from 0 (C "
        "convention)\n\n";
    out += formatNumber(n("center_row")) + " " + formatNumber(n("center_col"));
    out += "\n\n#affine parameters \"c\", \"d\", \"e\"\n\n" + formatNumber(n("c")) + " " +
           formatNumber(n("d")) + " " + formatNumber(n("e"));
    return out + "\n\n#image size: \"height\" and \"width\"\n\n" + std::to_string(height) + " " +
           std::to_string(width) + "\n";
  }
  return "";
}

/// On a grid of its own, up to 95 degrees or where the source turns back.
inline Residual residual(const ForeignCamera& camera, const LensModel& lens, double limit) {
  std::vector<double> thetas;
  for (int i = 0; i <= 190 && 0.5 * kDegree * i <= limit; ++i) thetas.push_back(0.5 * kDegree * i);
  return projectionResidual(
      thetas, 36, 3.0 * kDegree, [&](const Eigen::Vector3d& n) { return camera.project(n); },
      [&](const Eigen::Vector3d& n) { return lens.project(n); });
}

}  // namespace omnister::test
