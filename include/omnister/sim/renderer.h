// SPDX-License-Identifier: Apache-2.0
/// @file Renders a scene through any lens model, with exact range beside it.
#pragma once

#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <vector>

#include "omnister/common/pose.h"
#include "omnister/lens/lens_model.h"
#include "omnister/sim/scene.h"

namespace omnister::sim {

struct RenderOptions {
  int supersampling = 3;  ///< rays a pixel and axis, 1 to 16
  /// Spend the further rays only where surfaces meet or stand steep; elsewhere textures are
  /// filtered to the size of the pixel. Several times faster, and hardly different.
  bool adaptive = false;
  double noise_sigma = 0.0;  ///< Gaussian, in grey levels of 255
  double vignetting = 0.0;   ///< 0: none; 1: cos^4 fall-off of the off-axis angle, to 0.05 at least
  std::uint64_t seed = 1;    ///< of the noise
  bool color = true;         ///< CV_8UC3 (BGR) or CV_8UC1
  int threads = 0;           ///< 0: every core
};

struct Rendering {
  cv::Mat image;  ///< CV_8UC3 or CV_8UC1; black outside the field
  cv::Mat range;  ///< CV_32FC1, along the ray of the pixel's centre [m]; NaN where nothing
};

/// Keeps the rays of one lens for any number of frames. A pixel's value is the mean over its area,
/// whose centre is its integer position. Frames are the same for any number of threads.
class Renderer {
 public:
  /// @throws Error for an empty image or one of more than 2^28 pixels
  Renderer(const LensModel& lens, cv::Size size, int threads = 0);

  cv::Size size() const { return size_; }

  /// @param T_world_camera maps the optical frame into the world
  /// @throws Error for options out of range or a pose that is not finite
  Rendering render(const Scene& scene, const Pose& T_world_camera,
                   const RenderOptions& options = {}) const;

 private:
  cv::Size size_;
  /// Unit rays in the optical frame, NaN outside the field; one pixel wider than the image all
  /// around.
  std::vector<float> ray_x_, ray_y_, ray_z_;
};

/// One frame. For more of the same lens, keep a Renderer.
Rendering render(const Scene& scene, const LensModel& lens, cv::Size size,
                 const Pose& T_world_camera, const RenderOptions& options = {});

}  // namespace omnister::sim
