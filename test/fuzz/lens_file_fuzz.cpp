// SPDX-License-Identifier: Apache-2.0
#include <cmath>

#include "fuzz.h"
#include "omnister/lens/lens_file.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  LensFile file;
  if (!takes([&] { file = parseLensFile(bytes, "input"); })) return;
  const double width = file.image_size.width;
  const double height = file.image_size.height;
  for (const Eigen::Vector2d& pixel :
       {Eigen::Vector2d(0, 0), Eigen::Vector2d(width, height),
        Eigen::Vector2d(0.3 * width, 0.6 * height), file.lens->center()}) {
    const auto ray = file.lens->unproject(pixel);
    if (!ray) continue;
    require(ray->allFinite() && std::abs(ray->norm() - 1.0) < 1e-6,
            "a viewing ray is a unit vector");
    if (const auto back = file.lens->project(*ray)) require(back->allFinite(), "pixels are finite");
  }
  // What was read can be written and read again.
  if (!timeForMore(bytes)) return;
  const std::string text = formatLensFile(file);
  require(parseLensFile(text, "written").image_size == file.image_size,
          "round trip of a lens file");
}
