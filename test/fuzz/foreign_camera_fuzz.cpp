// SPDX-License-Identifier: Apache-2.0
#include "fuzz.h"
#include "omnister/lens/lens_import.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  ForeignCamera camera;
  if (!takes([&] { camera = readForeignCamera(bytes, "input"); })) return;
  require(camera.image_size.width > 0 && camera.image_size.height > 0, "an image has a size");
  for (const Eigen::Vector3d& ray : {Eigen::Vector3d(0, 0, 1), Eigen::Vector3d(0.6, 0, 0.8),
                                     Eigen::Vector3d(0, -1, 0), Eigen::Vector3d(0.48, 0.64, -0.6)})
    if (const auto pixel = camera.project(ray)) require(pixel->allFinite(), "pixels are finite");
}
