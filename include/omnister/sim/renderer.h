// SPDX-License-Identifier: Apache-2.0
/// @file Renders a scene through any lens model, with exact range beside it.
#pragma once

#include <cstdint>
#include <opencv2/core/mat.hpp>

#include "omnister/common/pose.h"
#include "omnister/lens/lens_model.h"
#include "omnister/sim/scene.h"

namespace omnister::sim {

struct RenderOptions {
  int supersampling = 3;        ///< rays a pixel and axis, 1 to 16
  double noise_sigma = 0.0;     ///< Gaussian, in grey levels of 255
  double vignetting = 0.0;      ///< 0: none; 1: cos^4 fall-off of the off-axis angle, clamped
  std::uint64_t seed = 1;       ///< of the noise
  bool color = true;            ///< CV_8UC3 (BGR) or CV_8UC1
  int threads = 0;              ///< 0: every core
};

struct Rendering {
  cv::Mat image;                ///< CV_8UC3 or CV_8UC1; black outside the field
  cv::Mat range;                ///< CV_32FC1, along the ray of the pixel's centre [m]; NaN where nothing
};

/// @param T_world_camera maps the optical frame into the world
Rendering render(const Scene& scene, const LensModel& lens, cv::Size size,
                 const Pose& T_world_camera, const RenderOptions& options = {});

}  // namespace omnister::sim
